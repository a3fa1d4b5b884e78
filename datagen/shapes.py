"""Shapes: the triangles of the built-in solids, sheets and thin parts.

Before: nothing.  After: patterns.py colours them, scenes.py throws them about.
Symbols: V vertices, F faces; a cell is what one colour covers (a quad or a triangle), with its place (u, v) in [0, 1]².
Closed shapes are wound counter-clockwise seen from outside. Points that belong together are equal bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles about the origin, within a radius of about 1."""

    vertices: Tensor  # (V, 3) float64 [scene units]
    faces: Tensor  # (F, 3) int64
    cell_uv: Tensor  # (F, 2) float64, place of the face's cell on its surface
    is_closed: bool  # without boundary: its back faces can never be seen

    def normals(self) -> Tensor:
        """Return (F, 3) float64 unit normals; of a degenerate face, zero. Source: ours."""
        a, b, c = self.vertices[self.faces].unbind(1)
        normal = torch.linalg.cross(b - a, c - a, dim=-1)
        return normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-300)

    def centres(self) -> Tensor:
        """Return (F, 3) float64 face centres. Source: ours."""
        return self.vertices[self.faces].mean(1)

    def scaled(self, factors: Sequence[float]) -> Shape:
        """Return the shape stretched by three positive factors. Source: ours."""
        return Shape(
            self.vertices * torch.tensor(factors, dtype=torch.float64), self.faces, self.cell_uv, self.is_closed
        )


def join_shapes(shapes: Sequence[Shape]) -> Shape:
    """Return several shapes as one. Source: ours."""
    starts = [0]
    for shape in shapes:
        starts.append(starts[-1] + len(shape.vertices))
    faces = [s.faces + start for s, start in zip(shapes, starts, strict=False)]
    uv = torch.cat([s.cell_uv for s in shapes])
    return Shape(torch.cat([s.vertices for s in shapes]), torch.cat(faces), uv, all(s.is_closed for s in shapes))


def grid_shape(place: Callable[[Tensor, Tensor], Tensor], n_u: int, n_v: int, is_closed: bool = False) -> Shape:
    """Return n_u × n_v quads, two triangles each, over the unit square bent by `place`.

    Args:
        place: (u (P,), v (P,)) -> (P, 3); outside is where u × v points.
        n_u, n_v: quads along each side.
        is_closed: whether `place` leaves no boundary.

    Source: ours.
    """
    u, v = torch.meshgrid(_steps(n_u), _steps(n_v), indexing="ij")
    vertices = place(u.flatten(), v.flatten())
    i, j = torch.meshgrid(torch.arange(n_u), torch.arange(n_v), indexing="ij")
    a = (i * (n_v + 1) + j).flatten()
    b, c, d = a + n_v + 1, a + n_v + 2, a + 1
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)], 1).reshape(-1, 3)
    centre = torch.stack([(i.flatten() + 0.5) / n_u, (j.flatten() + 0.5) / n_v], -1).to(torch.float64)
    return Shape(vertices, faces, centre.repeat_interleave(2, 0), is_closed)


def sheet(n: int = 10, wave: float = 0.0, aspect: float = 1.0) -> Shape:
    """Return a sheet in the x-y plane, 2 by 2 * aspect, with ripples `wave` high. Source: ours."""

    def place(u: Tensor, v: Tensor) -> Tensor:
        x, y = 2 * u - 1, (2 * v - 1) * aspect
        return torch.stack([x, y, wave * torch.sin(3.5 * x) * torch.cos(2.5 * y)], -1)

    return grid_shape(place, n, max(1, round(n * aspect)))


def box(n: int = 5, size: Sequence[float] = (1.0, 1.0, 1.0)) -> Shape:
    """Return a box with half sides `size`, each side of n × n quads. Source: ours."""
    sides = []
    for axis in range(3):
        for sign in (1.0, -1.0):

            def place(u: Tensor, v: Tensor, axis: int = axis, sign: float = sign) -> Tensor:
                a, b = ((2 * w - 1).mul(n).round() / n for w in (u, v))  # exact opposites, so that the sides meet
                columns = [torch.full_like(u, sign), a * sign, b]  # the sign turns the winding outward
                return torch.stack([columns[(k - axis) % 3] for k in range(3)], -1)

            sides.append(grid_shape(place, n, n, is_closed=True))
    return join_shapes(sides).scaled(size)


def revolve(profile: Sequence[tuple[float, float]], n_around: int) -> Shape:
    """Return the surface that a profile of (radius, height), from bottom to top, sweeps about the y axis.

    It is closed if the profile starts and ends on the axis. Source: ours.
    """
    points = torch.tensor(profile, dtype=torch.float64)
    last = len(profile) - 1

    def place(u: Tensor, v: Tensor) -> Tensor:
        angle = torch.where(u == 1, torch.zeros_like(u), u) * (2 * math.pi)  # the seam's two ends are one place
        ring = points[(v * last).round().long()]
        return torch.stack([ring[:, 0] * torch.sin(angle), ring[:, 1], ring[:, 0] * torch.cos(angle)], -1)

    return grid_shape(place, n_around, last, is_closed=profile[0][0] == 0 and profile[-1][0] == 0)


