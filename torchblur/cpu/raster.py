"""Which faces the rays of some rows of pixels meet, compiled: boxes on screen, nearest opaque faces, lists of others.

Before: jit.py.  After: layers.py, instant.py.
Symbols: V vertices, F faces, N parts (a mesh during a slice of time in which its vertices move linearly), P rays of a
block of rows; e_i edge function opposite corner i. A ray's part time u is 0 at the part's start and 1 at its end; what
rests has parts of no length. The tests are those of fragments.py and time_samples.py, operation by operation, so that
a ray on an edge, or two coplanar faces, turn out as they do there.
Source: Olano & Greer 1997 (homogeneous rasterisation); Akenine-Moller et al. 2007 (corners at the ray's own time).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cpu.jit import jit

HIDDEN, OPAQUE, OTHER = 0, 1, 2  # kinds of faces
DOUBT = 1e-9  # relative: opaque surfaces nearer to each other than this go through the lists, where ties are resolved
SLACK_PX = 1e-6  # widening of boxes against rounding
ROUNDING = 1e-12  # of the product of the factors' sizes: far above that of an edge function
WIDE = 4  # columns of a box from which on its rows are narrowed
MIN_W = 1e-300  # against division by zero where a corner is discarded anyway


class Shape(NamedTuple):
    """Where the faces are during one instant, or one slice of the exposure."""

    clip_start: np.ndarray  # (V', 4) float64 clip space at the parts' starts
    clip_end: np.ndarray  # (V', 4) at their ends; the same array where all rests
    corner: np.ndarray  # (F, 3) int32 vertices of the faces, all meshes end to end
    face_range: np.ndarray  # (N, 2) int64 first face of each part, and that after the last
    shift: np.ndarray  # (N,) int64 what to add to the corners' numbers
    times: np.ndarray  # (N, 2) float64 shutter times of start and end
    box: np.ndarray  # (faces of all parts, 4) int32 x0 y0 x1 y1 of the pixels that may be covered, inclusive


class Faces(NamedTuple):
    """What of the faces decides who is seen."""

    kind: np.ndarray  # (F,) uint8 HIDDEN, OPAQUE or OTHER
    one_sided: np.ndarray  # (F,) bool
    rank: np.ndarray  # (F,) int64 who is in front among coplanar faces


class Rays(NamedTuple):
    """One ray for each pixel of some rows, seen at its own time."""

    x_ndc: np.ndarray  # (W,) of the columns if `is_grid`, else (P,)
    y_ndc: np.ndarray  # (rows,) or (P,)
    t: np.ndarray  # (P,) float64 shutter times; (1,) if all are the same
    is_grid: bool  # same place in each pixel
    width: int
    orders_by_w: bool
    window_end: float  # the last part owns its end


class Found(NamedTuple):
    """What the rays of a band of rows meet."""

    nearness: np.ndarray  # (Q,) of the nearest opaque face; 0 where there is none
    face: np.ndarray  # (Q,) int32 that face; -1
    part: np.ndarray  # (Q,) int32
    is_doubtful: np.ndarray  # (Q,) bool: other opaque faces are as near
    head: np.ndarray  # (Q,) int32 last listed node; -1


class Nodes(NamedTuple):
    """Faces met, in lists by pixel."""

    following: np.ndarray  # (n,) int32 next node of the pixel; -1
    nearness: np.ndarray  # (n,) float64
    face: np.ndarray  # (n,) int32
    part: np.ndarray  # (n,) int32


@jit
def find_boxes(shape, size, bounds):
    """Fill `shape.box`; `size` is width and height of the image and the number of rows of the block, `bounds` are the
    least and greatest x and y of its rays inside their pixels, y from the block's first row back.

    Where a corner is behind the near plane, the triangle's edges, or for a moving one all lines between its corners,
    are cut there. Source: as fragments.py and prisms.py.
    """
    n_vertices = len(shape.clip_start)
    width, height, n_rows = size
    moves = (shape.times[:, 1] > shape.times[:, 0]).any()
    place = np.empty((2, n_vertices, 2))
    in_front = np.empty((2, n_vertices), dtype=np.bool_)
    for end in range(2):
        clip = shape.clip_start if end == 0 else shape.clip_end
        for v in range(n_vertices):
            w = clip[v, 3]
            in_front[end, v] = clip[v, 2] + w >= 0 and w > 0
            inverse = 1 / max(w, MIN_W)
            place[end, v, 0] = (clip[v, 0] * inverse + 1) * (0.5 * width)
            place[end, v, 1] = (1 - clip[v, 1] * inverse) * (0.5 * height)
        if not moves:
            break
    points = np.empty((6, 4))
    b = 0
    for n in range(len(shape.shift)):
        n_ends = 2 if shape.times[n, 1] > shape.times[n, 0] else 1
        for f in range(shape.face_range[n, 0], shape.face_range[n, 1]):
            low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
            all_in_front = True
            for end in range(n_ends):
                for i in range(3):
                    v = shape.corner[f, i] + shape.shift[n]
                    all_in_front = all_in_front and in_front[end, v]
                    x, y = place[end, v, 0], place[end, v, 1]
                    low_x, high_x = min(low_x, x), max(high_x, x)
                    low_y, high_y = min(low_y, y), max(high_y, y)
            if not all_in_front:
                for end in range(n_ends):
                    clip = shape.clip_start if end == 0 else shape.clip_end
                    for i in range(3):
                        points[3 * end + i] = clip[shape.corner[f, i] + shape.shift[n]]
                low_x, low_y, high_x, high_y = _clipped_extent(points[: 3 * n_ends], width, height)
            shape.box[b, 0] = np.int32(np.ceil(min(max(low_x - SLACK_PX - bounds[1], 0.0), width)))
            shape.box[b, 1] = np.int32(np.ceil(min(max(low_y - SLACK_PX - bounds[3], 0.0), n_rows)))
            shape.box[b, 2] = np.int32(np.floor(min(max(high_x + SLACK_PX - bounds[0], -1.0), width - 1.0)))
            shape.box[b, 3] = np.int32(np.floor(min(max(high_y + SLACK_PX - bounds[2], -1.0), n_rows - 1.0)))
            b += 1


@jit
def _clipped_extent(points, width, height):
    """Return x0 y0 x1 y1 [px] of the hull of points (n, 4) before the near plane; all of it where w fails."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    n = len(points)
    for i in range(n):
        near_i = points[i, 2] + points[i, 3]
        for j in range(i, n):
            near_j = points[j, 2] + points[j, 3]
            if i == j:
                if near_i < 0:
                    continue
                share = 0.0
            else:
                if (near_i >= 0) == (near_j >= 0):
                    continue
                share = near_i / (near_i - near_j)
            w = points[i, 3] + share * (points[j, 3] - points[i, 3])
            if w <= 0:
                return -np.inf, -np.inf, np.inf, np.inf
            w = max(w, MIN_W)
            x = ((points[i, 0] + share * (points[j, 0] - points[i, 0])) / w + 1) * (0.5 * width)
            y = (1 - (points[i, 1] + share * (points[j, 1] - points[i, 1])) / w) * (0.5 * height)
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
    return low_x, low_y, high_x, high_y


