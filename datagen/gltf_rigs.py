"""glTF rigs: the nodes, meshes, skins and animations of a glTF file as a rig.

Before: gltf.py, gltf_looks.py, rigs.py.  After: animated.py.
Morph targets move positions only: normals follow from the moving faces. Cameras, lights and lines are passed over.
Source: the glTF 2.0 specification, sections 3.5 to 3.7 and 3.11.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.formats import MAX_PLAYED_FACES, MAX_PLAYED_VERTICES, Surface, join_parts
from datagen.gltf import GltfFile
from datagen.gltf_looks import face_looks
from datagen.gltf_takes import n_targets, read_takes, unit_quaternion
from datagen.rigs import Node, Part, Rig, Skin, Take

MAX_NODES = 4096
MAX_WORK = 100_000_000  # of all animations, as `Rig.work`: each is measured at some 100 instants, twice
TRIANGLES, STRIP, FAN = 4, 5, 6


@dataclass(frozen=True, eq=False)
class RigFile:
    """What a file holds: V vertices of all parts, one after the other."""

    rig: Rig
    takes: tuple[Take, ...]  # at least one
    surface: Surface


def read_rig(file: GltfFile) -> RigFile:
    """Return the rig of a file's scene.

    Raises:
        MeshError: it is not as the format has it, or too large.

    Source: the glTF 2.0 specification.
    """
    notes: list[str] = []
    nodes, order = _nodes(file)
    takes = read_takes(file, nodes, notes)
    shown, parts, faces, looks, start = _shown(file, nodes, order), [], [], [], 0
    skins: dict[int, Skin] = {}
    for number in shown:
        entry = file.item("nodes", number)
        if "mesh" not in entry:
            continue
        mesh = file.item("meshes", entry["mesh"])
        for k, primitive in enumerate(file.listed("primitives", mesh)):
            name = f"meshes[{entry['mesh']}].primitives[{k}]"
            made = _part(file, number, (mesh, file.mapping(name, primitive), name), skins)
            if made is None:
                notes.append(f"{name} has no triangles and is not read")
                continue
            part, triangles = made
            parts.append(part)
            faces.append(triangles + start)
            start += len(part.vertices)
            if start > MAX_PLAYED_VERTICES or sum(map(len, faces)) > MAX_PLAYED_FACES:
                raise file.fail(
                    f"expected at most {MAX_PLAYED_VERTICES} vertices and {MAX_PLAYED_FACES} faces, got more"
                )
            looks.append(face_looks(file, primitive, triangles, len(part.vertices)))
    if not parts or not sum(map(len, faces)):
        raise file.fail("expected triangles, got none")
    rig = Rig(nodes, order, tuple(parts))
    if sum(rig.work + 2_000 * len(take.curves) for take in takes) > MAX_WORK:
        size = f"{len(nodes)} nodes, {rig.n_vertices} vertices and {len(takes)} animations"
        raise file.fail(f"expected nodes, vertices with their joints and targets, and animations in bounds, got {size}")
    return RigFile(rig, takes, join_parts(faces, looks, notes))


def _nodes(file: GltfFile) -> tuple[tuple[Node, ...], tuple[int, ...]]:
    """Return all nodes, and their numbers with parents before children."""
    entries = [file.mapping(f"nodes[{k}]", entry) for k, entry in enumerate(file.listed("nodes"))]
    if not 0 < len(entries) <= MAX_NODES:
        raise file.fail(f"nodes: expected 1 to {MAX_NODES}, got {len(entries)}")
    parents = [-1] * len(entries)
    children: list[list[int]] = []
    for number, entry in enumerate(entries):
        mine = [file.whole(f"nodes[{number}].children", c, len(entries) - 1) for c in file.listed("children", entry)]
        for child in mine:
            if parents[child] >= 0:
                raise file.fail(f"nodes[{child}]: expected one parent, got {parents[child]} and {number}")
            parents[child] = number
        children.append(mine)
    order = [number for number, parent in enumerate(parents) if parent < 0]
    for number in order:  # grows while it is walked
        order += children[number]
    if len(order) < len(entries):
        raise file.fail(f"nodes: expected a tree, got a circle among {len(entries) - len(order)} nodes")
    return tuple(_node(file, n, e, parents[n]) for n, e in enumerate(entries)), tuple(order)


def _node(file: GltfFile, number: int, entry: dict[str, Any], parent: int) -> Node:
    """Return one node."""
    name = f"nodes[{number}]"
    matrix = None
    if "matrix" in entry:  # by columns
        matrix = torch.from_numpy(file.numbers(f"{name}.matrix", entry["matrix"], 16).reshape(4, 4).T.copy())
        if matrix[3].tolist() != [0, 0, 0, 1]:
            raise file.fail(f"{name}.matrix: expected a last row of 0, 0, 0, 1, got {matrix[3].tolist()}")
    values = []
    for key, default in (("translation", [0, 0, 0]), ("rotation", [0, 0, 0, 1]), ("scale", [1, 1, 1])):
        values.append(torch.from_numpy(file.numbers(f"{name}.{key}", entry.get(key, default), len(default))))
    return Node(parent, values[0], unit_quaternion(file, f"{name}.rotation", values[1]), values[2], matrix)


def _shown(file: GltfFile, nodes: tuple[Node, ...], order: tuple[int, ...]) -> list[int]:
    """Return the numbers of the nodes of the scene that is shown, sorted; of all nodes if there is no scene."""
    if not file.listed("scenes"):
        return sorted(order)
    scene = file.item("scenes", file.tree.get("scene", 0))
    inside = {file.whole("scenes.nodes", number, len(nodes) - 1) for number in file.listed("nodes", scene)}
    for number in order:
        if nodes[number].parent in inside:
            inside.add(number)
    return sorted(inside)


def _part(
    file: GltfFile, number: int, where: tuple[dict[str, Any], dict[str, Any], str], skins: dict[int, Skin]
) -> tuple[Part, np.ndarray] | None:
    """Return a primitive on a node and its (F, 3) faces, or None if it has no triangles."""
    _, primitive, name = where
    attributes = file.mapping(f"{name}.attributes", primitive.get("attributes"))
    mode = primitive.get("mode", TRIANGLES)
    if mode not in (TRIANGLES, STRIP, FAN) or "POSITION" not in attributes:
        return None
    vertices = file.accessor(attributes["POSITION"], ("VEC3",))
    if "indices" in primitive:
        indices = file.accessor(primitive["indices"], ("SCALAR",), whole=True)[:, 0]
    else:
        indices = np.arange(len(vertices))
    faces = _triangles(indices, mode)
    if not len(faces):
        return None
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise file.fail(f"{name}: faces: expected indices in [0, {len(vertices)}), got {faces.max()}")
    targets, weights = _targets(file, number, where, len(vertices))
    skin, joint_of, share_of = None, None, None
    entry = file.item("nodes", number)
    if "skin" in entry:
        index = file.whole(f"nodes[{number}].skin", entry["skin"], len(file.listed("skins")) - 1)
        if index not in skins:
            skins[index] = _skin(file, index)
        skin = skins[index]
        joint_of, share_of = _joints(file, name, attributes, (len(vertices), len(skin.joints)))
    return Part(number, torch.from_numpy(vertices), targets, weights, skin, joint_of, share_of), faces


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """Return (F, 3) triangles of a list, strip or fan; a strip's odd ones are turned round to face as the even ones."""
    if mode == TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    count = max(len(indices) - 2, 0)
    steps = np.arange(count)
    if mode == FAN:
        return np.stack([np.full(count, indices[0] if count else 0), indices[steps + 1], indices[steps + 2]], 1)
    odd = steps % 2
    return np.stack([indices[steps], indices[steps + 1 + odd], indices[steps + 2 - odd]], 1)


