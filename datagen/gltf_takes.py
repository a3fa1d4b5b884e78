"""glTF takes: the animations of a glTF file as curves.

Before: gltf.py, rigs.py.  After: gltf_rigs.py.
Source: the glTF 2.0 specification, section 3.11.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from datagen.gltf import GltfFile
from datagen.keyframes import SMALLEST_NORM, Curve
from datagen.rigs import Node, Take

MAX_TAKES = 256
WIDTH_OF = {"translation": 3, "rotation": 4, "scale": 3}
KINDS = ("LINEAR", "STEP", "CUBICSPLINE")


def read_takes(file: GltfFile, nodes: tuple[Node, ...], notes: list[str]) -> tuple[Take, ...]:
    """Return the animations, or one without movement if there is none.

    Args:
        file: the file.
        nodes: its nodes.
        notes: what is not read is added here.

    Raises:
        MeshError: they are not as the format has them.

    Source: the glTF 2.0 specification, section 3.11.
    """
    entries = file.listed("animations")
    if len(entries) > MAX_TAKES:
        raise file.fail(f"animations: expected at most {MAX_TAKES}, got {len(entries)}")
    takes = []
    for index, entry in enumerate(entries):
        animation = file.mapping(f"animations[{index}]", entry)
        curves = {}
        samplers = file.listed("samplers", animation)
        for k, channel in enumerate(file.listed("channels", animation)):
            name = f"animations[{index}].channels[{k}]"
            target = file.mapping(f"{name}.target", file.mapping(name, channel).get("target"))
            path, number = target.get("path"), target.get("node")
            if number is None or not isinstance(path, str) or path not in (*WIDTH_OF, "weights"):
                notes.append(f"{name} moves {str(path)[:40]!r}, which is not read")
                continue
            number = file.whole(f"{name}.target.node", number, len(nodes) - 1)
            if nodes[number].matrix is not None and path in WIDTH_OF:
                raise file.fail(f"{name}: expected a node without a matrix, got nodes[{number}], which has one")
            if (number, path) in curves:
                raise file.fail(f"{name}: expected one channel for {path} of nodes[{number}], got two")
            width = WIDTH_OF.get(path) or n_targets(file, number)
            if not width:
                raise file.fail(f"{name}: expected a mesh with morph targets, got none on nodes[{number}]")
            place = file.whole(f"{name}.sampler", channel.get("sampler"), len(samplers) - 1)
            curves[number, path] = _curve(file, name, file.mapping(f"{name}.sampler", samplers[place]), (path, width))
        takes.append(Take(str(animation.get("name", f"animation {index}"))[:80], curves))
    return tuple(takes) or (Take("rest pose"),)


def n_targets(file: GltfFile, number: int) -> int:
    """Return how many morph targets the mesh of a node has. Source: glTF, section 3.7.2.2."""
    entry = file.item("nodes", number)
    if "mesh" not in entry:
        return 0
    primitives = file.listed("primitives", file.item("meshes", entry["mesh"]))
    return len(file.listed("targets", file.mapping("primitives[0]", primitives[0]))) if primitives else 0


def unit_quaternion(file: GltfFile, name: str, values: Tensor) -> Tensor:
    """Return quaternions (..., 4) scaled to 1, or raise MeshError if one has no direction. Source: ours."""
    norm = values.norm(dim=-1, keepdim=True)
    if not bool((norm > SMALLEST_NORM).all()):
        raise file.fail(f"{name}: expected quaternions with a direction, got one of length {float(norm.min()):g}")
    return values / norm


def _curve(file: GltfFile, name: str, sampler: dict[str, Any], what: tuple[str, int]) -> Curve:
    """Return the curve of a channel that moves a property of some width."""
    path, width = what
    kind = sampler.get("interpolation", "LINEAR")
    if kind not in KINDS:
        raise file.fail(f"{name}.interpolation: expected one of {', '.join(KINDS)}, got {str(kind)[:40]}")
    times = torch.from_numpy(file.accessor(sampler.get("input"), ("SCALAR",))[:, 0])
    if not len(times) or float(times[0]) < 0 or bool((times.diff() <= 0).any()):
        raise file.fail(f"{name}.input: expected times that grow from at least 0 on, got others")
    kinds = (f"VEC{width}",) if path in WIDTH_OF else ("SCALAR",)
    rows = file.accessor(sampler.get("output"), kinds)
    values = torch.from_numpy(rows)
    per_key = 3 if kind == "CUBICSPLINE" else 1
    if values.numel() != len(times) * per_key * width:
        wanted = len(times) * per_key * (1 if path in WIDTH_OF else width)
        raise file.fail(f"{name}.output: expected {wanted} rows for {len(times)} keys, got {len(values)}")
    values = values.reshape(len(times), per_key, width)
    middle = values[:, per_key // 2]
    is_rotation = path == "rotation"
    if is_rotation:
        middle = unit_quaternion(file, f"{name}.output", middle)
    if kind != "CUBICSPLINE":
        return Curve(times, middle, kind, is_rotation=is_rotation)
    return Curve(times, middle, kind, values[:, 0], values[:, 2], is_rotation)