@jit
def sign_of(e, a0, b0, a1, b1):
    """Return an edge value, or if it is 0 the first of its slopes along x and y that is not, as if the ray were moved
    by (eps, eps^2); `a0 b0 a1 b1` are the products that make the slopes.
    """
    if e != 0:
        return e
    along_x = a0 - b0
    return along_x if along_x != 0 else a1 - b1


@jit
def facing(corner0, corner1, corner2):
    """Return +1 where the ray is inside and the face turns counter-clockwise, -1 where clockwise, 0 outside; and e_i of
    reduced corners.
    """
    (x0, y0, _, w0), (x1, y1, _, w1), (x2, y2, _, w2) = corner0, corner1, corner2
    e0, e1, e2 = x1 * y2 - y1 * x2, x2 * y0 - y2 * x0, x0 * y1 - y0 * x1
    s0 = sign_of(e0, y1 * w2, w1 * y2, w1 * x2, x1 * w2)
    s1 = sign_of(e1, y2 * w0, w2 * y0, w2 * x0, x2 * w0)
    s2 = sign_of(e2, y0 * w1, w0 * y1, w0 * x1, x0 * w1)
    sign = 0
    if s0 > 0 and s1 > 0 and s2 > 0:
        sign = 1
    elif s0 < 0 and s1 < 0 and s2 < 0:
        sign = -1
    return sign, e0, e1, e2


