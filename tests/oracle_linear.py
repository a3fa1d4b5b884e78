"""The mean of a pixel under any shutter, exactly and by the rules of Ronnow et al. 2021, in plain numpy.

It imports nothing of torchblur.

The linear rule. A stay (when a face covers the pixel, within one piece of its motion and the shutter's whole span) is
known by its two ends: z / w, the place on the texture and the position run straight in time between them, the normal is
that of the start. Stays of faces of opacity 0 are left out. Cells are cut where a stay starts or ends, and where two
change places that no opaque one hides. The slice of a layer in a cell is
looked up by two anisotropic lookups, one for each half of its way on the texture: N = min(16, ceil(major / minor)) taps
in the middles of equal parts, at level log2(major / N); minor is the footprint at the start of the stay, at least one
texel, and one texel without mip levels; major the length of the half in texels, at least minor (the rule of
EXT_texture_filter_anisotropic). The means are premultiplied. Light is that of the middle of the slice. The layers' mean
colours are composited.

Symbols as in oracles.py.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
from oracle_looks import (
    NODES,
    WEIGHTS,
    Look,
    LookScene,
    arriving,
    edges_through,
    find_bends,
    footprint,
    knots_at,
    look_of_piece,
    normal_of,
    over,
    trilinear,
)
from oracles import Piece, crossings, find_pieces, lerp

MAX_TAPS = 16
INSET = 1e-6  # of a stay: its ends are looked at so far inside
SAME_DEPTH = 1e-9  # closer surfaces may be one
SHORT = 1e-12  # shutter time


@dataclass(frozen=True)
class PlainShutter:
    """Weights at times, linear between, delayed line by line."""

    times: tuple[float, ...] = (0.0, 1.0)
    weights: tuple[float, ...] = (1.0, 1.0)
    line_delay: float = 0.0
    direction: str = "down"

    def delay(self, scene: LookScene, row: int, col: int) -> float:
        """Return by how much later than the first line a pixel is exposed."""
        return self.line_delay * {
            "down": row, "up": scene.height - 1 - row, "right": col, "left": scene.width - 1 - col
        }[self.direction]  # fmt: skip

    def span(self, scene: LookScene) -> tuple[float, float]:
        """Return when the first line opens and the last one closes."""
        n_lines = scene.height if self.direction in ("down", "up") else scene.width
        return self.times[0], self.times[-1] + self.line_delay * (n_lines - 1)

    def density(self, t: np.ndarray) -> np.ndarray:
        """Return the weight of times since the line's own start, of unit integral."""
        times, weights = np.array(self.times), np.array(self.weights)
        area = (np.diff(times) * (weights[1:] + weights[:-1])).sum() / 2
        return np.interp(t, times, weights, left=0, right=0) / area


@dataclass
class Answer:
    """What a pixel shows."""

    rgba: np.ndarray
    coverage: np.ndarray  # (M,)
    brightest: float  # that any surface in it could be, light at right angles
    is_clear: bool = True  # no two surfaces of different looks in one place
    cells: list[tuple[float, float, list[Piece]]] = field(default_factory=list)


@dataclass(eq=False)
class Stay:
    """A piece with what the linear rule knows of it."""

    piece: Piece
    t_start: float
    t_end: float
    depths: tuple[float, float]

    def depth(self, t: float) -> float:
        """Return the chord of z / w."""
        s = (t - self.t_start) / (self.t_end - self.t_start)
        return (1 - s) * self.depths[0] + s * self.depths[1]


def pieces_between(scene: LookScene, row: int, col: int, window: tuple[float, float], place) -> list[Piece]:
    """Return the stays inside a window of time, those that abut on the same side joined."""
    joined: list[Piece] = []
    for p in find_pieces(scene, row, col, place):
        q = joined[-1] if joined else None
        key = (p.mesh, p.face, p.ta, p.front)
        if q and key == (q.mesh, q.face, q.ta, q.front) and q.t_end == p.t_start:
            joined[-1] = replace(q, t_end=p.t_end)
        else:
            joined.append(p)
    cut = [replace(p, t_start=max(p.t_start, window[0]), t_end=min(p.t_end, window[1])) for p in joined]
    return [p for p in cut if p.t_end - p.t_start > SHORT]  # a line may cover a ray for a rounding error


