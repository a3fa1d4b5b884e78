"""Animated assets: files whose mesh moves by itself, brought to one size and played in a clip.

Before: assets.py, gltf_rigs.py, usd_files.py, motions.py.  After: rosters.py, scenes.py.
Symbols: N times [s], V vertices, F faces. Poses are computed at the very times that are asked for; nothing is baked.
Source: ours.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from datagen.assets import SMALLEST_EXTENT, check_geometry, file_state, has_area, split_looks
from datagen.formats import MeshError, Surface, short_reason
from datagen.gltf import GltfFile
from datagen.gltf_rigs import read_rig
from datagen.motions import MAX_KINKS, RigidMotion
from datagen.rigs import Rig, Take
from datagen.usd_files import USD_SUFFIXES, UsdMeshes, read_usd

GLTF_SUFFIXES = (".gltf", ".glb")
ANIMATED_SUFFIXES = (*GLTF_SUFFIXES, *USD_SUFFIXES)
EVEN_PROBES = 33  # instants at which an animation is measured, beside its keys
KEY_PROBES = 64  # at most that many keys
AT_ONCE = 1_000_000  # vertices of all instants that are held at a time; bounds the memory at about 100 MB
SAME_POSE = 1e-3  # share of the radius by which the last pose may differ from the first in a round
SHORTEST_S = 1e-3  # a shorter animation stands still: it would play faster than any shutter


class Pose(Protocol):
    """A mesh that moves by itself."""

    keys_s: Tensor  # (T,) increasing times at which its velocity may jump, T >= 1 [s]

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 positions at times (N,) [s]."""


@dataclass(frozen=True, eq=False)
class RigPose:
    """A take of a rig."""

    rig: Rig
    take: Take

    @functools.cached_property
    def keys_s(self) -> Tensor:
        """The (T,) times of its keys [s]."""
        return self.take.keys_s

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 positions at times (N,) [s]. Source: ours."""
        return self.rig.at(self.take, times_s)


@dataclass(frozen=True, eq=False)
class UsdPose:
    """The meshes of a USD file."""

    meshes: UsdMeshes

    @functools.cached_property
    def keys_s(self) -> Tensor:
        """The (T,) times of its samples [s]."""
        return torch.from_numpy(self.meshes.keys_s)

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 positions at times (N,) [s]. Source: ours."""
        return torch.stack([torch.from_numpy(self.meshes.at(time_s)) for time_s in times_s.tolist()])


@dataclass(frozen=True, eq=False)
class Action:
    """One of a file's animations, its name, and where it happens."""

    name: str
    pose: Pose
    centre: Tensor  # (3,) middle of where it goes
    radius: float  # of a ball about it that holds the vertices at all instants that were measured
    is_round: bool  # it ends as it starts

    @property
    def length_s(self) -> float:
        """How long it lasts [s]; 0 for what stands still."""
        length = float(self.pose.keys_s[-1] - self.pose.keys_s[0])
        return length if length >= SHORTEST_S else 0.0


@dataclass(frozen=True, eq=False)
class AnimatedAsset:
    """What a file holds."""

    name: str
    actions: tuple[Action, ...]  # at least one
    faces: Tensor  # (F, 3) int64
    color: Tensor | None  # (F, 3) float64 linear, or none in the file
    opacity: Tensor | None  # (F,) float64, or none in the file
    notes: tuple[str, ...]  # what in the file is not used
    sha256: str  # of all bytes that were read


