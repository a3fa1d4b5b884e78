"""Which effects a scene calls for: decided before rendering, from bounds that are on the safe side, and told to people.

Before: survey.py.  After: render.py, which leaves out what is not needed.
Symbols: P prisms in view; M meshes. An effect that is left out would not have changed the image.
Source: ours.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchblur import check
from torchblur.accuracy import Accuracy
from torchblur.prisms import Prisms, build_prisms
from torchblur.scene import Scene
from torchblur.shutter import Shutter
from torchblur.surfaces import build_surfaces
from torchblur.survey import Survey, shows_back, survey_prisms

# what plans tell of, in their order
EFFECTS = ("motion", "transparency", "texture", "lighting", "shadows", "clipping", "facing", "crossings", "curvature")
EFFECTS += ("rays",)
SWITCHED = ("motion", "transparency", "clipping", "facing", "crossings", "curvature")  # that rendering can leave out
WIDTHS = (13, 8, 46, 46)  # characters of the printed columns


@dataclass(frozen=True)
class Effect:
    """One effect in one scene."""

    name: str
    needed: bool
    why: str  # with the figure that decided
    cost: str  # of simulating it, or of what is done instead
    forced: bool = False  # simulated although not needed

    @property
    def simulated(self) -> bool:
        """Whether rendering takes it into account."""
        return self.needed or self.forced


@dataclass(frozen=True)
class EffectPlan:
    """What rendering a scene takes into account, and why; `print` it, or hand it to `render` as `effects`."""

    effects: tuple[Effect, ...]
    moves: tuple[bool, ...]  # mesh by mesh: on screen, while the shutter is open
    opacity: tuple[str, ...]  # mesh by mesh: "opaque", "constant" or "textured"

    def __getitem__(self, name: str) -> Effect:
        """Return the effect called `name`; KeyError if there is none."""
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise KeyError(name)

    @property
    def needed(self) -> frozenset[str]:
        """Names of the effects that the scene calls for."""
        return frozenset(e.name for e in self.effects if e.needed)

    @property
    def simulated(self) -> frozenset[str]:
        """Names of the effects that rendering takes into account."""
        return frozenset(e.name for e in self.effects if e.simulated)

    def forcing(self, *names: str) -> EffectPlan:
        """Return the plan with some of `motion`, `transparency`, `clipping`, `facing`, `crossings` and `curvature`
        simulated whether needed or not; with all of them if none is named.

        Raises:
            ValueError: another name.
        """
        for name in names:
            if name not in SWITCHED:
                raise check.fail("names", f"some of {', '.join(SWITCHED)}", name)
        chosen = names or SWITCHED
        return replace(self, effects=tuple(replace(e, forced=e.forced or e.name in chosen) for e in self.effects))

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as JSON values."""
        effects = {e.name: {"needed": e.needed, "simulated": e.simulated, "why": e.why} for e in self.effects}
        return {"effects": effects, "moves": list(self.moves), "opacity": list(self.opacity)}

    def __str__(self) -> str:
        """Return a table for people."""
        rows = [("effect", "needed", "why", "cost")]
        rows += [(e.name, "yes" if e.needed else "forced" if e.forced else "no", e.why, e.cost) for e in self.effects]
        lines = []
        for row in rows:
            cells = [textwrap.wrap(text, width) or [""] for text, width in zip(row, WIDTHS, strict=True)]
            for k in range(max(map(len, cells))):
                texts = (cell[k] if k < len(cell) else "" for cell in cells)
                lines.append("  ".join(text.ljust(width) for text, width in zip(texts, WIDTHS, strict=True)).rstrip())
            if row is rows[0]:
                lines.append("  ".join("-" * width for width in WIDTHS))
        return "\n".join(lines)


