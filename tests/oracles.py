"""What a pixel must be, computed slowly in plain numpy float64 from methods.md; imports nothing of torchblur.

Three answers to one question, each by its own road:
1. `find_pieces`: when a moving triangle covers a pixel centre, by bracketing the roots of its edge functions and of
   its near and far functions along time and looking at each gap's midpoint;
2. `integrate_pixel`: the whole compositing integral, cut at every start, end and crossing;
3. `sample_pixel`: the colour at given instants, with no intervals at all.
`composite_layers` is a fourth, in exact rational numbers, for layers whose times and depths are given.

Symbols: t shutter time in [0, 1]; s local time of one segment; (x, y, z, w) clip space;
A = (x - x0 w, y - y0 w) a vertex reduced by the pixel; e_i the edge function opposite vertex i; S = sum e;
depth = z / w of the hit, smaller is nearer.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

N_GRID = 33  # breakpoints besides the critical points of the fitted polynomial; these alone find almost every bracket


@dataclass
class PlainMesh:
    """Vertices (V, 3) or (K+1, V, 3); faces (F, 3); colour (3,) or (F, 3); opacity a number or (F,)."""

    vertices: np.ndarray
    faces: np.ndarray
    color: np.ndarray | tuple = (1.0, 1.0, 1.0)
    opacity: np.ndarray | float = 1.0
    double_sided: bool = True

    def __post_init__(self) -> None:
        self.vertices = np.asarray(self.vertices, dtype=np.float64)
        self.faces = np.asarray(self.faces, dtype=np.int64).reshape(-1, 3)
        self.color = np.asarray(self.color, dtype=np.float64)
        self.opacity = np.asarray(self.opacity, dtype=np.float64)

    def knots(self) -> np.ndarray:
        """Return (K+1, V, 3), of a static mesh (1, V, 3)."""
        return self.vertices if self.vertices.ndim == 3 else self.vertices[None]

    def face_color(self, face: int) -> np.ndarray:
        """Return the straight colour of a face."""
        return self.color if self.color.ndim == 1 else self.color[face]

    def face_alpha(self, face: int) -> float:
        """Return the opacity of a face."""
        return float(self.opacity) if self.opacity.ndim == 0 else float(self.opacity[face])


@dataclass
class PlainScene:
    """Meshes, a (4, 4) or (K+1, 4, 4) matrix, an image size and a background (3,) or (H, W, 3)."""

    meshes: list[PlainMesh]
    world_to_clip: np.ndarray = field(default_factory=lambda: np.eye(4))
    width: int = 1
    height: int = 1
    background: np.ndarray | tuple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.world_to_clip = np.asarray(self.world_to_clip, dtype=np.float64)
        self.background = np.asarray(self.background, dtype=np.float64)

    def camera_knots(self) -> np.ndarray:
        """Return (K+1, 4, 4), of a static camera (1, 4, 4)."""
        return self.world_to_clip if self.world_to_clip.ndim == 3 else self.world_to_clip[None]

    def pixel_background(self, row: int, col: int) -> np.ndarray:
        """Return the background behind a pixel."""
        return self.background if self.background.ndim == 1 else self.background[row, col]

    def pixel_ndc(self, row: int, col: int, place: tuple[float, float] = (0.5, 0.5)) -> tuple[float, float]:
        """Return the NDC position of a place inside a pixel, by default its centre."""
        return 2 * (col + place[0]) / self.width - 1, 1 - 2 * (row + place[1]) / self.height


@dataclass
class Piece:
    """One stay [t_start, t_end] of one triangle over one pixel, within one linear segment [ta, tb]."""

    t_start: float
    t_end: float
    front: bool
    mesh: int
    face: int
    ta: float
    tb: float
    edge_ends: tuple[np.ndarray, np.ndarray]  # reduced vertices (3, 2) at ta and tb
    zw_ends: tuple[np.ndarray, np.ndarray]  # (3, 2) z and w at ta and tb

    def depth_parts(self, t: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Return (sum e z, sum e w) at t."""
        s = (np.asarray(t, dtype=np.float64) - self.ta) / (self.tb - self.ta)
        e = edges_at(*self.edge_ends, s)
        zw = lerp(*self.zw_ends, s)
        return (e * zw[..., 0]).sum(-1), (e * zw[..., 1]).sum(-1)

    def depth(self, t: float) -> float:
        """Return z / w of the hit."""
        z, w = self.depth_parts(t)
        return float(z / w)


