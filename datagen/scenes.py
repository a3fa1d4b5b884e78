"""Scenes: from the specification and a clip's number to the clip.

Before: spec.py, rosters.py, photos.py, stages.py, lit_stages.py, casts.py, wraps.py.  After: samples.py.
Clip number c depends on (seed, c) and the assets, never on other clips.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path as FilePath

import numpy as np
import torch
from torch import Tensor

from datagen.animated import PlayedAction, is_animated, load_animated
from datagen.assets import Roster, load_mesh
from datagen.casts import build_cast, choose_motion, choose_places
from datagen.clips import Actor, Clip
from datagen.lit_stages import choose_lit_stage, is_clip_lit
from datagen.motions import CarriedVertices, Path, PlayedVertices, RigidBody, RigidMotion, turns
from datagen.patterns import lit_color, paint, palette_colours
from datagen.photos import survey_photos
from datagen.rosters import survey_meshes, survey_played
from datagen.seeds import open_stream
from datagen.sequences import CACHE_SUFFIX, load_sequence
from datagen.shapes import Shape
from datagen.spec import DatasetSpec, parse_spec
from datagen.stages import choose_stage
from datagen.wraps import choose_background, wrap_actors

NO_ASSETS = Roster((), (), "")


@dataclass(frozen=True)
class Plan:
    """A specification together with the assets that it may use: all that a worker needs."""

    spec: DatasetSpec
    asset_names: tuple[str, ...]  # relative to spec.assets
    assets_sha256: str  # of pictures too
    texture_names: tuple[str, ...] = ()  # relative to spec.textures
    background_names: tuple[str, ...] = ()  # relative to spec.backgrounds

    @property
    def config_sha256(self) -> str:
        """Hash of everything that the bytes of a frame depend on, but its index."""
        return self.spec.config_sha256(self.assets_sha256)

    def to_json(self) -> str:
        """Return the plan as text that `plan_from_json` reads back equal."""
        names = (f.name for f in fields(self) if f.name != "spec")
        told = {"spec": self.spec.model_dump()} | {name: getattr(self, name) for name in names}
        return json.dumps(told, sort_keys=True)


def plan_from_json(text: str) -> Plan:
    """Return the plan that `Plan.to_json` wrote. Source: ours."""
    told = json.loads(text)
    names = {name: tuple(told[name]) for name in ("asset_names", "texture_names", "background_names")}
    return Plan(spec=parse_spec(told["spec"]), assets_sha256=told["assets_sha256"], **names)


def survey_assets(spec: DatasetSpec) -> Roster:
    """Read all assets once.

    Raises:
        MeshError: none of them can be used.

    Source: ours.
    """
    if spec.source == "primitives":
        return NO_ASSETS
    return survey_meshes(str(spec.assets)) if spec.source == "meshes" else survey_played(str(spec.assets))


def survey_plan(spec: DatasetSpec) -> tuple[Plan, tuple[tuple[str, str], ...]]:
    """Read all assets and pictures once and return the plan, and the files refused, with the reason.

    Raises:
        MeshError: none of the assets, of the textures or of the backgrounds can be used.

    Source: ours.
    """
    roster = survey_assets(spec)
    total = hashlib.sha256(roster.sha256.encode())
    names: dict[str, tuple[str, ...]] = {}
    refused = list(roster.refused)
    for role, folder in (("textures", spec.textures), ("backgrounds", spec.backgrounds)):
        if folder is None:
            continue
        photos = survey_photos(folder)
        names[f"{role[:-1]}_names"] = photos.names
        refused += [(f"{role}/{name}", reason) for name, reason in photos.refused]
        total.update(f"{role} {photos.sha256}".encode())
    sha256 = total.hexdigest() if names else roster.sha256
    return Plan(spec, roster.names, sha256, **names), tuple(refused)


def build_clip(plan: Plan, clip: int) -> Clip:
    """Return clip number `clip`.

    Args:
        plan: specification and assets.
        clip: at least 0.

    Raises:
        MeshError: an asset cannot be read any more.

    Source: ours.
    """
    spec = plan.spec
    rngs = {
        name: open_stream(spec.seed, name, clip) for name in ("stage", "camera", "cast", "motion", "colour", "backdrop")
    }
    number = int(rngs["stage"].integers(0, 2**31))
    colours = palette_colours(number)
    size, is_lit = (spec.width, spec.height), is_clip_lit(spec.lighting, spec.seed, clip)
    notes: dict[str, object] = {"source": spec.source}
    if spec.source == "primitives":
        cast = build_cast((rngs["cast"], rngs["motion"], rngs["colour"]), colours, size[0] / size[1], is_lit)
    elif spec.source == "meshes":
        cast = _mesh_cast(plan, rngs, colours, notes, is_lit)
    else:
        cast = [_sequence_actor(plan, rngs, colours, notes, is_lit)]
    has_photo = bool(plan.background_names)
    if is_lit:
        rng = open_stream(spec.seed, "lamps", clip)
        stage = choose_lit_stage((rngs["camera"], rng), colours, size, cast, has_photo, bool(plan.texture_names))
    else:
        stage = choose_stage((rngs["camera"], rngs["backdrop"]), colours, size)
        stage = replace(stage, actors=(), kinds=stage.kinds | {"backdrop": "picture"}) if has_photo else stage
    notes |= stage.kinds
    actors, background = _with_pictures(plan, clip, (stage.actors, cast), stage.background, notes)
    return Clip(actors, stage.camera, background, notes, stage.lamps, stage.ambient)


def _with_pictures(
    plan: Plan,
    clip: int,
    actors: tuple[Sequence[Actor], Sequence[Actor]],
    background: Tensor,
    notes: dict[str, object],
) -> tuple[tuple[Actor, ...], Tensor]:
    """Return the actors, backdrop and cast, and the background, with people's pictures where the plan has any."""
    spec, (backdrop, cast) = plan.spec, actors
    rng = open_stream(spec.seed, "pictures", clip)
    if plan.background_names:
        size = (spec.width, spec.height)
        background, notes["background"] = choose_background(rng, str(spec.backgrounds), plan.background_names, size)
    everyone = [*backdrop, *cast]
    if plan.texture_names:
        folder = str(spec.textures)
        everyone, notes["textures"] = wrap_actors(everyone, len(backdrop), rng, folder, plan.texture_names)
    return tuple(everyone), background