def plan_effects(
    scene: Scene, accuracy: Accuracy | None = None, *, shutter: Shutter | None = None, rays_per_pixel: int = 1
) -> EffectPlan:
    """Return which effects `scene` calls for, without rendering it.

    Args:
        scene: what would be rendered.
        accuracy, shutter, rays_per_pixel: as in `render`.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Source: ours.
    """
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    accuracy = Accuracy.exact() if accuracy is None else accuracy
    if not isinstance(accuracy, Accuracy):
        raise check.fail_type("accuracy", "an Accuracy", accuracy)
    shutter = Shutter.box() if shutter is None else shutter
    if not isinstance(shutter, Shutter):
        raise check.fail_type("shutter", "a Shutter", shutter)
    check.positive_int("rays_per_pixel", rays_per_pixel)
    size = scene.camera.width, scene.camera.height
    with torch.no_grad():
        prisms = build_prisms(scene, build_surfaces(scene), shutter.span(shutter.n_lines(*size)))
        return plan_prisms(scene, (prisms, survey_prisms(prisms, size)), accuracy, rays_per_pixel)


@torch.no_grad()
def plan_prisms(scene: Scene, seen: tuple[Prisms, Survey], accuracy: Accuracy, rays_per_pixel: int) -> EffectPlan:
    """Return the plan of a scene whose prisms and their survey are `seen`. Source: ours."""
    away = shows_back(seen[0], seen[1].facing)
    prisms, survey = seen
    if away.any():
        chosen = (~away).nonzero().flatten()
        names = ["t_open", "face_of", "is_clipped", "bounds_px", "corners_px"]  # what is told of them needs no more
        names += ["clip"] if accuracy.method != "exact" or prisms.is_clipped.any() else []
        prisms = replace(prisms, **{name: getattr(prisms, name)[..., chosen] for name in names})
        survey = survey.choose(chosen)
    surfaces = prisms.surfaces
    textures = [mesh.material.texture for mesh in scene.meshes]
    opacity = []
    for k, mesh in enumerate(scene.meshes):
        own = slice(surfaces.first_face[k], surfaces.first_face[k] + mesh.n_faces)
        is_textured = bool(surfaces.has_varying_opacity[own].any())
        opacity.append("textured" if is_textured else "opaque" if surfaces.is_opaque[own].all() else "constant")
    effects = (
        _motion(scene, prisms, survey),
        _transparency(prisms, survey),
        _texture(prisms, textures),
        _lighting(prisms),
        _shadows(prisms),
        _clipping(prisms),
        _facing(prisms, survey, int(away.sum())),
        _crossings(prisms, survey),
        _curvature(prisms, survey, accuracy),
        _rays(scene, rays_per_pixel),
    )
    return EffectPlan(effects, tuple(not scene.is_still(mesh) for mesh in scene.meshes), tuple(opacity))


def _motion(scene: Scene, prisms: Prisms, survey: Survey) -> Effect:
    moving = ~survey.is_still
    n_moving = int(moving.sum())
    if n_moving == 0:
        why = f"all {prisms.count:,} faces in view rest"
    else:
        n_segments = len(torch.unique(prisms.t_open)) if bool((prisms.t_open != prisms.t_open[0]).any()) else 1
        path = (prisms.corners_px[:, 3:] - prisms.corners_px[:, :3]).square().sum(0).nan_to_num(0.0)
        furthest = float(torch.where(moving, path, 0.0).max()) ** 0.5
        why = f"{n_moving:,} of {prisms.count:,} prisms move, by up to {furthest:.3g} px"
        why += f", in up to {n_segments} slices of time" if n_segments > 1 else ""
    width, height = scene.camera.width, scene.camera.height
    x0, y0, x1, y1 = prisms.bounds_px
    area = (x1.clamp(max=width) - x0.clamp(min=0)) * (y1.clamp(max=height) - y0.clamp(min=0))
    of_moving = float(torch.where(moving, area, 0.0).sum())
    areas = of_moving, float(area.sum()) - of_moving
    cost = "up to {:,.0f} rays solved in time, {:,.0f} at one instant".format(*areas)
    return Effect("motion", n_moving > 0, why, cost)


