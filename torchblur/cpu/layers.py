"""What the rays of a band of rows see, compiled: layers in order of depth, their looks, their sum.

Before: raster.py, lambert.py.  After: instant.py.
Symbols: Q rays of the band, P of the block of rows; X texels, M meshes; a layer is a face met by a ray.
Source: as texture.py (trilinear interpolation, Williams 1983) and packed.py (front-to-back OVER), operation by
operation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cpu import lambert, raster
from torchblur.cpu.jit import jit

TIE = 1e-11  # relative: nearness of surfaces that count as coplanar
FULL = 1e-14  # rounding of an interpolated opacity of 1


class Looks(NamedTuple):
    """What the faces look like."""

    rgb: np.ndarray  # (F, 3) float64
    opacity: np.ndarray  # (F,) float64
    is_textured: np.ndarray  # (F,) bool
    mesh_of: np.ndarray  # (F,) int64
    uv: np.ndarray  # (F, 3, 2) float64
    texels: np.ndarray  # (X, 4) float64
    first: np.ndarray  # (levels, M) int64
    size: np.ndarray  # (levels, 2, M) int64
    n_levels: np.ndarray  # (M,) int64
    repeats: np.ndarray  # (M,) bool
    step: np.ndarray  # (2,) from one ray to the next in NDC along x and y


@jit
def find(shape, faces, rays, rows):
    """Return what the rays of rows `rows[0]` to `rows[1]` meet: `Found`, `Nodes` and how many of these."""
    n = (rows[1] - rows[0]) * rays.width
    found = raster.Found(
        np.zeros(n), np.full(n, -1, np.int32), np.zeros(n, np.int32), np.zeros(n, np.bool_), np.full(n, -1, np.int32)
    )
    nodes = raster.Nodes(np.empty(64, np.int32), np.empty(64), np.empty(64, np.int32), np.empty(64, np.int32))
    nodes, count = raster.scan(shape, faces, rays, rows, found, (nodes, 0, False))
    has_others = found.is_doubtful.any() or (faces.kind == raster.OTHER).any()
    if has_others:
        nodes, count = raster.scan(shape, faces, rays, rows, found, (nodes, count, True))
    return found, nodes, count


@jit
def layers_of(q, found, nodes, faces, scratch):
    """Put the layers of ray `q` of the band, nearest first, coplanar ones by rank, into `scratch`, which may grow.

    Returns:
        Scratch (nearness, face, part) and the number of layers.
    """
    near, face, part = scratch
    n = 0
    if found.face[q] >= 0 and not found.is_doubtful[q]:
        near[0], face[0], part[0] = found.nearness[q], found.face[q], found.part[q]
        n = 1
    node = found.head[q]
    while node >= 0:
        if n == len(near):
            near = np.concatenate((near, np.empty_like(near)))
            face = np.concatenate((face, np.empty_like(face)))
            part = np.concatenate((part, np.empty_like(part)))
        near[n], face[n], part[n] = nodes.nearness[node], nodes.face[node], nodes.part[node]
        n += 1
        node = nodes.following[node]
    if n > 24:
        order = np.argsort(-near[:n])
        near[:n], face[:n], part[:n] = near[:n][order], face[:n][order], part[:n][order]
    for i in range(1, n):
        a, f, m = near[i], face[i], part[i]
        j = i - 1
        while j >= 0 and near[j] < a:
            near[j + 1], face[j + 1], part[j + 1] = near[j], face[j], part[j]
            j -= 1
        near[j + 1], face[j + 1], part[j + 1] = a, f, m
    first = 0  # of a run of coplanar layers
    for i in range(1, n):
        if not np.abs(near[i] - near[i - 1]) <= TIE * np.abs(near[i]):
            first = i
    if first < n - 1:
        first = 0
        for i in range(1, n + 1):
            if i < n and np.abs(near[i] - near[i - 1]) <= TIE * np.abs(near[i]):
                continue
            for k in range(first + 1, i):  # by rank
                f, m = face[k], part[k]
                j = k - 1
                while j >= first and faces.rank[face[j]] > faces.rank[f]:
                    face[j + 1], part[j + 1] = face[j], part[j]
                    j -= 1
                face[j + 1], part[j + 1] = f, m
            first = i
    return (near, face, part), n


@jit
def add_seen(total, weight, shape, appearance, rays, rows):
    """Add to `total` (H W, 4) what the rays of a band see, premultiplied, by `weight` (P,) or (1,); `appearance` is
    `Faces`, `Looks` and `Lit`.
    """
    faces, looks, lit = appearance
    found, nodes, _ = find(shape, faces, rays, rows)
    scratch = (np.empty(64), np.empty(64, np.int32), np.empty(64, np.int32))
    for q in range(len(found.face)):
        p = rows[0] * rays.width + q
        share = weight[p] if len(weight) > 1 else weight[0]
        if found.head[q] < 0:
            if found.face[q] >= 0:
                red, green, blue, _ = look(shape, (looks, lit), rays, p, found.face[q], found.part[q])
                total[p, 0] += share * red
                total[p, 1] += share * green
                total[p, 2] += share * blue
                total[p, 3] += share
            continue
        scratch, n = layers_of(q, found, nodes, faces, scratch)
        r, g, b, left = 0.0, 0.0, 0.0, 1.0
        for i in range(n):
            red, green, blue, alpha = look(shape, (looks, lit), rays, p, scratch[1][i], scratch[2][i])
            part = left * alpha
            r, g, b = r + part * red, g + part * green, b + part * blue
            left *= 1 - alpha
            if left <= 0:
                break
        total[p, 0] += share * r
        total[p, 1] += share * g
        total[p, 2] += share * b
        total[p, 3] += share * (1 - left)


@jit
def find_visible(shape, faces, rays, rows):
    """Return pixels, faces and parts (n,) of the layers of a band that no opaque face hides, nearest first."""
    found, nodes, count = find(shape, faces, rays, rows)
    scratch = (np.empty(64), np.empty(64, np.int32), np.empty(64, np.int32))
    most = count + len(found.face)
    pixel, seen, part = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    n_seen = 0
    for q in range(len(found.face)):
        if found.head[q] < 0 and found.face[q] < 0:
            continue
        scratch, n = layers_of(q, found, nodes, faces, scratch)
        for i in range(n):
            pixel[n_seen], seen[n_seen], part[n_seen] = rows[0] * rays.width + q, scratch[1][i], scratch[2][i]
            n_seen += 1
            if faces.kind[scratch[1][i]] == raster.OPAQUE:
                break
    return pixel[:n_seen], seen[:n_seen], part[:n_seen]


@jit
def look(shape, appearance, rays, p, f, n):
    """Return straight RGB and opacity of face `f` in part `n` as ray `p` sees it; `appearance` is `Looks` and `Lit`."""
    looks, lit = appearance
    red, green, blue, alpha = looks.rgb[f, 0], looks.rgb[f, 1], looks.rgb[f, 2], looks.opacity[f]
    if not (looks.is_textured[f] or lit.is_lit[f]):
        return red, green, blue, alpha
    t = rays.t[p] if len(rays.t) > 1 else rays.t[0]
    corners = corners_seen(shape, rays, p, f, n)
    x, y, _ = corners
    e0, e1, e2 = x[1] * y[2] - y[1] * x[2], x[2] * y[0] - y[2] * x[0], x[0] * y[1] - y[0] * x[1]
    scale = e0 + e1 + e2
    b0, b1, b2 = e0 / scale, e1 / scale, e2 / scale
    mesh = looks.mesh_of[f]
    if looks.is_textured[f]:
        uv = looks.uv
        u = b0 * uv[f, 0, 0] + b1 * uv[f, 1, 0] + b2 * uv[f, 2, 0]
        v = b0 * uv[f, 0, 1] + b1 * uv[f, 1, 1] + b2 * uv[f, 2, 1]
        level = 0.0
        if looks.n_levels[mesh] > 1:
            level = mip_level(looks, f, (e0, e1, e2), corners)
        r, g, b, a = lookup(looks, mesh, u, v, level)
        red, green, blue, alpha = red * r, green * g, blue * b, alpha * (1.0 if a > 1 - FULL else a)
    if lit.is_lit[f]:
        r, g, b = lambert.lit_by(lit, shape, (b0, b1, b2, np.sign(scale), mesh), f, t)
        red, green, blue = red * r, green * g, blue * b
    return red, green, blue, alpha


@jit
def corners_seen(shape, rays, p, f, n):
    """Return x, y, w (3,) of the corners of face `f` in part `n` as ray `p` sees them."""
    x, y, w = np.empty(3), np.empty(3), np.empty(3)
    time = raster.part_time(shape.times[n, 0], shape.times[n, 1], rays.t[p] if len(rays.t) > 1 else rays.t[0])
    rx = rays.x_ndc[p % rays.width] if rays.is_grid else rays.x_ndc[p]
    ry = rays.y_ndc[p // rays.width] if rays.is_grid else rays.y_ndc[p]
    for i in range(3):
        vertex = shape.corner[f, i] + shape.shift[n]
        start, end = raster.corner_at(shape.clip_start, vertex), raster.corner_at(shape.clip_end, vertex)
        x[i], y[i], _, w[i] = raster.between(raster.reduced(start, rx, ry), raster.reduced(end, rx, ry), time)
    return x, y, w


@jit
def mip_level(looks, f, e, corners):
    """Return the mip level of a lookup where the edge functions are `e`."""
    (e0, e1, e2), (x, y, w) = e, corners
    scale, uv, mesh = e0 + e1 + e2, looks.uv, looks.mesh_of[f]
    square = 0.0
    for axis in range(2):
        c, d = (y, w) if axis == 0 else (w, x)
        d0, d1, d2 = c[1] * d[2] - d[1] * c[2], c[2] * d[0] - d[2] * c[0], c[0] * d[1] - d[0] * c[1]
        all_of, step = d0 + d1 + d2, looks.step[axis] / (scale * scale)
        s0, s1, s2 = (
            (scale * d0 - e0 * all_of) * step,
            (scale * d1 - e1 * all_of) * step,
            (scale * d2 - e2 * all_of) * step,
        )
        for k in range(2):
            slope = looks.size[0, k, mesh] * (s0 * uv[f, 0, k] + s1 * uv[f, 1, k] + s2 * uv[f, 2, k])
            square += slope * slope
    return min(np.log2(max(np.sqrt(0.5 * square), 1.0)), looks.n_levels[mesh] - 1.0)


@jit
def lookup(looks, mesh, u, v, level):
    """Return RGB and opacity of a mesh's texture, trilinear."""
    fine = np.floor(level)
    r, g, b, a = bilinear(looks, mesh, u, v, int(fine))
    share = level - fine
    if share > 0:
        r1, g1, b1, a1 = bilinear(looks, mesh, u, v, int(fine) + 1)
        keep = 1 - share
        r, g, b, a = keep * r + share * r1, keep * g + share * g1, keep * b + share * b1, keep * a + share * a1
    return r, g, b, a


@jit
def bilinear(looks, mesh, u, v, level):
    """Return RGB and opacity of a mesh's texture at a whole level."""
    width, height = looks.size[level, 0, mesh], looks.size[level, 1, mesh]
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    share_x, share_y = x - left, y - top
    r, g, b, a = 0.0, 0.0, 0.0, 0.0
    for dy in range(2):
        for dx in range(2):
            column, row = int(left) + dx, int(top) + dy
            if looks.repeats[mesh]:
                column, row = column % width, row % height
            else:
                column, row = min(max(column, 0), width - 1), min(max(row, 0), height - 1)
            weight = (share_x if dx else 1 - share_x) * (share_y if dy else 1 - share_y)
            k = looks.first[level, mesh] + row * width + column
            r += weight * looks.texels[k, 0]
            g += weight * looks.texels[k, 1]
            b += weight * looks.texels[k, 2]
            a += weight * looks.texels[k, 3]
    return r, g, b, a