def ball(n: int = 10) -> Shape:
    """Return a sphere of 2n slices and n rings. Source: ours."""
    angles = [math.pi * k / n for k in range(n + 1)]
    return revolve([(0.0 if k in (0, n) else math.sin(a), -math.cos(a)) for k, a in enumerate(angles)], 2 * n)


def cylinder(n: int = 20, half_height: float = 1.0, top: float = 1.0) -> Shape:
    """Return a cylinder with caps, or for `top` < 1 a cone's stump, for `top` = 0 a cone. Source: ours."""
    rows = 6
    side = [(1 + (top - 1) * k / rows, half_height * (2 * k / rows - 1)) for k in range(rows + 1)]
    caps = ([(0.0, -half_height), (0.5, -half_height)], [(top / 2, half_height), (0.0, half_height)])
    return revolve([*caps[0], *side, *(caps[1] if top > 0 else [])], n)


def vase(radii: Sequence[float], n: int = 20) -> Shape:
    """Return a turned body with the given radii at equal heights from -1 to 1, closed at both ends. Source: ours."""
    heights = [2 * k / (len(radii) - 1) - 1 for k in range(len(radii))]
    return revolve([(0.0, -1.0), *zip(radii, heights, strict=True), (0.0, 1.0)], n)


def tube(curve: Callable[[Tensor], Tensor], radius: float, n_along: int, n_around: int) -> Shape:
    """Return a tube about a closed curve.

    Args:
        curve: u (P,) in [0, 1) -> (P, 3); it must not point along z anywhere for long.
        radius: of the tube [scene units].
        n_along, n_around: quads along the curve and about it.

    Source: ours.
    """

    def place(u: Tensor, v: Tensor) -> Tensor:
        u, v = torch.where(u == 1, torch.zeros_like(u), u), torch.where(v == 1, torch.zeros_like(v), v)
        along = curve(u + 1e-4) - curve(u - 1e-4)
        along = along / along.norm(dim=-1, keepdim=True)
        side = torch.linalg.cross(along, torch.tensor([[0.0, 0.0, 1.0]], dtype=u.dtype).expand_as(along), dim=-1)
        side = side / side.norm(dim=-1, keepdim=True)
        other = torch.linalg.cross(along, side, dim=-1)
        angle = (v * (2 * math.pi)).unsqueeze(-1)
        return curve(u) + radius * (torch.cos(angle) * side + torch.sin(angle) * other)

    shape = grid_shape(place, n_along, n_around, is_closed=True)
    return shape if enclosed_volume(shape) > 0 else Shape(shape.vertices, shape.faces.flip(1), shape.cell_uv, True)


def torus(thickness: float = 0.3, n_along: int = 24, n_around: int = 10) -> Shape:
    """Return a ring in the x-y plane. Source: ours."""

    def circle(u: Tensor) -> Tensor:
        angle = 2 * math.pi * u
        return torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros_like(u)], -1) * (1 - thickness)

    return tube(circle, thickness, n_along, n_around)


def knot(n_along: int = 64, n_around: int = 6) -> Shape:
    """Return a trefoil knot. Source: the trefoil as a curve on a torus."""

    def trefoil(u: Tensor) -> Tensor:
        angle = 2 * math.pi * u
        radius = 0.62 + 0.24 * torch.cos(3 * angle)
        flat = [radius * torch.cos(2 * angle), radius * torch.sin(2 * angle)]
        return torch.stack([*flat, 0.3 * torch.sin(3 * angle)], -1)

    return tube(trefoil, 0.13, n_along, n_around)