def _mesh_cast(
    plan: Plan, rngs: dict[str, np.random.Generator], colours: Tensor, notes: dict[str, object], is_lit: bool
) -> list[Actor]:
    """Return one to three of people's meshes, each with a rigid motion."""
    rng, spec = rngs["cast"], plan.spec
    n = int(rng.choice((1, 2, 3), p=(0.4, 0.35, 0.25)))
    aspect = spec.width / spec.height
    places = choose_places(rng, n, aspect)
    actors, not_used, played = [], [], {}
    for k in range(n):
        name = plan.asset_names[int(rng.integers(0, len(plan.asset_names)))]
        path = str(FilePath(str(spec.assets)) / name)
        size = float(rng.uniform(1.25, 1.75)) * (1.0, 0.8, 0.66)[n - 1] * min(1.0, max(aspect, 0.5))
        place = tuple(0.35 * c for c in places[0]) if n == 1 else tuple(0.8 * c for c in places[k])
        is_cache = FilePath(path).suffix.lower() == CACHE_SUFFIX
        if is_cache or is_animated(path):
            motion = choose_motion(rngs["motion"], place, size)
            looks, title = (rngs, colours, is_lit), f"{name}-{k}"
            if is_cache:
                actor, told, unread = _cache_actor((path, spec.sequence_fps), title, (size, motion), looks)
            else:
                actor, told, unread = _animated_actor(path, title, (size, motion), looks)
            actors.append(actor)
            played[actor.name] = told
            not_used += [f"{name}: {note}" for note in unread]
            continue
        asset = load_mesh(path)
        shape = Shape(asset.vertices * size, asset.faces, _flat_uv(asset.vertices, asset.faces), False)
        body = RigidBody(shape.vertices, choose_motion(rngs["motion"], place, size))
        color = _asset_color(shape, asset.color, colours, rngs["colour"], is_lit)
        opacity: Tensor | float = 1.0 if asset.opacity is None else asset.opacity.to(torch.float32)
        actors.append(Actor(f"{name}-{k}", shape.faces, color, body, opacity, is_lit=is_lit))
        not_used += [f"{name}: {note}" for note in asset.notes]
    notes["assets"] = sorted({a.name.rsplit("-", 1)[0] for a in actors})
    if played:
        notes["animations"] = played
    if not_used:
        notes["not_used"] = sorted(set(not_used))
    return actors


