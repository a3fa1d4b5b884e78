"""USD files: meshes whose points and transforms have time samples (the only door to pxr; extra `usd`).

Before: formats.py.  After: animated.py, rosters.py.
Symbols: V vertices, F triangles; points are rows here, and USD's matrices act on rows.
Read: points, transforms, displayColor, displayOpacity. Not read, which the notes say: materials, subdivision,
skeletons, instancers. Layers that a file is composed of are read under its own folder only.
USD's library is not ours and parses what strangers wrote: `vet_usd` tries a file in a process that may die.
Source: OpenUSD's documentation of UsdGeomMesh, UsdGeomXformable and value resolution (linear between samples).
"""

from __future__ import annotations

import hashlib
import importlib.util
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.formats import (
    MAX_FILE_BYTES,
    MAX_PLAYED_FACES,
    MAX_PLAYED_VERTICES,
    NO_LOOK,
    MeshError,
    Surface,
    check_size,
    join_parts,
    short_reason,
)

USD_SUFFIXES = (".usd", ".usda", ".usdc")
MAX_LAYERS = 64
MAX_SAMPLES = 100_000  # times of all attributes together
MAX_USD_VALUE = 1e6  # of a coordinate, as for all meshes
VET_TIMES = 33  # instants at which a file is tried
VET_SECONDS = 60
VET_BYTES = 2 * 2**30  # of address space


@dataclass(frozen=True, eq=False)
class UsdMeshes:
    """What a file holds, its meshes one after the other, with y up."""

    keys_s: np.ndarray  # (T,) float64, the times of all samples, at least one
    at: Callable[[float], np.ndarray]  # time [s] -> (V, 3) float64 world positions
    surface: Surface
    sha256: str  # of all files that were read


def read_usd(path: Path) -> UsdMeshes:
    """Return the meshes of a file.

    Raises:
        MeshError: it cannot be used, or the package is not installed.

    Source: ours.
    """
    if importlib.util.find_spec("pxr") is None:
        raise MeshError(path, "expected the package usd-core (pip install 'torchblur[usd]'), got none")
    check_size(path)
    from pxr import Tf

    try:
        return _read(path)
    except MeshError:
        raise
    except (Tf.ErrorException, RuntimeError, ValueError, TypeError, IndexError, OverflowError) as error:
        try:
            reason = short_reason(error)
        except UnicodeDecodeError:  # the library quotes bytes of the file as if they were text
            reason = type(error).__name__
        raise MeshError(path, f"expected a readable {path.suffix} file, got {reason}") from None