def has_ties(scene: LookScene, row: int, col: int, place=(0.5, 0.5)) -> bool:
    """Return whether an edge lies on the ray, or a face in a clip plane, for a while: oracles.py decides no ties."""
    x0, y0 = scene.pixel_ndc(row, col, place)
    for mesh in scene.meshes:
        matrices = np.broadcast_to(scene.camera_knots()[:, None], (len(scene.camera_knots()), len(mesh.knots()), 4, 4))
        world = np.concatenate([mesh.knots(), np.ones((*mesh.knots().shape[:2], 1))], 2)
        clip = np.einsum("ckij,kvj->ckvi", matrices, world)[:, :, mesh.faces].reshape(-1, len(mesh.faces), 3, 4)
        a = np.stack([clip[..., 0] - x0 * clip[..., 3], clip[..., 1] - y0 * clip[..., 3]], -1)
        lengths = np.linalg.norm(a[:, :, [1, 2, 0]] - a, axis=-1)
        b = a[:, :, [1, 2, 0]]
        distance = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        scale = np.abs(clip).max((2, 3))[..., None]
        near = (distance <= 1e-9 * scale * lengths) & (lengths > 0)
        if near.any():
            return True
    return False


def shows_the_same(one: Look, two: Look) -> bool:
    """Return whether two looks are equal."""
    return np.allclose(one.rgb, two.rgb, atol=1e-9) and np.allclose(one.alpha, two.alpha, atol=1e-9)


def exact_pixel(scene: LookScene, shutter: PlainShutter, row: int, col: int, place=(0.5, 0.5)) -> Answer:
    """Return the mean of a pixel's ray, good to about 1e-9 of the brightest."""
    ndc, background = scene.pixel_ndc(row, col, place), scene.pixel_background(row, col)
    delay = shutter.delay(scene, row, col)
    opens, closes = shutter.times[0] + delay, shutter.times[-1] + delay
    pieces = pieces_between(scene, row, col, (opens, closes), place)
    cuts = {t + delay for t in shutter.times}.union(*(light.knot_times() for light in scene.lights))
    for k, p in enumerate(pieces):
        cuts.update((p.t_start, p.t_end))
        if varies(scene, p):
            cuts.update(find_bends(scene, p, ndc))
        for q in pieces[:k]:
            cuts.update(crossings(p, q))
    answer = Answer(np.zeros(4), np.zeros(len(scene.meshes)), float(np.max(background)))
    for a, b in itertools.pairwise(sorted(t for t in cuts if opens <= t <= closes)):
        if b - a <= SHORT:
            continue
        middle = (a + b) / 2
        active = sorted((p for p in pieces if p.t_start < middle < p.t_end), key=lambda p: p.depth(middle))
        answer.cells.append((a, b, active))
        _add_cell(answer, scene, (a, b), active, (ndc, background, lambda t: shutter.density(t - delay)))
    return answer


def varies(scene: LookScene, piece: Piece) -> bool:
    """Return whether a face looks different at different times."""
    mesh = scene.meshes[piece.mesh]
    return mesh.texture is not None or mesh.shading == "lambert"


