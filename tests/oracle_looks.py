"""What lit and textured surfaces look like, slowly and in plain numpy float64; imports nothing of torchblur.

Two answers by two roads:
1. `radiance`: a pixel at one instant, from the surfaces that `oracles.find_hits` finds on its ray;
2. `mean_over_exposure`: the compositing integral over the stays of `oracles.find_pieces`, cut at every start, end,
   crossing and knot, and wherever the discrete state of a layer changes (cosine signs, spot zones, mip level, texel
   cells: dense sampling and bisection); between the cuts 16 Gauss-Legendre nodes, halved until that changes nothing.

Symbols as in oracles.py: (x, y, z, w) clip space; e_i edge functions, S their sum; N instants of one face.
Rules: radiance = albedo (unlit) or albedo (ambient + sum E / pi max(0, n l)); light falls on the side that is seen.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from oracles import Piece, PlainMesh, PlainScene, clip_at, cross2, crossings, find_hits, find_pieces, lerp

N_DENSE = 97  # samples of a stay's discrete state
N_BISECTIONS = 40
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)


@dataclass
class LookMesh(PlainMesh):
    """A mesh with a texture (h, w, 3 or 4), uv (F, 3, 2), normals (V, 3) or (K+1, V, 3), and how it is shaded."""

    uv: np.ndarray | None = None
    texture: np.ndarray | None = None
    wrap: str = "repeat"
    mipmap: bool = True
    shading: str = "lambert"
    normals: np.ndarray | None = None

    @cached_property
    def levels(self) -> list[np.ndarray]:
        """The mip levels as (h, w, 4), the texture itself first."""
        return pyramid(self.texture)


@dataclass
class PlainLight:
    """A light of kind point, spot or directional; places and directions (3,) or (K+1, 3), power (3,) or a number."""

    kind: str
    power: np.ndarray | float | tuple = 1.0
    position: np.ndarray | tuple = (0.0, 0.0, 0.0)
    target: np.ndarray | tuple = (0.0, 0.0, -1.0)
    direction: np.ndarray | tuple = (0.0, 0.0, -1.0)
    inner_deg: float = 20.0
    outer_deg: float = 40.0

    def knot_times(self) -> set[float]:
        """Return the times at which its motion bends."""
        counts = [len(k) - 1 for k in map(np.asarray, (self.position, self.target, self.direction)) if k.ndim == 2]
        return {k / n for n in counts for k in range(n + 1)}


@dataclass
class LookScene(PlainScene):
    """A scene with lights and ambient radiance; rays_per_pixel sets the spacing of rays that mip levels see."""

    lights: list[PlainLight] = field(default_factory=list)
    ambient: np.ndarray | tuple = (0.0, 0.0, 0.0)
    rays_per_pixel: int = 1


@dataclass
class Look:
    """Straight colour (N, 3) and opacity (N,) of one face at N instants, a bound of its radiance, discrete states."""

    rgb: np.ndarray
    alpha: np.ndarray
    brightest: np.ndarray  # (N,) radiance if every light fell in at right angles
    state: np.ndarray  # (N, k) integers: the look is smooth while none of them changes


@dataclass
class Mean:
    """Mean RGBA (4,) over an exposure, and the brightest that any surface in it could be."""

    rgba: np.ndarray
    brightest: float


def knots_at(knots: np.ndarray, t: np.ndarray, static_ndim: int) -> np.ndarray:
    """Return (N, ...) values at times t (N,) of static (...) or moving (K+1, ...) knots."""
    knots = np.asarray(knots, dtype=np.float64)
    if knots.ndim == static_ndim:
        return np.broadcast_to(knots, (len(t), *knots.shape))
    n = len(knots) - 1
    k = np.clip(np.floor(t * n).astype(int), 0, n - 1)
    s = (t * n - k).reshape(-1, *[1] * static_ndim)
    return knots[k] * (1 - s) + knots[k + 1] * s


def area_weights(n: int) -> np.ndarray:
    """Return (max(1, n // 2), n): the share of each of n texels in each texel of the next level."""
    m = max(1, n // 2)
    edges, whole = np.arange(m + 1) * n / m, np.arange(n)
    overlap = np.minimum(edges[1:, None], whole + 1) - np.maximum(edges[:-1, None], whole)
    return np.clip(overlap, 0, None) * m / n


def pyramid(texture: np.ndarray) -> list[np.ndarray]:
    """Return all mip levels as (h, w, 4): exact area means, colours weighted by opacity."""
    image = np.asarray(texture, dtype=np.float64)
    if image.shape[2] == 3:
        image = np.concatenate([image, np.ones((*image.shape[:2], 1))], 2)
    levels = [image]
    while image.shape[:2] != (1, 1):
        rows, columns = (area_weights(n) for n in image.shape[:2])

        def mean(values, rows=rows, columns=columns):
            return np.einsum("ij,kl,jlc->ikc", rows, columns, values)

        alpha = mean(image[..., 3:])
        premultiplied, plain = mean(image[..., :3] * image[..., 3:]), mean(image[..., :3])
        rgb = np.where(alpha > 0, premultiplied / np.where(alpha > 0, alpha, 1), plain)
        image = np.concatenate([rgb, alpha], 2)
        levels.append(image)
    return levels


def bilinear(image: np.ndarray, uv: np.ndarray, wrap: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 4) values and (N, 2) texel cells of lookups at uv (N, 2): row 0 on top, v = 0 at the bottom."""
    h, w = image.shape[:2]
    x, y = uv[:, 0] * w - 0.5, (1 - uv[:, 1]) * h - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    total = np.zeros((len(uv), 4))
    for dx, dy in itertools.product((0, 1), (0, 1)):
        weight = (1 - np.abs(x - i - dx)) * (1 - np.abs(y - j - dy))
        if wrap == "repeat":
            total += weight[:, None] * image[(j + dy) % h, (i + dx) % w]
        else:
            total += weight[:, None] * image[np.clip(j + dy, 0, h - 1), np.clip(i + dx, 0, w - 1)]
    return total, np.stack([i, j], 1)


def trilinear(
    levels: list[np.ndarray], uv: np.ndarray, rho: np.ndarray, wrap: str = "repeat"
) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 4) values and (N, 5) states of lookups whose footprint is rho (N,) texels of level 0."""
    level = np.clip(np.log2(np.maximum(rho, 1e-300)), 0, len(levels) - 1)
    k = np.floor(level).astype(int)
    share = level - k
    value, state = np.zeros((len(uv), 4)), np.zeros((len(uv), 5), dtype=int)
    for n in np.unique(k):
        at = k == n
        next_level = min(n + 1, len(levels) - 1)
        (low, cell), (high, next_cell) = (bilinear(levels[m], uv[at], wrap) for m in (n, next_level))
        value[at] = (1 - share[at, None]) * low + share[at, None] * high
        state[at] = np.concatenate([np.where(level[at] > 0, n + 1, 0)[:, None], cell, next_cell], 1)
    return value, state


def edges_through(clip: np.ndarray, x0: float, y0: float) -> np.ndarray:
    """Return (N, 3) edge functions of triangles (N, 3, 4) for the ray at NDC (x0, y0)."""
    a = np.stack([clip[..., 0] - x0 * clip[..., 3], clip[..., 1] - y0 * clip[..., 3]], -1)
    return np.stack([cross2(a[:, (i + 1) % 3], a[:, (i + 2) % 3]) for i in range(3)], -1)


def footprint(
    scene: LookScene, mesh: LookMesh, face: int, clip: np.ndarray, ndc: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return uv (N, 2) and rho (N,), the root mean square of the footprint's axes in texels per ray spacing."""
    e, uv = edges_through(clip, *ndc), mesh.uv[face]
    # edge functions are linear in the ray, so a step of 1 gives their derivative
    steps = (edges_through(clip, ndc[0] + 1, ndc[1]) - e, edges_through(clip, ndc[0], ndc[1] + 1) - e)
    p, s = e @ uv, e.sum(1)[:, None]
    texels = np.array(mesh.texture.shape[1::-1])
    squares = 0
    for de, n_pixels in zip(steps, (scene.width, scene.height), strict=True):
        slope = (s * (de @ uv) - p * de.sum(1)[:, None]) / s**2 * texels * 2 / n_pixels
        squares = squares + (slope**2).sum(1) / scene.rays_per_pixel
    return p / s, np.sqrt(squares / 2)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products over the last axis."""
    return (a * b).sum(-1)


def unit(a: np.ndarray) -> np.ndarray:
    """Return vectors of length 1."""
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def arriving(light: PlainLight, point: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return E (N, 3) on a surface that faces the light, the way to it (N, 3), and the spot's zone (N,)."""
    power, zone = np.broadcast_to(np.asarray(light.power, dtype=np.float64), (len(t), 3)), np.zeros(len(t), dtype=int)
    if light.kind == "directional":
        return power, -unit(knots_at(light.direction, t, 1)), zone
    position = knots_at(light.position, t, 1)
    away = point - position
    irradiance = power / dot(away, away)[:, None]
    if light.kind == "spot":
        cosine = dot(unit(knots_at(light.target, t, 1) - position), unit(away))
        inner, outer = np.cos(np.radians(light.inner_deg)), np.cos(np.radians(light.outer_deg))
        zone = (cosine >= outer).astype(int) + (cosine >= inner)
        share = zone / 2 if inner == outer else np.clip((cosine - outer) / (inner - outer), 0, 1)
        irradiance = irradiance * (share**2)[:, None]
    return irradiance, -unit(away), zone


def normal_of(
    scene: LookScene, mesh: LookMesh, face: int, bary: np.ndarray, t: np.ndarray, front: np.ndarray
) -> np.ndarray:
    """Return (N, 3) unit normals: of the triangle on the viewer's side, or of its vertices, negated on the back."""
    corners = mesh.faces[face]
    side = np.where(front, 1.0, -1.0)[:, None]
    matrix = knots_at(scene.world_to_clip, t, 2)
    # right-handed cameras look along -z: x, y and depth then have a negative determinant, mirrored ones a positive
    hand = -np.sign(np.linalg.det(matrix[:, :3, :3]))[:, None]
    if mesh.normals is not None:
        return unit((bary[:, :, None] * knots_at(mesh.normals, t, 2)[:, corners]).sum(1)) * side * hand
    x = knots_at(mesh.vertices, t, 2)[:, corners]
    return unit(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])) * side * hand


def look_at_face(
    scene: LookScene, mesh: LookMesh, face: int, clip: np.ndarray, t: np.ndarray, ndc: tuple[float, float]
) -> Look:
    """Return the look of one face, whose corners are at clip (N, 3, 4), where the ray meets it at times t (N,)."""
    e = edges_through(clip, *ndc)
    bary = e / e.sum(1, keepdims=True)
    rgba = np.broadcast_to([*mesh.face_color(face), mesh.face_alpha(face)], (len(t), 4))
    states = [np.zeros((len(t), 1), dtype=int)]
    if mesh.texture is not None:
        uv, rho = footprint(scene, mesh, face, clip, ndc)
        if mesh.mipmap:
            value, state = trilinear(mesh.levels, uv, rho, mesh.wrap)
        else:
            value, state = bilinear(mesh.levels[0], uv, mesh.wrap)
        rgba = rgba * value
        states.append(state)
    light, brightest = np.ones((len(t), 3)), np.ones((len(t), 3))
    if mesh.shading == "lambert":
        light = brightest = np.broadcast_to(np.asarray(scene.ambient, dtype=np.float64), (len(t), 3))
        point = (bary[:, :, None] * knots_at(mesh.vertices, t, 2)[:, mesh.faces[face]]).sum(1)
        normal = normal_of(scene, mesh, face, bary, t, e.sum(1) > 0)
        for source in scene.lights:
            irradiance, way, zone = arriving(source, point, t)
            cosine = dot(normal, way)
            light = light + irradiance / np.pi * np.maximum(cosine, 0)[:, None]
            brightest = brightest + irradiance / np.pi
            states.append(np.stack([cosine > 0, zone], 1).astype(int))
    return Look(rgba[:, :3] * light, rgba[:, 3], (rgba[:, :3] * brightest).max(1), np.concatenate(states, 1))


def over(looks: list[Look], background: np.ndarray, n: int) -> np.ndarray:
    """Return (n, 4): layers nearest first over a background, and their own opacity."""
    color, left = np.zeros((n, 3)), np.ones((n, 1))
    for look in looks:
        color = color + left * look.alpha[:, None] * look.rgb
        left = left * (1 - look.alpha[:, None])
    return np.concatenate([color + left * background, 1 - left], 1)


def radiance(scene: LookScene, row: int, col: int, t: float, place=(0.5, 0.5)) -> np.ndarray:
    """Return the RGBA (4,) of a pixel's ray at one instant."""
    looks, at = [], np.array([float(t)])
    for hit in find_hits(scene, row, col, float(t), place):
        mesh = scene.meshes[hit.mesh]
        clip = clip_at(scene, mesh, float(t))[mesh.faces[hit.face]][None]
        looks.append(look_at_face(scene, mesh, hit.face, clip, at, scene.pixel_ndc(row, col, place)))
    return over(looks, scene.pixel_background(row, col), 1)[0]


def image_at(scene: LookScene, t: float) -> np.ndarray:
    """Return the (H, W, 4) image of an instant through the pixels' centres."""
    return np.array([[radiance(scene, r, c, t) for c in range(scene.width)] for r in range(scene.height)])


def look_of_piece(scene: LookScene, piece: Piece, t: np.ndarray, ndc: tuple[float, float]) -> Look:
    """Return the look of a stay's face at times t (N,) inside it."""
    s = (t - piece.ta) / (piece.tb - piece.ta)
    reduced, zw = lerp(*piece.edge_ends, s), lerp(*piece.zw_ends, s)
    clip = np.concatenate([reduced + zw[..., 1:] * np.array(ndc), zw], -1)
    return look_at_face(scene, scene.meshes[piece.mesh], piece.face, clip, t, ndc)


def find_bends(scene: LookScene, piece: Piece, ndc: tuple[float, float]) -> list[float]:
    """Return the times inside a stay at which its look changes its discrete state."""

    def state(t):
        return look_of_piece(scene, piece, t, ndc).state

    length = piece.t_end - piece.t_start
    grid = piece.t_start + length * (np.arange(N_DENSE) + 0.5) / N_DENSE  # never the ends: S may vanish there
    states = state(grid)
    low, high, at_low, at_high = grid[:-1], grid[1:], states[:-1], states[1:]
    bends = []
    while True:
        differ = (at_low != at_high).any(1)
        low, high, at_low, at_high = low[differ], high[differ], at_low[differ], at_high[differ]
        if len(low) == 0:
            return bends
        last, first = low, high  # first time of another state than that of `low`
        for _ in range(N_BISECTIONS):
            middle = (last + first) / 2
            same = (state(middle) == at_low).all(1)
            last, first = np.where(same, middle, last), np.where(same, first, middle)
        bends += first.tolist()
        low, at_low = first, state(first)  # further changes before `high`


def mean_over_exposure(
    scene: LookScene, row: int, col: int, t_open: float = 0.0, t_close: float = 1.0, place=(0.5, 0.5)
) -> Mean:
    """Return the mean of a pixel's ray over [t_open, t_close], good to about 1e-11 of the brightest."""
    ndc, background = scene.pixel_ndc(row, col, place), scene.pixel_background(row, col)
    pieces = [p for p in find_pieces(scene, row, col, place) if p.t_end > p.t_start]
    cuts = {t_open, t_close}.union(*(light.knot_times() for light in scene.lights))
    for k, p in enumerate(pieces):
        cuts.update((p.t_start, p.t_end), find_bends(scene, p, ndc))
        for q in pieces[:k]:
            cuts.update(crossings(p, q))
    times = np.array(sorted(t for t in cuts if t_open <= t <= t_close))
    total, brightest = np.zeros(4), float(np.max(background))
    start, end = times[:-1], times[1:]
    real = end - start > 1e-14
    todo = list(zip(start[real], end[real], itertools.repeat(0)))
    while todo:
        a, b, depth = todo.pop()
        middle = (a + b) / 2
        active = sorted((p for p in pieces if p.t_start < middle < p.t_end), key=lambda p: p.depth(middle))
        panels = np.array([[a, b], [a, middle], [middle, b]])
        t = (panels.mean(1)[:, None] + (panels[:, 1] - panels[:, 0])[:, None] / 2 * NODES).ravel()
        looks = [look_of_piece(scene, p, t, ndc) for p in active]
        brightest = max([brightest, *(look.brightest.max() for look in looks)])
        once, left, right = np.einsum("pnc,n->pc", over(looks, background, len(t)).reshape(3, 16, 4), WEIGHTS / 2)
        twice = (left + right) / 2
        if depth < 20 and np.abs(once - twice).max() * (b - a) > 1e-12 * brightest * (t_close - t_open):
            todo += [(a, middle, depth + 1), (middle, b, depth + 1)]
        else:
            total += twice * (b - a) / (t_close - t_open)
    return Mean(total, brightest)