def polyhedron(name: str, level: int = 0, is_round: bool = False) -> Shape:
    """Return a tetrahedron, octahedron or icosahedron, each face cut into 4**level, pushed out to a sphere if round.

    Raises:
        ValueError: an unknown name.

    Source: ours.
    """
    g = (1 + math.sqrt(5)) / 2
    corners = {
        "tetrahedron": [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)],
        "octahedron": [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)],
        "icosahedron": [
            p for a in (1, -1) for b in (g, -g) for p in ((0, a, b), (a, b, 0), (b, 0, a))
        ],
    }  # fmt: skip
    if name not in corners:
        raise ValueError(f"name: expected one of {', '.join(corners)}, got {name!r}")
    points = torch.tensor(corners[name], dtype=torch.float64)
    points = points / points[0].norm()
    faces = _hull_faces(points)
    triangles = points[faces]
    for _ in range(level):
        a, b, c = triangles.unbind(1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = torch.stack([torch.stack(q, 1) for q in quarters], 1).reshape(-1, 3, 3)
    vertices = triangles.reshape(-1, 3)
    if is_round:
        vertices = vertices / vertices.norm(dim=-1, keepdim=True)
    centre = triangles.mean(1)
    direction = centre / centre.norm(dim=-1, keepdim=True)
    longitude = torch.atan2(direction[:, 0], direction[:, 2]) / (2 * math.pi) + 0.5
    uv = torch.stack([longitude, direction[:, 1] / 2 + 0.5], -1)
    return Shape(vertices, torch.arange(len(vertices)).reshape(-1, 3), uv, True)


def prism(outline: Sequence[tuple[float, float]], half_depth: float) -> Shape:
    """Return a star-shaped outline (counter-clockwise, about the origin) pulled along z: stars, gears, plates.

    Source: ours.
    """
    ring = torch.tensor([*outline, outline[0]], dtype=torch.float64)
    last = len(outline)
    front = [(0.0, half_depth), (0.6, half_depth), (1.0, half_depth)]
    rows = front + [(r, -z) for r, z in reversed(front)]
    profile = torch.tensor(rows, dtype=torch.float64)

    def place(u: Tensor, v: Tensor) -> Tensor:
        row = profile[((1 - v) * (len(rows) - 1)).round().long()]
        at = ring[(u * last).round().long()] * row[:, :1]
        return torch.cat([at, row[:, 1:]], -1)

    return grid_shape(place, last, len(rows) - 1, is_closed=True)


def star(points: int = 5, inner: float = 0.5, half_depth: float = 0.15) -> Shape:
    """Return a star with that many points. Source: ours."""
    n = 2 * points
    radii = [1.0 if k % 2 == 0 else inner for k in range(n)]
    corners = [(r * math.cos(2 * math.pi * k / n), r * math.sin(2 * math.pi * k / n)) for k, r in enumerate(radii)]
    return prism(corners, half_depth)


def gear(teeth: int = 10, half_depth: float = 0.15) -> Shape:
    """Return a gear wheel. Source: ours."""
    outline = []
    for k in range(teeth):
        for share, radius in ((0.0, 0.78), (0.28, 0.78), (0.4, 1.0), (0.82, 1.0)):
            angle = 2 * math.pi * (k + share) / teeth
            outline.append((radius * math.cos(angle), radius * math.sin(angle)))
    return prism(outline, half_depth)


def fan(blades: int = 5, twist_rad: float = 0.5) -> Shape:
    """Return thin twisted blades about the z axis on a small hub: a propeller, seen from both sides. Source: ours."""
    parts = [revolve([(0.0, -0.12), (0.16, -0.12), (0.16, 0.12), (0.0, 0.12)], 10)]
    hub = parts[0].vertices[:, [2, 0, 1]]
    parts[0] = Shape(hub, parts[0].faces, parts[0].cell_uv, True)
    for k in range(blades):
        turn = 2 * math.pi * k / blades

        def place(u: Tensor, v: Tensor, turn: float = turn) -> Tensor:
            length, width = 0.1 + 0.9 * u, (v - 0.5) * (0.16 + 0.3 * u)
            tilt = twist_rad * (1.2 - u)
            across, out = width * torch.cos(tilt), width * torch.sin(tilt)
            x = length * math.cos(turn) - across * math.sin(turn)
            y = length * math.sin(turn) + across * math.cos(turn)
            return torch.stack([x, y, out], -1)

        parts.append(grid_shape(place, 8, 3))
    return join_shapes(parts)


def enclosed_volume(shape: Shape) -> float:
    """Return the signed volume [scene units³]: positive if a closed shape's faces look outward. Source: Gauss."""
    a, b, c = shape.vertices[shape.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c, dim=-1)).sum() / 6)


def _steps(n: int) -> Tensor:
    """Return n + 1 equal steps from exactly 0 to exactly 1."""
    return torch.arange(n + 1, dtype=torch.float64) / n


def _hull_faces(points: Tensor) -> Tensor:
    """Return the (F, 3) outward triangles of a few points on a sphere, all whose faces are equal triangles."""
    n, edge = len(points), float("inf")
    gaps = torch.cdist(points, points)
    edge = float(gaps[gaps > 1e-6].min())
    joined = (gaps - edge).abs() < 1e-6
    faces = []
    for i in range(n):
        for j in range(i + 1, n):
            for k in range(j + 1, n):
                if joined[i, j] and joined[j, k] and joined[i, k]:
                    inward = torch.dot(points[i], torch.linalg.cross(points[j], points[k], dim=-1)) < 0
                    faces.append((i, k, j) if inward else (i, j, k))
    return torch.tensor(faces)