def _targets(
    file: GltfFile, number: int, where: tuple[dict[str, Any], dict[str, Any], str], n_vertices: int
) -> tuple[Tensor | None, Tensor | None]:
    """Return the morph targets (M, V, 3) of a primitive and their weights (M,) at rest, or None and None."""
    mesh, primitive, name = where
    count = n_targets(file, number)
    entries = file.listed("targets", primitive)
    if len(entries) != count:
        raise file.fail(f"{name}.targets: expected {count} as its mesh's first primitive, got {len(entries)}")
    if not count:
        return None, None
    file.reserve(count * n_vertices * 3)
    moved = []
    for k, entry in enumerate(entries):
        target = file.mapping(f"{name}.targets[{k}]", entry)
        rows = np.zeros((n_vertices, 3))
        if "POSITION" in target:
            rows = file.accessor(target["POSITION"], ("VEC3",))
        if len(rows) != n_vertices:
            raise file.fail(f"{name}.targets[{k}]: expected {n_vertices} rows, got {len(rows)}")
        moved.append(rows)
    own = file.item("nodes", number)
    weights = own.get("weights", mesh.get("weights", [0] * count))
    return torch.from_numpy(np.stack(moved)), torch.from_numpy(file.numbers("weights", weights, count))


def _skin(file: GltfFile, index: Any) -> Skin:
    """Return a skin."""
    entry, name = file.item("skins", index), f"skins[{index}]"
    last = len(file.listed("nodes")) - 1
    joints = tuple(file.whole(f"{name}.joints", joint, last) for joint in file.listed("joints", entry))
    if not 0 < len(joints) <= MAX_NODES:
        raise file.fail(f"{name}.joints: expected 1 to {MAX_NODES}, got {len(joints)}")
    binds = np.eye(4).reshape(1, 16).repeat(len(joints), 0)
    if "inverseBindMatrices" in entry:
        binds = file.accessor(entry["inverseBindMatrices"], ("MAT4",))
        if len(binds) < len(joints):
            raise file.fail(f"{name}.inverseBindMatrices: expected {len(joints)}, got {len(binds)}")
    matrices = binds[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).copy()
    return Skin(joints, torch.from_numpy(matrices))