def vet_usd(path: Path) -> None:
    """Read a file in a process of its own, with bounds on its time and memory.

    Raises:
        MeshError: it cannot be used, or the process died.

    Source: ours.
    """
    places = {"PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)}  # noqa: PTH109
    words = [sys.executable, "-m", "datagen.usd_files", str(path)]
    try:
        done = subprocess.run(
            words,
            env=os.environ | places,
            capture_output=True,
            timeout=VET_SECONDS,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        raise MeshError(path, f"expected a file that is read within {VET_SECONDS} s, got a slower one") from None
    if done.returncode == 2:
        raise MeshError(path, done.stdout.decode(errors="replace").strip()[:400])
    if done.returncode != 0:
        raise MeshError(path, f"expected a readable {path.suffix} file, got a reader that ended with {done.returncode}")


def _read(path: Path) -> UsdMeshes:
    """Return `read_usd`, with the errors of the library."""
    from pxr import Usd, UsdGeom

    layer, digest = _checked_layers(path)
    stage = Usd.Stage.Open(layer)
    rate = stage.GetTimeCodesPerSecond()
    if not (math.isfinite(rate) and 1e-6 < rate < 1e9):
        raise MeshError(path, f"timeCodesPerSecond: expected a rate above 0, got {rate:g}")
    notes: list[str] = []
    meshes, faces, looks, keys, start = [], [], [], set[float](), 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        if prim.HasMetadata("clips"):
            raise MeshError(path, f"{prim.GetPath()}: expected no value clips, got some")
        if prim.IsA(UsdGeom.PointInstancer):
            notes.append(f"{prim.GetPath()}: instances are not read")
        if not prim.IsA(UsdGeom.Mesh) or UsdGeom.Imageable(prim).ComputePurpose() in ("guide", "proxy"):
            continue
        mesh = UsdGeom.Mesh(prim)
        count, triangles, corners = _topology(path, mesh)
        if not len(triangles):
            continue
        start += count
        if start > MAX_PLAYED_VERTICES or sum(map(len, faces)) + len(triangles) > MAX_PLAYED_FACES:
            raise MeshError(
                path, f"expected at most {MAX_PLAYED_VERTICES} vertices and {MAX_PLAYED_FACES} faces, got more"
            )
        faces.append(triangles + (start - count))
        looks.append(_looks(path, mesh, triangles, corners))
        meshes.append((mesh, count))
        keys |= _samples(mesh)
        if len(keys) > MAX_SAMPLES:
            raise MeshError(path, f"expected at most {MAX_SAMPLES} time samples, got more")
        notes += _unread(mesh)
    if not meshes:
        raise MeshError(path, "expected triangles, got none")

    def at(time_s: float) -> np.ndarray:
        return _positions(path, stage, meshes, time_s * rate)

    times = np.array(sorted(keys) or [0.0]) / rate
    return UsdMeshes(times, at, join_parts(faces, looks, notes), digest)


def _checked_layers(path: Path) -> tuple[Any, str]:
    """Return the file's layer, and the hash of it and of all that it composes, each of them under its folder."""
    from pxr import Sdf

    folder = path.parent.resolve()
    digest, total, waiting, seen = hashlib.sha256(), 0, [path.resolve()], set()
    while waiting:
        place = waiting.pop()
        if place in seen:
            continue
        seen.add(place)
        if not place.is_relative_to(folder) or place.suffix.lower() not in USD_SUFFIXES:
            raise MeshError(
                path, f"expected layers under its own folder as {', '.join(USD_SUFFIXES)}, got {place.name}"
            )
        check_size(place)
        total += place.stat().st_size
        if len(seen) > MAX_LAYERS or total > MAX_FILE_BYTES:
            raise MeshError(path, f"expected at most {MAX_LAYERS} layers and {MAX_FILE_BYTES} bytes, got more")
        digest.update(place.read_bytes())
        layer = Sdf.Layer.FindOrOpen(str(place))
        if layer is None:
            raise MeshError(path, f"expected a readable layer, got {place.name}")
        layer.Reload(True)  # the library keeps layers, also of files that have changed since
        for name in filter(None, sorted(layer.GetCompositionAssetDependencies())):  # none: the layer itself
            if "[" in name or ":" in name:
                raise MeshError(path, f"expected layers in files under its own folder, got {name[:80]!r}")
            waiting.append((place.parent / name).resolve())
    return Sdf.Layer.FindOrOpen(str(path.resolve())), digest.hexdigest()


def _topology(path: Path, mesh: Any) -> tuple[int, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the number of points, the triangles, and of each triangle its polygon and its polygon's first corner."""
    name = mesh.GetPath()
    counts, indices = mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()
    if max(counts.GetNumTimeSamples(), indices.GetNumTimeSamples()) > 1:
        raise MeshError(path, f"{name}: expected faces that stay, got some with time samples")
    sizes, corners = (_array(a.Get(_earliest(a)), np.int64) for a in (counts, indices))
    points = mesh.GetPointsAttr()
    lengths = {len(points.Get(t) or ()) for t in points.GetTimeSamples()} or {len(points.Get() or ())}
    if len(lengths) != 1:
        raise MeshError(path, f"{name}.points: expected as many at all times, got {sorted(lengths)}")
    (count,) = lengths
    if (sizes < 0).any() or sizes.sum() != len(corners):
        raise MeshError(path, f"{name}: expected face sizes that sum to {len(corners)}, got {sizes.sum()}")
    if len(corners) and (corners.min() < 0 or corners.max() >= count):
        outside = corners[(corners < 0) | (corners >= count)][0]
        raise MeshError(path, f"{name}: faces: expected indices in [0, {count}), got {outside}")
    starts = np.cumsum(sizes) - sizes
    fans = np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), fans)
    first = starts[polygon]
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)
    triangles = np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], 1)
    if mesh.GetOrientationAttr().Get() == "leftHanded":
        triangles = triangles[:, ::-1].copy()
    return count, triangles, (polygon, sizes)


def _earliest(attribute: Any) -> Any:
    """Return the time code of an attribute's first sample, or the default's."""
    from pxr import Usd

    samples = attribute.GetTimeSamples()
    return Usd.TimeCode(samples[0]) if samples else Usd.TimeCode.Default()


def _array(value: Any, dtype: type) -> np.ndarray:
    """Return a value of the library as an array; an absent one is empty."""
    return np.zeros(0, dtype) if value is None else np.array(value, dtype=dtype)