@jit
def hit_nearness(e, corner0, corner1, corner2, orders_by_w):
    """Return how near a hit is, larger is nearer, or -1 if it is not between the clip planes."""
    e0, e1, e2 = e
    scale = e0 + e1 + e2
    b0, b1, b2 = e0 / scale, e1 / scale, e2 / scale
    z_hit = b0 * corner0[2] + b1 * corner1[2] + b2 * corner2[2]
    w_hit = b0 * corner0[3] + b1 * corner1[3] + b2 * corner2[3]
    if not (z_hit + w_hit >= 0 and w_hit - z_hit >= 0 and np.isfinite(b0) and np.isfinite(b1) and np.isfinite(b2)):
        return -1.0
    return 1 / w_hit if orders_by_w else 2 - z_hit / w_hit


@jit
def part_time(start, end, t):
    """Return the part time of shutter time `t`: 0 in a part of no length."""
    return (t - start) / (end - start) if end > start else 0.0


@jit
def corner_at(clip, v):
    """Return x, y, z, w of vertex `v`."""
    return clip[v, 0], clip[v, 1], clip[v, 2], clip[v, 3]


@jit
def reduced(corner, x_ndc, y_ndc):
    """Return x and y of a corner as a ray sees them, z and w."""
    x, y, z, w = corner
    return x - x_ndc * w, y - y_ndc * w, z, w


@jit
def between(start, end, u):
    """Return x, y, z, w at part time `u`; at 0 and 1 the ends, bit for bit."""
    v = 1 - u
    return (
        v * start[0] + u * end[0],
        v * start[1] + u * end[1],
        v * start[2] + u * end[2],
        v * start[3] + u * end[3],
    )


@jit
def row_span(first, last, n):
    """Return the first and last of `n` columns, counted from 0, in which a row can meet a face whose corners are
    `first` and `last` as the rays at both ends of the row see them; the last is below the first if there is none.

    Along a row edge functions are linear. What may be 0 but for rounding is kept. Source: ours.
    """
    (ax, ay, _, _), (bx, by, _, _), (cx, cy, _, _) = first
    (dx, dy, _, _), (ex, ey, _, _), (fx, fy, _, _) = last
    size_x = max(abs(ax), abs(bx), abs(cx), abs(dx), abs(ex), abs(fx))
    room = ROUNDING * size_x * max(abs(ay), abs(by), abs(cy))
    at_first = (bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx)
    at_last = (ex * fy - ey * fx, fx * dy - fy * dx, dx * ey - dy * ex)
    if not np.isfinite(room + sum(at_first) + sum(at_last)):
        return 0, n - 1
    low, high = n, -1
    for sign in (1.0, -1.0):  # where all edge functions have this sign, or might
        start, end = 0.0, n - 1.0
        for i in range(3):
            value, change = sign * at_first[i] + room, sign * (at_last[i] - at_first[i]) / (n - 1)
            if change > 0:
                start = max(start, -value / change)
            elif change < 0:
                end = min(end, -value / change)
            elif value < 0:
                end = -2.0
        if start <= end + 1:
            low, high = min(low, int(start)), max(high, min(int(end) + 1, n - 1))
    return low, high