def _joints(file: GltfFile, name: str, attributes: dict[str, Any], sizes: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return the joints (V, K) of each vertex and their shares, which sum to 1; of 0 in all, the first joint has 1."""
    n_vertices, n_joints = sizes
    joints, shares = [], []
    while f"JOINTS_{len(joints)}" in attributes:
        k = len(joints)
        joints.append(file.accessor(attributes[f"JOINTS_{k}"], ("VEC4",), whole=True))
        shares.append(file.accessor(attributes.get(f"WEIGHTS_{k}"), ("VEC4",)))
        for rows in (joints[-1], shares[-1]):
            if len(rows) != n_vertices:
                raise file.fail(f"{name}: expected {n_vertices} rows of joints and weights, got {len(rows)}")
    if not joints:
        raise file.fail(f"{name}.JOINTS_0: expected joints for a skin, got none")
    joint_of, share_of = np.concatenate(joints, 1), np.concatenate(shares, 1)
    if (share_of < 0).any():
        raise file.fail(f"{name}.WEIGHTS_0: expected weights of at least 0, got {share_of.min():g}")
    used = np.where(share_of > 0, joint_of, 0)  # files leave anything beside a weight of 0
    if used.max(initial=0) >= n_joints:
        raise file.fail(f"{name}.JOINTS_0: expected indices in [0, {n_joints}), got {used.max()}")
    total = share_of.sum(1, keepdims=True)
    share_of = np.where(total > 0, share_of / np.where(total > 0, total, 1), np.eye(1, share_of.shape[1]))
    return torch.from_numpy(used), torch.from_numpy(share_of)
