"""Clip-space vertices of all meshes at a shutter time, compiled.

Before: jit.py, scene.py.  After: instant.py, samples.py.
Symbols: M meshes, V vertices, R knots of all vertices. The formula is that of `Scene.clip_at`, operation by operation.
Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from torchblur.cpu.jit import jit
from torchblur.scene import Scene


class Knots(NamedTuple):
    """Clip-space vertices at the knots of their motion, mesh by mesh, knot by knot."""

    clip: np.ndarray  # (R, 4) float64
    mesh: np.ndarray  # (M, 3) int64: first row, number of vertices, first vertex
    times: np.ndarray  # (sum of knots,) float64 shutter times
    span: np.ndarray  # (M, 2) int64 first of its times, and number of them


def find_knots(scene: Scene) -> Knots:
    """Return the knots of all meshes under the camera. Source: ours."""
    rows, table, times, span = [np.zeros((0, 4))], [], [], []
    n_rows = n_vertices = 0
    for mesh in scene.meshes:
        rests = mesh.n_segments == scene.camera.n_segments == 0
        own = [0.0] if rests else scene.knot_times(mesh)
        clip = scene.clip_at(mesh, torch.tensor(own, dtype=torch.float64)).detach().numpy()
        table.append((n_rows, clip.shape[1], n_vertices))
        span.append((len(times), len(own)))
        rows.append(clip.reshape(-1, 4))
        times += own
        n_rows, n_vertices = n_rows + clip.shape[0] * clip.shape[1], n_vertices + clip.shape[1]
    mesh_table = np.array(table, dtype=np.int64).reshape(-1, 3)
    return Knots(np.concatenate(rows), mesh_table, np.array(times), np.array(span, dtype=np.int64).reshape(-1, 2))


def vertices_at(knots: Knots, t: float) -> np.ndarray:
    """Return (V, 4) float64 clip-space vertices of all meshes at shutter time `t`. Source: as `Scene.clip_at`."""
    out = np.empty((int(knots.mesh[:, 1].sum()), 4))
    place_all(knots, t, out)
    return out


@jit
def place_all(knots, t, out):
    """Write the vertices of all meshes at shutter time `t` to `out` (V, 4)."""
    for m in range(len(knots.mesh)):
        first = knots.mesh[m, 2]
        place_mesh(knots, m, t, out[first : first + knots.mesh[m, 1]])


@jit
def place_mesh(knots, m, t, out):
    """Write the vertices of mesh `m` at shutter time `t` to `out` (V of the mesh, 4)."""
    row, n_vertices = knots.mesh[m, 0], knots.mesh[m, 1]
    first, n_knots = knots.span[m, 0], knots.span[m, 1]
    if n_knots == 1:
        out[:] = knots.clip[row : row + n_vertices]
        return
    segment = 0
    while segment < n_knots - 2 and knots.times[first + segment + 1] <= t:
        segment += 1
    start, end = knots.times[first + segment], knots.times[first + segment + 1]
    share = (t - start) / (end - start)
    keep = 1 - share
    a, b = row + segment * n_vertices, row + (segment + 1) * n_vertices
    for v in range(n_vertices):
        for k in range(4):
            out[v, k] = keep * knots.clip[a + v, k] + share * knots.clip[b + v, k]