@jit
def scan(shape, faces, rays, rows, found, lists):
    """Find the nearest opaque faces in rows `rows[0]` to `rows[1]`, or list others that may be before these; `lists` is
    the nodes, how many of them are used, and whether to list.

    Returns:
        The nodes, which may have grown, and how many are used.
    """
    width = rays.width
    nodes, count, is_listing = lists
    following, near, node_face, node_part = nodes.following, nodes.nearness, nodes.face, nodes.part
    b = -1
    for n in range(len(shape.shift)):
        start, end, shift = shape.times[n, 0], shape.times[n, 1], shape.shift[n]
        moves = end > start
        is_last = end == rays.window_end
        for f in range(shape.face_range[n, 0], shape.face_range[n, 1]):
            b += 1
            kind = faces.kind[f]
            if kind == HIDDEN or (kind == OTHER and not is_listing):
                continue
            y_first, y_last = max(shape.box[b, 1], rows[0]), min(shape.box[b, 3], rows[1] - 1)
            x_first, x_last = shape.box[b, 0], shape.box[b, 2]
            if y_first > y_last or x_first > x_last:
                continue
            v0, v1, v2 = shape.corner[f, 0] + shift, shape.corner[f, 1] + shift, shape.corner[f, 2] + shift
            from0, from1, from2 = (
                corner_at(shape.clip_start, v0),
                corner_at(shape.clip_start, v1),
                corner_at(shape.clip_start, v2),
            )
            to0, to1, to2 = corner_at(shape.clip_end, v0), corner_at(shape.clip_end, v1), corner_at(shape.clip_end, v2)
            n_columns = x_last - x_first + 1
            for row in range(y_first, y_last + 1):
                low, high = 0, n_columns - 1
                if n_columns > WIDE and not moves and rays.is_grid:
                    rx, end_x, ry = rays.x_ndc[x_first], rays.x_ndc[x_last], rays.y_ndc[row]
                    low, high = row_span(
                        (reduced(from0, rx, ry), reduced(from1, rx, ry), reduced(from2, rx, ry)),
                        (reduced(from0, end_x, ry), reduced(from1, end_x, ry), reduced(from2, end_x, ry)),
                        n_columns,
                    )
                for column in range(x_first + low, x_first + high + 1):
                    p = row * width + column
                    rx = rays.x_ndc[column] if rays.is_grid else rays.x_ndc[p]
                    ry = rays.y_ndc[row] if rays.is_grid else rays.y_ndc[p]
                    if moves:
                        t = rays.t[p]
                        if t < start or t > end or (t == end and not is_last):
                            continue
                        u = part_time(start, end, t)
                        corner0 = between(reduced(from0, rx, ry), reduced(to0, rx, ry), u)
                        corner1 = between(reduced(from1, rx, ry), reduced(to1, rx, ry), u)
                        corner2 = between(reduced(from2, rx, ry), reduced(to2, rx, ry), u)
                    else:
                        corner0 = reduced(from0, rx, ry)
                        corner1 = reduced(from1, rx, ry)
                        corner2 = reduced(from2, rx, ry)
                    sign, e0, e1, e2 = facing(corner0, corner1, corner2)
                    if sign == 0 or (sign < 0 and faces.one_sided[f]):
                        continue
                    here = hit_nearness((e0, e1, e2), corner0, corner1, corner2, rays.orders_by_w)
                    if here < 0:
                        continue
                    q = p - rows[0] * width
                    if not is_listing:
                        if here > found.nearness[q] * (1 + DOUBT):
                            found.is_doubtful[q] = False
                        elif here >= found.nearness[q] * (1 - DOUBT):
                            found.is_doubtful[q] = True
                        if here > found.nearness[q]:
                            found.nearness[q], found.face[q], found.part[q] = here, f, n
                        continue
                    if here < found.nearness[q] * (1 - DOUBT) or (kind == OPAQUE and not found.is_doubtful[q]):
                        continue
                    if count == len(near):
                        following = np.concatenate((following, np.empty_like(following)))
                        near = np.concatenate((near, np.empty_like(near)))
                        node_face = np.concatenate((node_face, np.empty_like(node_face)))
                        node_part = np.concatenate((node_part, np.empty_like(node_part)))
                    following[count], found.head[q] = found.head[q], count
                    near[count], node_face[count], node_part[count] = here, f, n
                    count += 1
    return Nodes(following, near, node_face, node_part), count
