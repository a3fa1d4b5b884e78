"""Rigs: the vertices of a tree of moving nodes, with morph targets and skins, at any time.

Before: keyframes.py.  After: gltf_rigs.py (reads them), animated.py (plays them).
Symbols: N times [s], V vertices, J joints of a skin, K joints of a vertex, M morph targets.
Matrices act on columns. Source: the glTF 2.0 specification, section 3.7.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import torch
from torch import Tensor

from datagen.keyframes import Curve, rotations

BLOCK_NUMBERS = 16_000_000  # of matrices and vertices at a time; bounds the memory at about 300 MB


@dataclass(frozen=True, eq=False)
class Node:
    """A node's place under its parent: a matrix, or translation, rotation and scale in that order."""

    parent: int  # number of its parent, -1 for none
    translation: Tensor  # (3,) float64
    rotation: Tensor  # (4,) float64 unit quaternion
    scale: Tensor  # (3,) float64
    matrix: Tensor | None = None  # (4, 4) float64, in place of these


@dataclass(frozen=True, eq=False)
class Skin:
    """Joints that move vertices; the node that a skinned mesh hangs on does not."""

    joints: tuple[int, ...]  # J numbers of nodes
    inverse_binds: Tensor  # (J, 4, 4) float64


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh on a node."""

    node: int
    vertices: Tensor  # (V, 3) float64
    targets: Tensor | None = None  # (M, V, 3) float64, added by weight
    weights: Tensor | None = None  # (M,) float64, of the targets while no curve gives others
    skin: Skin | None = None
    joint_of: Tensor | None = None  # (V, K) int64 places in the skin's joints
    share_of: Tensor | None = None  # (V, K) float64, rows sum to 1


@dataclass(frozen=True, eq=False)
class Take:
    """One animation of a rig: curves by (node, property), the property as glTF names it."""

    name: str
    curves: dict[tuple[int, str], Curve] = field(default_factory=dict)

    @property
    def keys_s(self) -> Tensor:
        """The (T,) times of all keys, increasing [s]."""
        times = [curve.times_s for curve in self.curves.values()]
        return torch.cat(times).unique() if times else torch.zeros(1, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Rig:
    """Nodes and what hangs on them."""

    nodes: tuple[Node, ...]
    order: tuple[int, ...]  # numbers of all nodes, parents before children
    parts: tuple[Part, ...]

    @property
    def n_vertices(self) -> int:
        """Number of vertices of all parts."""
        return sum(len(part.vertices) for part in self.parts)

    @functools.cached_property
    def work(self) -> int:
        """About how many nanoseconds a pose takes: a measure of size, not of time."""
        numbers = 2_000 * len(self.nodes) + 15_000 * len(self.parts)
        for part in self.parts:
            targets = 0 if part.targets is None else len(part.targets)
            joints = 0 if part.joint_of is None else part.joint_of.shape[1]
            numbers += len(part.vertices) * (1 + targets + 10 * joints)
        return numbers

    @functools.cached_property
    def _rest(self) -> Tensor:
        """The (nodes, 4, 4) matrices under the parents while nothing moves."""
        none = torch.zeros(1, dtype=torch.float64)
        return torch.cat([_local(node, k, Take(""), none) for k, node in enumerate(self.nodes)])

    @functools.cached_property
    def _levels(self) -> list[tuple[list[int], list[int]]]:
        """The nodes that have parents, level by level, and these parents."""
        depth = [0] * len(self.nodes)
        levels: list[tuple[list[int], list[int]]] = []
        for number in self.order:
            parent = self.nodes[number].parent
            if parent < 0:
                continue
            depth[number] = depth[parent] + 1
            if depth[number] > len(levels):
                levels.append(([], []))
            levels[depth[number] - 1][0].append(number)
            levels[depth[number] - 1][1].append(parent)
        return levels

    def at(self, take: Take, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 world positions at times (N,) [s] of the take. Source: glTF, section 3.7."""
        skins = {id(part.skin): len(part.skin.joints) for part in self.parts if part.skin is not None}
        numbers = 16 * (len(self.nodes) + sum(skins.values())) + 40 * self.n_vertices
        blocks = times_s.to(torch.float64).split(max(1, BLOCK_NUMBERS // numbers))
        return torch.cat([self._block(take, block) for block in blocks])

    def _block(self, take: Take, times_s: Tensor) -> Tensor:
        """Return `at` of a few times."""
        worlds = self._worlds(take, times_s)
        palettes: dict[int, Tensor] = {}
        found = []
        for part in self.parts:
            local = _morphed(part, take, times_s)
            skin = part.skin
            if skin is None:
                matrices = worlds[:, part.node]
                found.append(local @ matrices[:, :3, :3].transpose(1, 2) + matrices[:, None, :3, 3])
                continue
            if id(skin) not in palettes:
                palettes[id(skin)] = (worlds[:, list(skin.joints)] @ skin.inverse_binds)[:, :, :3]
            found.append(_skinned(local, palettes[id(skin)], part))
        return torch.cat(found, 1)

    def _worlds(self, take: Take, times_s: Tensor) -> Tensor:
        """Return (N, nodes, 4, 4) world matrices."""
        worlds = self._rest.repeat(len(times_s), 1, 1, 1)
        for number in {number for number, name in take.curves if name != "weights"}:
            worlds[:, number] = _local(self.nodes[number], number, take, times_s)
        for children, parents in self._levels:
            worlds[:, children] = worlds[:, parents] @ worlds[:, children]
        return worlds


def _local(node: Node, number: int, take: Take, times_s: Tensor) -> Tensor:
    """Return the (N or 1, 4, 4) matrices of a node under its parent."""
    if node.matrix is not None:
        return node.matrix.unsqueeze(0)
    values = {}
    for name in ("translation", "rotation", "scale"):
        curve = take.curves.get((number, name))
        values[name] = getattr(node, name).unsqueeze(0) if curve is None else curve.at(times_s)
    n = max(len(value) for value in values.values())
    matrix = torch.zeros((n, 4, 4), dtype=torch.float64)
    matrix[:, :3, :3] = rotations(values["rotation"]) * values["scale"].unsqueeze(-2)
    matrix[:, :3, 3] = values["translation"]
    matrix[:, 3, 3] = 1
    return matrix


def _morphed(part: Part, take: Take, times_s: Tensor) -> Tensor:
    """Return (N, V, 3) vertices of a part before its node or skin places them."""
    if part.targets is None:
        return part.vertices.expand(len(times_s), -1, -1)
    curve = take.curves.get((part.node, "weights"))
    if curve is None:
        assert part.weights is not None
        weights = part.weights.expand(len(times_s), -1)
    else:
        weights = curve.at(times_s)
    return part.vertices + torch.einsum("nm,mvc->nvc", weights, part.targets)


def _skinned(local: Tensor, palette: Tensor, part: Part) -> Tensor:
    """Return (N, V, 3) vertices moved by the mean of their joints' matrices (N, J, 3, 4), by share."""
    assert part.joint_of is not None
    assert part.share_of is not None
    mixed = torch.zeros((*local.shape[:2], 3, 4), dtype=torch.float64)
    for joints, shares in zip(part.joint_of.unbind(1), part.share_of.unbind(1), strict=True):
        mixed += palette[:, joints] * shares[:, None, None]
    return (mixed[..., :3] @ local.unsqueeze(-1)).squeeze(-1) + mixed[..., 3]