def lerp(a: np.ndarray, b: np.ndarray, s: np.ndarray | float) -> np.ndarray:
    """Return a + s (b - a) with s broadcast in front."""
    s = np.asarray(s, dtype=np.float64).reshape(np.shape(s) + (1,) * np.ndim(a))
    return a * (1 - s) + b * s


def cross2(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the 2-D cross product over the last axis."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def edges_at(start: np.ndarray, end: np.ndarray, s: np.ndarray | float) -> np.ndarray:
    """Return the three edge functions (..., 3) of reduced vertices (3, 2) at local times s."""
    a = lerp(start, end, s)
    return np.stack([cross2(a[..., (i + 1) % 3, :], a[..., (i + 2) % 3, :]) for i in range(3)], -1)


def fit_polynomial(values: np.ndarray) -> np.ndarray:
    """Return the power coefficients on [-1, 1] of the polynomial through values at Chebyshev points."""
    n = len(values)
    nodes = np.cos(np.pi * (np.arange(n) + 0.5) / n)
    return np.linalg.solve(np.vander(nodes, increasing=True), values)


def find_roots(function, degree: int, low: float, high: float) -> list[float]:
    """Return the places in [low, high] where a polynomial of at most `degree` changes sign or is zero on the grid.

    Brackets lie between the fitted polynomial's critical points and a uniform grid, so near-double roots are split too.
    """
    if not high > low:
        return []
    middle, half = (low + high) / 2, (high - low) / 2
    n = degree + 1
    nodes = np.cos(np.pi * (np.arange(n) + 0.5) / n)
    values = np.asarray(function(middle + half * nodes))
    scale = np.abs(values).max()
    breaks = np.linspace(low, high, N_GRID)
    if scale > 0:
        slope = np.polynomial.polynomial.polyder(fit_polynomial(values / scale))
        while len(slope) > 1 and abs(slope[-1]) < 1e-15 * np.abs(slope).max():
            slope = slope[:-1]
        if len(slope) > 1:
            critical = middle + half * np.polynomial.polynomial.polyroots(slope).real
            breaks = np.sort(np.concatenate([breaks, critical[(critical > low) & (critical < high)]]))
    f = np.asarray(function(breaks))
    roots = [float(t) for t in breaks[f == 0]]
    for k in np.flatnonzero(f[:-1] * f[1:] < 0):
        roots.append(bisect(function, float(breaks[k]), float(breaks[k + 1]), bool(f[k] < 0)))
    return roots


def bisect(function, low: float, high: float, rising: bool) -> float:
    """Return the sign change in [low, high] to the last bit."""
    for _ in range(80):
        middle = (low + high) / 2
        if middle in (low, high):
            break
        if (float(function(middle)) < 0) == rising:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def segments(scene: PlainScene, mesh: PlainMesh) -> list[tuple[float, float, np.ndarray, np.ndarray]]:
    """Return (ta, tb, clip at ta (V, 4), clip at tb) between the union of the mesh's and the camera's knots."""
    counts = [len(mesh.knots()) - 1, len(scene.camera_knots()) - 1]
    times = sorted({Fraction(k, n) for n in counts if n for k in range(n + 1)} | {Fraction(0), Fraction(1)})
    clips = [clip_at_fraction(scene, mesh, t) for t in times]
    return [(float(a), float(b), clips[k], clips[k + 1]) for k, (a, b) in enumerate(itertools.pairwise(times))]


def knot_value(knots: np.ndarray, t: Fraction) -> np.ndarray:
    """Return the piecewise linear value of knots at a rational time."""
    n = len(knots) - 1
    if n == 0:
        return knots[0]
    k = min(int(t * n), n - 1)
    s = float(t * n - k)
    return knots[k] if s == 0 else knots[k + 1] if s == 1 else knots[k] * (1 - s) + knots[k + 1] * s


def clip_at_fraction(scene: PlainScene, mesh: PlainMesh, t: Fraction) -> np.ndarray:
    """Return clip-space vertices (V, 4) at a knot time."""
    world = knot_value(mesh.knots(), t)
    matrix = knot_value(scene.camera_knots(), t)
    return world @ matrix[:, :3].T + matrix[:, 3]


def clip_at(scene: PlainScene, mesh: PlainMesh, t: float) -> np.ndarray:
    """Return clip-space vertices (V, 4) at any time: linear in clip space within a segment."""
    ta, tb, start, end = next(s for s in segments(scene, mesh) if t <= s[1])
    return lerp(start, end, (t - ta) / (tb - ta))


def find_pieces(scene: PlainScene, row: int, col: int, place: tuple[float, float] = (0.5, 0.5)) -> list[Piece]:
    """Return every stay of every triangle over a pixel, near, far and one-sidedness included."""
    x0, y0 = scene.pixel_ndc(row, col, place)
    pieces = []
    for m, mesh in enumerate(scene.meshes):
        for ta, tb, start, end in segments(scene, mesh):
            reduced = [np.stack([c[:, 0] - x0 * c[:, 3], c[:, 1] - y0 * c[:, 3]], -1) for c in (start, end)]
            for f, face in enumerate(mesh.faces):
                a, b = reduced[0][face], reduced[1][face]
                six = np.concatenate([a, b])
                if (six > 0).all(0).any() or (six < 0).all(0).any():
                    continue  # no convex combination of the six is zero
                zw = (start[face][:, 2:], end[face][:, 2:])
                for s0, s1, front in covered_local(a, b, zw):
                    if front or mesh.double_sided:
                        t0, t1 = ta + s0 * (tb - ta), ta + s1 * (tb - ta)
                        pieces.append(Piece(t0, t1, front, m, f, ta, tb, (a, b), zw))
    return pieces


def covered_local(a: np.ndarray, b: np.ndarray, zw: tuple[np.ndarray, np.ndarray]) -> list[tuple[float, float, bool]]:
    """Return (s_start, s_end, front) of the covered stays of one triangle in one segment."""

    def weighted(s, sign):
        values = lerp(*zw, s)
        return (edges_at(a, b, s) * (values[..., 1] + sign * values[..., 0])).sum(-1)

    cuts = {0.0, 1.0}
    for i in range(3):
        cuts.update(find_roots(lambda s, i=i: edges_at(a, b, s)[..., i], 2, 0.0, 1.0))
    for sign in (1, -1):  # z + w >= 0 near, w - z >= 0 far
        values = np.concatenate([z_w[:, 1] + sign * z_w[:, 0] for z_w in zw])
        if (values < 0).any():
            cuts.update(find_roots(lambda s, sign=sign: weighted(s, sign), 3, 0.0, 1.0))
    times = sorted(cuts)
    stays = []
    for s0, s1 in itertools.pairwise(times):
        middle = (s0 + s1) / 2
        e = edges_at(a, b, middle)
        sign = 1 if (e > 0).all() else -1 if (e < 0).all() else 0
        if sign and sign * weighted(middle, 1) >= 0 and sign * weighted(middle, -1) >= 0:
            stays.append((s0, s1, sign > 0))
    return stays


def crossings(one: Piece, two: Piece) -> list[float]:
    """Return the times at which two pieces swap depth, inside their common stay."""
    low, high = max(one.t_start, two.t_start), min(one.t_end, two.t_end)

    def difference(t):
        z1, w1 = one.depth_parts(t)
        z2, w2 = two.depth_parts(t)
        return z1 * w2 - z2 * w1

    return find_roots(difference, 6, low, high)


@dataclass
class PixelAnswer:
    """Linear RGB over the background and the meshes' own alpha (4,), coverage per mesh (M,), number of events."""

    rgba: np.ndarray
    coverage: np.ndarray
    n_events: int
    pieces: list[Piece]


def integrate_pixel(
    scene: PlainScene, row: int, col: int, t_open: float = 0.0, t_close: float = 1.0, place=(0.5, 0.5)
) -> PixelAnswer:
    """Return the exact mean over the window of a pixel: flat colours, so each cell is constant."""
    pieces = [p for p in find_pieces(scene, row, col, place) if p.t_end > p.t_start]
    cuts = {t_open, t_close}
    for k, p in enumerate(pieces):
        cuts.update((p.t_start, p.t_end))
        for q in pieces[:k]:
            cuts.update(crossings(p, q))
    times = sorted(t for t in cuts if t_open <= t <= t_close)
    background = scene.pixel_background(row, col)
    rgba, coverage = np.zeros(4), np.zeros(len(scene.meshes))
    for t0, t1 in itertools.pairwise(times):
        middle, share = (t0 + t1) / 2, (t1 - t0) / (t_close - t_open)
        active = sorted((p for p in pieces if p.t_start < middle < p.t_end), key=lambda p: p.depth(middle))
        layers = [
            (scene.meshes[p.mesh].face_color(p.face), scene.meshes[p.mesh].face_alpha(p.face), p.mesh) for p in active
        ]
        color, seen = over(layers, background)
        rgba += share * color
        coverage[list(seen)] += share
    return PixelAnswer(rgba, coverage, len(times) - 2, pieces)


def over(layers: list[tuple], background: np.ndarray) -> tuple[np.ndarray, set[int]]:
    """Return RGBA of layers (colour, alpha, mesh) nearest first over a background, and which meshes are seen."""
    color, transmittance, seen = np.zeros(3), 1.0, set()
    for c, alpha, mesh in layers:
        if transmittance > 0 and alpha > 0:
            seen.add(mesh)
        color = color + transmittance * alpha * np.asarray(c)
        transmittance *= 1 - alpha
    return np.append(color + transmittance * background, 1 - transmittance), seen


@dataclass
class Hit:
    """A surface on the ray at one instant."""

    depth: float  # z / w
    w: float
    mesh: int
    face: int
    bary: np.ndarray  # (3,), weights of the three vertices
    front: bool


def find_hits(scene: PlainScene, row: int, col: int, t: float, place=(0.5, 0.5)) -> list[Hit]:
    """Return the surfaces on a ray at an instant, nearest first."""
    x0, y0 = scene.pixel_ndc(row, col, place)
    hits = []
    for m, mesh in enumerate(scene.meshes):
        clip = clip_at(scene, mesh, t)
        reduced = np.stack([clip[:, 0] - x0 * clip[:, 3], clip[:, 1] - y0 * clip[:, 3]], -1)[mesh.faces]
        e = _edges_of(reduced)
        total = e.sum(-1)
        z, w = ((e * clip[mesh.faces][..., k]).sum(-1) for k in (2, 3))
        inside = ((e > 0).all(-1) | (e < 0).all(-1)) & (total * (w + z) >= 0) & (total * (w - z) >= 0)
        if not mesh.double_sided:
            inside &= total > 0
        for f in np.flatnonzero(inside):
            hits.append(Hit(z[f] / w[f], w[f] / total[f], m, int(f), e[f] / total[f], bool(total[f] > 0)))
    return sorted(hits, key=lambda h: h.depth)


def _edges_of(reduced: np.ndarray) -> np.ndarray:
    """Return (F, 3) edge functions of reduced vertices (F, 3, 2)."""
    return np.stack([cross2(reduced[:, (i + 1) % 3], reduced[:, (i + 2) % 3]) for i in range(3)], -1)


def sample_pixel(scene: PlainScene, row: int, col: int, times: np.ndarray, place=(0.5, 0.5)) -> np.ndarray:
    """Return (N, 4) colours of a pixel at instants."""
    background = scene.pixel_background(row, col)
    rows = []
    for t in times:
        layers = [
            (scene.meshes[h.mesh].face_color(h.face), scene.meshes[h.mesh].face_alpha(h.face), h.mesh)
            for h in find_hits(scene, row, col, float(t), place)
        ]
        rows.append(over(layers, background)[0])
    return np.array(rows).reshape(-1, 4)


def place_px(scene: PlainScene, hit: Hit, t: float) -> np.ndarray:
    """Return the screen position [px] of the material point of a hit at another time; NaN behind the camera."""
    clip = hit.bary @ clip_at(scene, scene.meshes[hit.mesh], t)[scene.meshes[hit.mesh].faces[hit.face]]
    if clip[3] <= 0:
        return np.full(2, np.nan)
    return np.array([(clip[0] / clip[3] + 1) * scene.width / 2, (1 - clip[1] / clip[3]) * scene.height / 2])


@dataclass(frozen=True)
class Layer:
    """A surface on the ray during [t_start, t_end] with depth z0 + (z1 - z0) t; all in rational numbers."""

    t_start: Fraction
    t_end: Fraction
    z0: Fraction
    z1: Fraction
    color: tuple[float, float, float]
    alpha: float

    def depth(self, t: Fraction) -> Fraction:
        """Return the depth at t."""
        return self.z0 + (self.z1 - self.z0) * t


def composite_layers(layers: list[Layer], background: tuple[float, float, float]) -> np.ndarray:
    """Return RGBA of the exposure [0, 1], every event time exact."""
    cuts = {Fraction(0), Fraction(1)} | {t for k in layers for t in (k.t_start, k.t_end)}
    for i, a in enumerate(layers):
        for b in layers[:i]:
            slope = (a.z1 - a.z0) - (b.z1 - b.z0)
            if slope:
                cuts.add((b.z0 - a.z0) / slope)
    times = sorted(t for t in cuts if 0 <= t <= 1)
    total = np.zeros(4)
    for t0, t1 in itertools.pairwise(times):
        middle = (t0 + t1) / 2
        active = sorted((k for k in layers if k.t_start <= t0 and t1 <= k.t_end), key=lambda k: k.depth(middle))
        color, _ = over([(np.array(k.color), k.alpha, 0) for k in active], np.array(background))
        total += float(t1 - t0) * color
    return total