@dataclass(frozen=True, eq=False)
class PlayedAction:
    """An action that plays on at its own rate while its whole body moves: round and round if it ends as it starts,
    else back and forth.
    """

    action: Action
    start_s: float  # place in the action, or on its way back, at time 0 [s]
    size: float  # radius in the scene [scene units]
    motion: RigidMotion

    @property
    def is_static(self) -> bool:
        """Whether nothing ever moves."""
        return self.action.length_s == 0 and self.motion.is_static

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 world positions at times (N,) [s].

        Raises:
            MeshError: the animation leaves all bounds between the instants at which it was measured.

        Source: ours.
        """
        times, action = times_s.to(torch.float64), self.action
        places = action.pose.keys_s[0] + self._folded(times)
        positions = (action.pose.at(places) - action.centre) * (self.size / action.radius)
        if not bool((positions.abs() <= 1e6).all()):
            raise MeshError(action.name, "expected an animation that stays finite, got one that does not")
        return self.motion.place(positions, times)

    def resting(self) -> Tensor:
        """Return the (V, 3) float64 places of the first key, before the whole body moves [scene units]."""
        action = self.action
        return (action.pose.at(action.pose.keys_s[:1])[0] - action.centre) * (self.size / action.radius)

    def kinks_s(self, open_s: float, close_s: float) -> list[float]:
        """Return the times strictly inside the window at which a key or a turn is reached, MAX_KINKS at most [s].

        Source: ours.
        """
        length, action = self.action.length_s, self.action
        if length == 0:
            return []
        keys = action.pose.keys_s - action.pose.keys_s[0]
        period = length if action.is_round else 2 * length
        places = keys if action.is_round else torch.cat([keys, (period - keys).flip(0)])
        first = int((open_s + self.start_s) // period)
        last = min(int((close_s + self.start_s) // period), first + MAX_KINKS)
        found: set[float] = set()
        for turn in range(first, last + 1):
            times = places + (turn * period - self.start_s)
            found |= set(times[(times > open_s) & (times < close_s)].tolist())
        ordered = sorted(found)
        return ordered[:: -(-len(ordered) // MAX_KINKS)] if ordered else []

    def _folded(self, times_s: Tensor) -> Tensor:
        """Return places (N,) in the action [s], counted from its first key."""
        length = self.action.length_s
        if length == 0:
            return torch.zeros_like(times_s)
        phase = torch.remainder(times_s + self.start_s, length if self.action.is_round else 2 * length)
        return torch.where(phase > length, 2 * length - phase, phase)


def is_animated(path: str | Path) -> bool:
    """Tell whether a file is for `load_animated`: USD, or glTF whose mesh moves or is skinned.

    Raises:
        MeshError: it cannot be read.

    Source: ours.
    """
    place = Path(path)
    if place.suffix.lower() not in GLTF_SUFFIXES:
        return place.suffix.lower() in USD_SUFFIXES
    return _is_animated(str(path), file_state(place))


def load_animated(path: str) -> AnimatedAsset:
    """Return an animated file, checked and measured; one that has not changed since is not read again.

    Raises:
        MeshError: it cannot be used.

    Source: ours.
    """
    return _load_animated(path, file_state(Path(path)))


@functools.lru_cache(maxsize=64)
def _is_animated(path: str, state: tuple[int, int]) -> bool:
    """Return `is_animated` of a file in a certain state."""
    tree = GltfFile(Path(path)).tree
    return any(tree.get(name) for name in ("animations", "skins"))


@functools.lru_cache(maxsize=4)  # clips of a worker draw from the same few files
def _load_animated(path: str, state: tuple[int, int]) -> AnimatedAsset:
    """Return the asset of a file in a certain state."""
    place = Path(path)
    try:
        return _usd_asset(place) if place.suffix.lower() in USD_SUFFIXES else _gltf_asset(place)
    except MeshError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, RuntimeError, RecursionError) as error:
        raise MeshError(path, f"expected a readable {place.suffix} file, got {short_reason(error)}") from None


def _gltf_asset(path: Path) -> AnimatedAsset:
    """Return the asset of a glTF file."""
    file = GltfFile(path)
    read = read_rig(file)
    poses = [(take.name, RigPose(read.rig, take)) for take in read.takes]
    return _asset(path, poses, read.surface, file.digest.hexdigest())


def _usd_asset(path: Path) -> AnimatedAsset:
    """Return the asset of a USD file."""
    read = read_usd(path)
    return _asset(path, [("time samples", UsdPose(read))], read.surface, read.sha256)


def _asset(path: Path, poses: Sequence[tuple[str, Pose]], surface: Surface, sha256: str) -> AnimatedAsset:
    """Return the asset of a surface and its named poses."""
    faces = torch.from_numpy(surface.faces)
    actions = tuple(measure(path, name, pose, faces) for name, pose in poses)
    color, opacity = split_looks(surface.rgba)
    return AnimatedAsset(path.name, actions, faces, color, opacity, surface.notes, sha256)


def measure(path: Path, name: str, pose: Pose, faces: Tensor) -> Action:
    """Return a pose as an action: checked and measured at even instants and at its keys.

    Args:
        path: of the file, for messages.
        name: of the animation.
        pose: to be measured.
        faces: (F, 3).

    Raises:
        MeshError: it is not finite, too large, or has no extent.

    Source: ours.
    """
    keys = pose.keys_s
    even = torch.linspace(float(keys[0]), float(keys[-1]), EVEN_PROBES, dtype=torch.float64)
    times = torch.cat([even, keys[:: -(-len(keys) // KEY_PROBES)]]).unique()
    blocks = times.split(max(1, AT_ONCE // pose.at(times[:1]).shape[1]))
    corners = []
    for block in blocks:
        positions = pose.at(block)
        check_geometry(path, positions.reshape(-1, 3).numpy(), faces.numpy(), positions.shape[1])
        corners += [positions.amin((0, 1)), positions.amax((0, 1))]
    low, high = torch.stack(corners).amin(0), torch.stack(corners).amax(0)
    centre, half = (low + high) / 2, float((high - low).norm()) / 2
    if not half > SMALLEST_EXTENT:
        raise MeshError(path, f"vertices: expected some extent, got a radius of {half:g}")
    radius, is_flat, first, last = 0.0, True, None, None
    for block in blocks:
        positions = pose.at(block) - centre
        radius = max(radius, float(positions.norm(dim=-1).max()))
        is_flat = is_flat and not any(has_area((frame / half)[faces]) for frame in positions)
        first, last = positions[0] if first is None else first, positions[-1]
    if is_flat:
        raise MeshError(path, "faces: expected a triangle with an area, got none")
    assert first is not None
    assert last is not None
    is_round = float((first - last).norm(dim=-1).max()) <= SAME_POSE * radius
    return Action(name, pose, centre, radius, is_round)