def _transparency(prisms: Prisms, survey: Survey) -> Effect:
    n = int((~survey.hides).sum())
    textured = int(prisms.surfaces.has_varying_opacity[prisms.face_of].sum())
    if n == 0:
        return Effect("transparency", False, "all faces in view are opaque", "what is behind them is left out")
    least = float(prisms.surfaces.opacity[prisms.face_of].min())
    why = f"{n:,} of {prisms.count:,} prisms let light through"
    why += f", {textured:,} by their texture" if textured else f", opacity from {least:.3g}"
    return Effect("transparency", True, why, "what is behind them is kept and composited")


def _texture(prisms: Prisms, textures: list) -> Effect:
    surfaces = prisms.surfaces
    is_textured = surfaces.is_textured[prisms.face_of]
    n = int(is_textured.sum())
    if n == 0:
        return Effect("texture", False, "no face in view has one", "none")
    texels = max(t.shape[0] * t.shape[1] for t in textures if t is not None)
    changing = is_textured & surfaces.is_varying[prisms.face_of]
    n_levels = len(surfaces.atlas.first)
    cost = "one look a slice of time: what has texture rests"
    if changing.any():
        uv = surfaces.uv[prisms.face_of]
        size = surfaces.atlas.size[0][:, surfaces.mesh_of[prisms.face_of]].to(uv)  # (2, P)
        extent = (uv.amax(1) - uv.amin(1)).T * size
        most = float(extent.sum(0)[changing].max())
        cost = f"up to {most:,.0f} lines of texels a face at the finest level, some nodes between each"
    return Effect("texture", True, f"{n:,} prisms, up to {texels:,} texels, {n_levels} levels", cost)


def _lighting(prisms: Prisms) -> Effect:
    surfaces = prisms.surfaces
    is_lit = surfaces.is_lit[prisms.face_of]
    n = int(is_lit.sum())
    if n == 0:
        return Effect("lighting", False, "no face in view is lit", "none")
    kinds = [type(light).__name__ for light in surfaces.lights]
    names = ", ".join(f"{kinds.count(k)} {k}" for k in dict.fromkeys(kinds)) or "ambient light alone"
    changing = int((is_lit & surfaces.is_varying[prisms.face_of]).sum())
    cost = f"{changing:,} prisms followed by each light" if changing and kinds else "one look a slice of time"
    return Effect("lighting", True, f"{n:,} prisms: {names}", cost)


def _shadows(prisms: Prisms) -> Effect:
    surfaces, casters = prisms.surfaces, prisms.surfaces.casters
    n = int(surfaces.is_lit[prisms.face_of].sum())
    n_lights = sum(light.casts_shadows for light in surfaces.lights)
    if casters is None or n == 0:
        return Effect("shadows", False, "no light casts any on what is in view", "none")
    why = f"{len(torch.unique(casters.face)):,} faces, in view or not, cast them on {n:,} prisms from {n_lights} lights"
    changes = "when each caster blocks each point that is seen, for each light"
    return Effect("shadows", True, why, changes if casters.moves else changes + "; only lights or what receives move")


def _clipping(prisms: Prisms) -> Effect:
    clipped = prisms.is_clipped.nonzero().flatten()
    if len(clipped) == 0:
        return Effect("clipping", False, "no prism reaches the near or the far plane", "none")
    clipped = prisms.clip[..., clipped]
    z, w = clipped[:, :, 2].flatten(0, 1), clipped[:, :, 3].flatten(0, 1)
    near, far = (int((side < 0).any(0).sum()) for side in (z + w, w - z))
    why = f"{near:,} prisms reach the near plane, {far:,} the far plane"
    return Effect("clipping", True, why, "their rays solve two cubics more")


def _facing(prisms: Prisms, survey: Survey, n_away: int) -> Effect:
    one_sided = prisms.surfaces.is_one_sided[prisms.face_of]
    turning = int((one_sided & (survey.facing == 0)).sum())
    cost = f"{n_away:,} prisms that show their backs are left out" if n_away else "none"
    if turning == 0:
        why = "every one-sided face shows one side" if n_away or one_sided.any() else "no face in view is one-sided"
        return Effect("facing", False, why, cost)
    return Effect("facing", True, f"{turning:,} one-sided prisms may turn or pass the eye", cost)