def _looks(path: Path, mesh: Any, triangles: np.ndarray, corners: tuple[np.ndarray, np.ndarray]) -> np.ndarray | None:
    """Return (F, 4) linear colours and opacity, or None if the file says nothing of them."""
    colour, opacity = mesh.GetDisplayColorPrimvar(), mesh.GetDisplayOpacityPrimvar()
    if not colour.HasValue() and not opacity.HasValue():
        return None
    rgba = NO_LOOK.repeat(len(triangles), 0)
    for primvar, first, last in ((colour, 0, 3), (opacity, 3, 4)):
        if primvar.HasValue():
            value = primvar.ComputeFlattened(_earliest(primvar.GetAttr()))
            rows = _array(value, np.float64).reshape(-1, last - first)
            rgba[:, first:last] = _per_face(path, primvar, rows, triangles, corners)
    if not np.isfinite(rgba).all():
        raise MeshError(path, f"{mesh.GetPath()}: displayColor: expected finite values, got others")
    return rgba.clip(0, 1)


def _per_face(
    path: Path, primvar: Any, rows: np.ndarray, triangles: np.ndarray, corners: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return a primvar's (F, C) values: of all, of each polygon, or the means over a face's points or corners."""
    polygon, sizes = corners
    kind = primvar.GetInterpolation()
    needed = {"constant": 1, "uniform": len(sizes), "faceVarying": int(sizes.sum())}
    wanted = needed.get(kind, int(triangles.max()) + 1)
    if len(rows) < wanted:
        raise MeshError(path, f"{primvar.GetName()}: expected at least {wanted} {kind} values, got {len(rows)}")
    if kind == "constant":
        return rows[:1]
    if kind == "uniform":
        return rows[polygon]
    if kind == "faceVarying":
        owner = np.repeat(np.arange(len(sizes)), sizes)
        sums = np.stack([np.bincount(owner, column, len(sizes)) for column in rows[: len(owner)].T], 1)
        return (sums / np.maximum(sizes, 1)[:, None])[polygon]
    return rows[triangles].mean(1)


def _samples(mesh: Any) -> set[float]:
    """Return the time codes at which a mesh's points or the transforms above it have samples."""
    from pxr import UsdGeom

    found, prim = set(mesh.GetPointsAttr().GetTimeSamples()), mesh.GetPrim()
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            found |= set(UsdGeom.Xformable(prim).GetTimeSamples())
        prim = prim.GetParent()
    return {float(t) for t in found if math.isfinite(t) and abs(t) < 1e12}


def _unread(mesh: Any) -> list[str]:
    """Return notes on what of a mesh is not read."""
    name, notes = mesh.GetPath(), []
    if mesh.GetSubdivisionSchemeAttr().HasAuthoredValue() and mesh.GetSubdivisionSchemeAttr().Get() != "none":
        notes.append(f"{name}: subdivision is not applied")
    names = {p.GetName() for p in mesh.GetPrim().GetAuthoredProperties()}
    if "skel:skeleton" in names or "primvars:skel:jointIndices" in names:
        notes.append(f"{name}: its skeleton is not read")
    if "material:binding" in names:
        notes.append(f"{name}: its material is not read")
    if "holeIndices" in names:
        notes.append(f"{name}: holes are not cut")
    return notes


def _positions(path: Path, stage: Any, meshes: list[tuple[Any, int]], code: float) -> np.ndarray:
    """Return (V, 3) world positions of all meshes of a stage, which lives while it is held, at a time code."""
    from pxr import Usd, UsdGeom

    cache, found = UsdGeom.XformCache(Usd.TimeCode(code)), []
    for mesh, count in meshes:
        points = _array(mesh.GetPointsAttr().Get(code), np.float64).reshape(-1, 3)
        if len(points) != count:
            raise MeshError(path, f"{mesh.GetPath()}.points: expected {count} at all times, got {len(points)}")
        matrix = np.array(cache.GetLocalToWorldTransform(mesh.GetPrim()))
        with np.errstate(all="ignore"):  # what is not finite is refused by the gate
            found.append(points @ matrix[:3, :3] + matrix[3, :3])
    world = np.concatenate(found)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        return np.stack([world[:, 0], world[:, 2], -world[:, 1]], 1)
    return world


def try_usd(path: Path) -> None:
    """Read a file at VET_TIMES instants.

    Raises:
        MeshError: it cannot be used.

    Source: ours.
    """
    read = read_usd(path)
    for time_s in np.linspace(read.keys_s[0], read.keys_s[-1], VET_TIMES):
        positions = read.at(float(time_s))
        bad = positions[~(np.abs(positions) <= MAX_USD_VALUE)]  # NaN included
        if len(bad):
            raise MeshError(path, f"vertices: expected finite values of at most {MAX_USD_VALUE:g}, got {bad[0]:g}")


def main(path: str) -> int:
    """Try a file within VET_BYTES and return the exit code: 2, with the reason on stdout, if it cannot be used.

    Source: ours.
    """
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (VET_BYTES, VET_BYTES))
    except (ImportError, ValueError, OSError):  # not on this system
        pass
    try:
        try_usd(Path(path))
    except MeshError as error:
        print(error.reason)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