def _add_cell(answer: Answer, scene: LookScene, cell: tuple[float, float], active: list[Piece], rest) -> None:
    """Add the integral over a cell, halved until that changes nothing."""
    ndc, background, density = rest
    is_flat = not any(varies(scene, p) for p in active)
    todo = [(*cell, 0)]
    while todo:
        a, b, depth = todo.pop()
        middle = (a + b) / 2
        panels = np.array([[a, b], [a, middle], [middle, b]])
        t = (panels.mean(1)[:, None] + (panels[:, 1] - panels[:, 0])[:, None] / 2 * NODES).ravel()
        looks = [look_of_piece(scene, p, t, ndc) for p in active]
        answer.brightest = max([answer.brightest, *(look.brightest.max() for look in looks)])
        for (p, one), (q, two) in itertools.pairwise(zip(active, looks, strict=True)):
            close = all(abs(p.depth(x) - q.depth(x)) < SAME_DEPTH for x in (a + 0.3 * (b - a), middle))
            answer.is_clear &= not (close and not shows_the_same(one, two) and b - a > 1e-9)
        h = density(t)[:, None]
        values = over(looks, background, len(t)) * h
        left, seen = np.ones(len(t)), np.zeros((len(t), len(scene.meshes)))
        for p, look in zip(active, looks, strict=True):
            seen[:, p.mesh] = np.maximum(seen[:, p.mesh], (left > 1e-9) & (look.alpha > 0))
            left = left * (1 - look.alpha)
        values = np.concatenate([values, seen * h], 1).reshape(3, 16, -1)
        once, first, second = np.einsum("pnc,n->pc", values, WEIGHTS / 2)
        twice = (first + second) / 2
        if not is_flat and depth < 16 and np.abs(once - twice)[:4].max() * (b - a) > 1e-9 * answer.brightest:
            todo += [(a, middle, depth + 1), (middle, b, depth + 1)]
        else:
            answer.rgba += twice[:4] * (b - a)
            answer.coverage += twice[4:] * (b - a)


def linear_pixel(scene: LookScene, shutter: PlainShutter, row: int, col: int, place=(0.5, 0.5)) -> Answer:
    """Return the mean of a pixel's ray by the linear rule."""
    ndc, background = scene.pixel_ndc(row, col, place), scene.pixel_background(row, col)
    delay = shutter.delay(scene, row, col)
    pieces = pieces_between(scene, row, col, shutter.span(scene), place)
    stays = [Stay(p, p.t_start, p.t_end, _end_depths(p)) for p in pieces if scene.meshes[p.mesh].face_alpha(p.face) > 0]
    cuts = {t for p in stays for t in (p.t_start, p.t_end)} | {t + delay for t in shutter.times}
    for p, q in itertools.combinations(stays, 2):
        low, high = max(p.t_start, q.t_start), min(p.t_end, q.t_end)
        before, after = p.depth(low) - q.depth(low), p.depth(high) - q.depth(high)
        if low < high and before * after < 0:
            t = low + (high - low) * before / (before - after)
            nearer = p.depth(t) - SAME_DEPTH
            others = (s for s in stays if s.t_start < t < s.t_end and s.depth(t) < nearer)
            if not any(_is_opaque(scene, s.piece) for s in others):
                cuts.add(t)
    answer = Answer(np.zeros(4), np.zeros(len(scene.meshes)), float(np.max(background)))
    total = 0.0  # cells are cut at the events of the whole span; a rolling line weighs them by what it sees of them
    for a, b in itertools.pairwise(sorted(cuts)):
        if b - a <= SHORT:
            continue
        middle = (a + b) / 2
        weight = _integral(shutter, a - delay, b - delay)
        active = sorted((p for p in stays if p.t_start < middle < p.t_end), key=lambda p: p.depth(middle))
        looks = [_mean_look(scene, stay, (a, b), ndc) for stay in active]
        answer.brightest = max([answer.brightest, *(float(look.brightest.max()) for look in looks)])
        for (p, one), (q, two) in itertools.pairwise(zip(active, looks, strict=True)):
            close = all(abs(p.depth(x) - q.depth(x)) < SAME_DEPTH for x in (a, b))
            answer.is_clear &= not (close and not shows_the_same(one, two) and b - a > 1e-9)
        answer.rgba += weight * over(looks, background, 1)[0]
        total += weight
        left, seen = 1.0, set()
        for stay, look in zip(active, looks, strict=True):
            if left > 1e-9 and look.alpha[0] > 0:
                seen.add(stay.piece.mesh)
            left *= 1 - look.alpha[0]
        answer.coverage[list(seen)] += weight
    answer.rgba[:3] += (1 - total) * np.asarray(background)
    return answer


def _is_opaque(scene: LookScene, piece: Piece) -> bool:
    """Return whether a face hides all behind it."""
    mesh = scene.meshes[piece.mesh]
    varies = mesh.texture is not None and mesh.texture.shape[2] == 4 and (mesh.texture[..., 3] < 1).any()
    return mesh.face_alpha(piece.face) == 1 and not varies