def _crossings(prisms: Prisms, survey: Survey) -> Effect:
    if survey.may_cross:
        why = "depths overlap in some part of screen and time"
        return Effect("crossings", True, why, "neighbours in depth compared in each slice of time")
    return Effect("crossings", False, "depths overlap nowhere in screen and time", "none")


def _curvature(prisms: Prisms, survey: Survey, accuracy: Accuracy) -> Effect:
    if accuracy.method == "exact":
        n = int(prisms.surfaces.is_varying[prisms.face_of].sum())
        why = f"the look of {n:,} of {prisms.count:,} prisms changes in time"
        return Effect("curvature", n > 0, why, "nodes by certificate" if n else "one look a slice of time")
    n = int((~_are_straight(prisms, survey)).sum())
    why = f"depth or texture of {n:,} of {prisms.count:,} prisms is not straight in time"
    cost = "chords" if accuracy.method == "linear" else "intervals cut until chords fit"
    return Effect("curvature", n > 0, why, cost if n else "none")


def _are_straight(prisms: Prisms, survey: Survey) -> Tensor:
    """Return (P,) whether z / w and the texture along every ray are straight in time for certain: those of faces that
    have one z / w, which does not change, and no texture or light.
    """
    depth = prisms.clip[:, :, 2] / torch.where(prisms.clip[:, :, 3] > 0, prisms.clip[:, :, 3], torch.nan)
    one_depth = (depth == depth[:1, :1]).all(0).all(0)
    plain = ~(prisms.surfaces.is_textured | prisms.surfaces.is_lit)[prisms.face_of]
    return plain & (one_depth | survey.is_still)


def _rays(scene: Scene, rays_per_pixel: int) -> Effect:
    why = f"{rays_per_pixel} a pixel, as asked for"
    n_rays = rays_per_pixel * scene.camera.width * scene.camera.height
    return Effect("rays", rays_per_pixel > 1, why, f"{n_rays:,} rays")


def agree_plan(effects: str | EffectPlan, own: EffectPlan) -> EffectPlan:
    """Return what to simulate of a scene whose plan is `own`, as the argument `effects` of `render` asks.

    Raises:
        ValueError: a plan that leaves out what this scene needs.

    Source: ours.
    """
    if isinstance(effects, str):
        return own.forcing() if effects == "all" else own
    missing = sorted(own.needed - effects.simulated)
    if missing:
        raise check.fail("effects", f"a plan with {', '.join(missing)}, which the scene needs", "one without")
    forced = [name for name in SWITCHED if effects[name].forced or name in effects.simulated - own.needed]
    return own.forcing(*forced) if forced else own


def check_effects(effects: Any) -> None:
    """Raise unless `effects` is "auto", "all" or a plan."""
    if not (isinstance(effects, EffectPlan) or (isinstance(effects, str) and effects in ("auto", "all"))):
        raise check.fail_type("effects", '"auto", "all" or an EffectPlan', effects)


def follow_plan(plan: EffectPlan, prisms: Prisms, survey: Survey, accuracy: Accuracy) -> tuple[Prisms, Survey, Tensor]:
    """Return prisms and survey in which everything counts as `plan` has it, and which prisms (C,) to look at.

    The approximations of texture and light depend on where cells are cut, so that there nothing is left out.

    Source: ours.
    """
    forced = {effect.name for effect in plan.effects if effect.forced}
    surfaces = prisms.surfaces
    never = torch.zeros_like(survey.is_still)
    if "curvature" in forced:
        always = torch.ones_like(surfaces.is_varying)
        prisms = replace(prisms, surfaces=replace(surfaces, is_varying=always, rests=~always))
    if "clipping" in forced:
        prisms = replace(prisms, is_clipped=~never)
    cuts_matter = accuracy.method != "exact" and bool((surfaces.is_textured | surfaces.is_lit).any())
    if "motion" in forced or cuts_matter:
        survey = replace(survey, is_still=never)
    if "transparency" in forced or cuts_matter:
        survey = replace(survey, hides=never)
    away = never if "facing" in forced else shows_back(prisms, survey.facing)
    return prisms, survey, (~away).nonzero().flatten()