def _sequence_actor(
    plan: Plan, rngs: dict[str, np.random.Generator], colours: Tensor, notes: dict[str, object], is_lit: bool
) -> Actor:
    """Return the sequence as one body: turned about the vertical and started somewhere, by the clip."""
    rng, spec = rngs["cast"], plan.spec
    angle = torch.tensor([float(rng.uniform(-math.pi, math.pi))], dtype=torch.float64)
    size = 1.75 * min(1.0, max(spec.width / spec.height, 0.5))
    if is_animated(str(spec.assets)):
        motion = RigidMotion(Path((0.0, 0.0, 0.0)), rest=(0.0, float(angle), 0.0))
        actor, told, unread = _animated_actor(
            str(spec.assets), FilePath(str(spec.assets)).name, (size, motion), (rngs, colours, is_lit)
        )
        notes["animations"] = {actor.name: told}
        if unread:
            notes["not_used"] = list(unread)
        return actor
    asset = load_sequence(str(spec.assets))
    positions = asset.positions @ turns((0.0, 1.0, 0.0), angle)[0].T * size
    length_s = max(len(positions) - 1, 0) / spec.sequence_fps
    start_s = float(rng.uniform(0, 2 * length_s))
    shape = Shape(positions[0], asset.faces, _flat_uv(positions[0], asset.faces), False)
    color = _asset_color(shape, asset.color, colours, rngs["colour"], is_lit)
    notes["sequence"] = {
        "file": asset.name,
        "frames": len(positions),
        "rate_hz": spec.sequence_fps,
        "start_s": start_s,
        "played": "back and forth, linear between its frames",
    }
    if asset.notes:
        notes["not_used"] = list(asset.notes)
    motion = PlayedVertices(positions, spec.sequence_fps, start_s)
    return Actor(asset.name, asset.faces, color, motion, is_lit=is_lit)


def _cache_actor(
    file: tuple[str, float],
    name: str,
    body: tuple[float, RigidMotion],
    looks: tuple[dict[str, np.random.Generator], Tensor, bool],
) -> tuple[Actor, dict[str, object], tuple[str, ...]]:
    """Return a vertex cache at a rate [Hz] as an actor of a size and a motion, what is played of it, what is not."""
    (path, rate_hz), (size, motion), (rngs, colours, is_lit) = file, body, looks
    asset = load_sequence(path)
    positions = asset.positions * size
    start_s = float(rngs["cast"].uniform(0, 2 * (len(positions) - 1) / rate_hz))
    shape = Shape(positions[0], asset.faces, _flat_uv(positions[0], asset.faces), False)
    color = _asset_color(shape, asset.color, colours, rngs["colour"], is_lit)
    player = CarriedVertices(PlayedVertices(positions, rate_hz, start_s), motion)
    told: dict[str, object] = {
        "name": "frames",
        "length_s": (len(positions) - 1) / rate_hz,
        "start_s": start_s,
        "played": "back and forth",
    }
    return Actor(name, asset.faces, color, player, is_lit=is_lit), told, asset.notes


def _animated_actor(
    path: str, name: str, body: tuple[float, RigidMotion], looks: tuple[dict[str, np.random.Generator], Tensor, bool]
) -> tuple[Actor, dict[str, object], tuple[str, ...]]:
    """Return an animated file as an actor of a size and a motion, what is played of it, and what in it is not used."""
    (size, motion), (rngs, colours, is_lit) = body, looks
    rng, asset = rngs["cast"], load_animated(path)
    action = asset.actions[int(rng.integers(0, len(asset.actions)))]
    start_s = float(rng.uniform(0, 2 * action.length_s))
    player = PlayedAction(action, start_s, size, motion)
    rest = player.resting()
    shape = Shape(rest, asset.faces, _flat_uv(rest, asset.faces), False)
    color = _asset_color(shape, asset.color, colours, rngs["colour"], is_lit)
    opacity: Tensor | float = 1.0 if asset.opacity is None else asset.opacity.to(torch.float32)
    told: dict[str, object] = {
        "name": action.name,
        "length_s": action.length_s,
        "start_s": start_s,
        "played": "round and round" if action.is_round else "back and forth",
    }
    return Actor(name, asset.faces, color, player, opacity, is_lit=is_lit), told, asset.notes


def _asset_color(shape: Shape, given: Tensor | None, colours: Tensor, rng: np.random.Generator, is_lit: bool) -> Tensor:
    """Return face colours, with painted light unless lit: the file's own, or two of the palette where it has none."""
    own = colours[torch.from_numpy(rng.permutation(len(colours) - 1) + 1)]
    pattern = str(rng.choice(("plain", "gradient", "noise"), p=(0.4, 0.35, 0.25)))
    painted = paint(shape, own, pattern, rng)
    return lit_color(shape, painted if given is None else given, is_lit, two_sided=True)


def _flat_uv(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return (F, 2) places of the faces seen from the front, in [0, 1]."""
    low, high = vertices.amin(0), vertices.amax(0)
    centres = vertices[faces].mean(1)
    return ((centres - low) / (high - low).clamp(min=1e-12))[:, :2]