def _integral(shutter: PlainShutter, a: float, b: float) -> float:
    """Return the integral of the weight over [a, b], piece by piece."""
    cuts = sorted({a, b, *(t for t in shutter.times if a < t < b)})
    inside = [(max(x, shutter.times[0]), min(y, shutter.times[-1])) for x, y in itertools.pairwise(cuts)]
    return sum((y - x) * float(shutter.density(np.array((x + y) / 2))) for x, y in inside if y > x)


def _end_depths(piece: Piece) -> tuple[float, float]:
    """Return z / w at both ends of a piece; where the face is seen edge-on, the limit from inside."""
    length, depths = piece.t_end - piece.t_start, []
    largest = max(abs(piece.depth_parts(piece.t_start + s * length)[1]) for s in np.linspace(0, 1, 9))
    for end, inwards in ((piece.t_start, length), (piece.t_end, -length)):
        z, w = piece.depth_parts(end)
        if abs(w) > 1e-6 * largest:
            depths.append(float(z / w))
        else:
            a, b, c = (piece.depth(end + k * 1e-4 * inwards) for k in (1, 2, 3))
            depths.append(3 * a - 3 * b + c)
    return depths[0], depths[1]


def _mean_look(scene: LookScene, stay: Stay, cell: tuple[float, float], ndc: tuple[float, float]) -> Look:
    """Return the mean look of a stay over a cell, by the linear rule."""
    p, length = stay.piece, stay.t_end - stay.t_start
    mesh = scene.meshes[p.mesh]
    t = np.array([stay.t_start + INSET * length, stay.t_end - INSET * length])
    s = (t - p.ta) / (p.tb - p.ta)
    reduced, zw = lerp(*p.edge_ends, s), lerp(*p.zw_ends, s)
    clip = np.concatenate([reduced + zw[..., 1:] * np.array(ndc), zw], -1)
    share = (np.array(cell) - stay.t_start) / length
    rgb, alpha = np.array(mesh.face_color(p.face), dtype=np.float64), mesh.face_alpha(p.face)
    if mesh.texture is not None:
        uv, rho = footprint(scene, mesh, p.face, clip, ndc)
        ends = (1 - share[:, None]) * uv[0] + share[:, None] * uv[1]
        middle = ends.mean(0)
        minor = max(rho[0], 1.0) if mesh.mipmap else 1.0
        rgba = (_lookup(mesh, ends[0], middle, minor) + _lookup(mesh, middle, ends[1], minor)) / 2
        rgb, alpha = rgb * (rgba[:3] / rgba[3] if rgba[3] > 0 else 0), alpha * rgba[3]
    light = brightest = np.ones(3)
    if mesh.shading == "lambert":
        e = edges_through(clip, *ndc)
        bary = e / e.sum(1, keepdims=True)
        corners = knots_at(mesh.vertices, t, 2)[:, mesh.faces[p.face]]
        first, last = (bary[:, :, None] * corners).sum(1)
        normal = normal_of(scene, mesh, p.face, bary, t, e.sum(1) > 0)[:1]
        now = np.array([(cell[0] + cell[1]) / 2])
        point = ((1 - share.mean()) * first + share.mean() * last)[None]
        light = brightest = np.array(scene.ambient, dtype=np.float64)
        for source in scene.lights:
            irradiance, way, _ = arriving(source, point, now)
            light = light + irradiance[0] / np.pi * max(0.0, float((normal * way).sum()))
            brightest = brightest + irradiance[0] / np.pi
    return Look((rgb * light)[None], np.array([alpha]), (rgb * brightest).max(keepdims=True), np.zeros((1, 1)))


def _lookup(mesh, first: np.ndarray, last: np.ndarray, minor: float) -> np.ndarray:
    """Return the premultiplied mean (4,) of the taps between two places."""
    major = max(float(np.linalg.norm((last - first) * mesh.texture.shape[1::-1])), minor)
    n = min(MAX_TAPS, int(np.ceil(major / minor)))
    level = np.log2(max(major / n, 1.0)) if mesh.mipmap else 0.0
    uv = first + (last - first) * ((np.arange(n) + 0.5) / n)[:, None]
    rgba, _ = trilinear(mesh.levels, uv, np.full(n, 2.0**level), mesh.wrap)
    return np.concatenate([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:]], 1).mean(0)
