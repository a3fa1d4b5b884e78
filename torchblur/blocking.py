"""When a moving triangle is between a moving light and a moving point: the exact times, as roots of polynomials.

Before: casters.py, lights.py.  After: shadows.py.
Symbols: K receivers, points X = P / S over a slice of time; n pairs of a receiver and a caster with corners C_i; L the
place of a light or d the way that it travels; sigma = +1 or -1. All are polynomials on the time that both share:
  at a place L:   n_ij = (C_i - L) x (C_j - L), e_ij = n_ij S (X - L), D = n_12 (C_0 - L): the ray from L to X meets the
                  plane of the triangle at S D / E of its length, where E = e_01 + e_12 + e_20, and lies inside if all
                  e_ij have one sign sigma; it is blocked if D and (1 - bias) E - S D have that sign too;
  directional:    n_ij = d x (C_j - C_i), e_ij = n_ij P + S d (C_i x C_j), N = (C_1 - C_0) x (C_2 - C_0): blocked if
                  N (P - S C_0) - bias S N d has the sign of the e_ij.
Two faces that share an edge see e_ij of opposite signs, bit for bit, so that no light leaks between them; where e_ij is
0, X counts as moved by (eps, eps^2, eps^3).
Source: the irregular z-buffer (Aila & Laine 2004; Johnson et al. 2005), which looks at casters from the points that are
seen; its extension to time and the polynomials: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import bernstein
from torchblur.casters import Casters
from torchblur.lights import DirectionalLight, Light, along
from torchblur.sort import between

EDGES = ((0, 1), (1, 2), (2, 0))
NOISE = 1e-14  # of the product of the factors' sizes
HALVINGS = 4  # of the shared time, before roots are sought: cheaper, as most pairs prove not to block


@dataclass(frozen=True)
class Receivers:
    """Points that light falls on, over slices of time, or at instants: then all polynomials have degree 0."""

    place: Tensor  # (4 or 1, 3, K) float64 coefficients of P = S X
    scale: Tensor  # (3 or 1, K) of S, which is above 0
    t: Tensor  # (2, K) shutter times of both ends, equal for instants
    face: Tensor  # (K,) int64 face on which the point lies, which does not block it
    rests: Tensor  # (K,) bool: stays where it is; what does may still count as moving

    @property
    def count(self) -> int:
        """Number of receivers."""
        return len(self.face)

    @property
    def are_instants(self) -> bool:
        """Whether the receivers are points at instants."""
        return len(self.scale) == 1

    def choose(self, chosen: Tensor) -> Receivers:
        """Return the receivers `chosen` (J,)."""
        return Receivers(*(getattr(self, name)[..., chosen] for name in ("place", "scale", "t", "face", "rests")))


@dataclass(frozen=True)
class _Pairs:
    """The polynomials of n pairs over the times that they share."""

    normals: Tensor  # (3 or 1, 3 edges, 3, n) coefficients of n_ij
    signs: Tensor  # (6 or 1, 4 or 5, n) of what must have one sign: the three e_ij, then one or two others
    noise: Tensor  # (4 or 5, n)


@dataclass(frozen=True)
class _Slices:
    """Slices of the times of m pairs."""

    pair: Tensor  # (m,) int64
    start: Tensor  # (m,) float64 share of the pair's time
    end: Tensor  # (m,)
    signs: Tensor  # (6 or 1, 4 or 5, m) coefficients on the slice
    noise: Tensor  # (4 or 5, m)

    def choose(self, chosen: Tensor) -> _Slices:
        """Return the slices `chosen` (J,)."""
        return _Slices(*(getattr(self, name)[..., chosen] for name in ("pair", "start", "end", "signs", "noise")))

    def halved(self) -> _Slices:
        """Return the first halves, then the second."""
        middle = 0.5 * (self.start + self.end)
        parts = bernstein.split(self.signs, torch.full_like(middle, 0.5))
        ends = torch.cat([self.start, middle]), torch.cat([middle, self.end])
        return _Slices(self.pair.repeat(2), *ends, torch.cat(parts, dim=-1), self.noise.repeat(1, 2))


def when_blocked(
    light: Light, receivers: Receivers, casters: Casters, pairs: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return which pairs (R,) are blocked, and from when to when, as shares (R,) of the receiver's slice; an instant is
    blocked from 0 to 1.

    Args:
        light: that shines.
        receivers: K points.
        casters: of the scene.
        pairs: receiver and caster (n,) that share some time.

    Source: ours.
    """
    shared, share = _shared_time(receivers, casters, pairs)
    found = _polynomials(light, shared, _corners(casters, pairs[1], shared), casters.gap)
    zero = torch.zeros_like(share[0])
    every = torch.arange(len(zero), device=zero.device)
    slices, parts = _Slices(every, zero, zero + 1, found.signs, found.noise), []
    for k in range(1 if receivers.are_instants else HALVINGS + 1):
        slices = slices.halved() if k else slices
        may, must = _outline(slices)
        blocked = must.nonzero().flatten()
        parts.append((slices.pair[blocked], slices.start[blocked], slices.end[blocked]))
        slices = slices.choose((may & ~must).nonzero().flatten())
    parts.append(_pieces(slices, found.normals))
    which, start, end = (torch.cat(p) for p in zip(*parts, strict=True))
    low, high = share[:, which]
    return which, low + start * (high - low), torch.where(end == 1, high, low + end * (high - low))


def _shared_time(receivers: Receivers, casters: Casters, pairs: tuple[Tensor, Tensor]) -> tuple[Receivers, Tensor]:
    """Return the pairs' receivers on the time that they share with their casters, and that time (2, n) as a share."""
    receiver, caster = pairs
    chosen = receivers.choose(receiver)
    if receivers.are_instants:
        return chosen, torch.tensor([[0.0], [1.0]], dtype=torch.float64, device=receiver.device).expand(2, len(caster))
    open_, close = chosen.t
    start, end = torch.maximum(open_, casters.t_open[caster]), torch.minimum(close, casters.t_close[caster])
    share = torch.stack([(start - open_), (end - open_)]) / (close - open_)
    share[1, end == close] = 1.0
    part = ((share[0] > 0) | (share[1] < 1)).nonzero().flatten()
    place, scale = chosen.place, chosen.scale
    if len(part):
        place[..., part] = bernstein.restrict(place[..., part], *share[:, part])
        scale[..., part] = bernstein.restrict(scale[..., part], *share[:, part])
    return Receivers(place, scale, torch.stack([start, end]), chosen.face, chosen.rests), share


def _corners(casters: Casters, caster: Tensor, shared: Receivers) -> Tensor:
    """Return (2 or 1, 3, 3, n) coefficients of the corners of `caster` (n,) over the shared time."""
    length = (casters.t_close - casters.t_open)[caster]
    times = shared.t[:1] if shared.are_instants else shared.t
    u = (times - casters.t_open[caster]) / length
    first, last = casters.world[..., caster]
    return torch.stack([(1 - at) * first + at * last for at in u])


def _polynomials(light: Light, shared: Receivers, corners: Tensor, gap: float) -> _Pairs:
    """Return the polynomials of pairs whose corners are `corners` (2 or 1, 3, 3, n), see above."""
    ends = shared.t[: len(corners)]
    point = shared.place.mean(0).abs().amax(0) / shared.scale.mean(0)
    away = gap * torch.maximum(corners.abs().amax((0, 1, 2)), point)  # (n,) what a caster must be away at least
    if isinstance(light, DirectionalLight):
        return _along_direction(torch.stack([along(light.direction, t) for t in ends]), shared, corners, away)
    return _from_position(torch.stack([along(light.position, t) for t in ends]), shared, corners, away)


def _from_position(position: Tensor, shared: Receivers, corners: Tensor, away: Tensor) -> _Pairs:
    """Return the polynomials of a light at `position` (2 or 1, 3, n)."""
    scale = shared.scale
    relative = corners - position.unsqueeze(1)
    normals = torch.stack([_cross(relative[:, i], relative[:, j]) for i, j in EDGES], dim=1)
    vector = shared.place - bernstein.product(scale.unsqueeze(1), position)
    edges = bernstein.product(normals, vector.unsqueeze(1)).sum(2)
    volume = bernstein.product(normals[:, 1], relative[:, 0]).sum(1)
    distance = vector.mean(0).norm(dim=0) / scale.mean(0)
    bias = (away / distance).clamp(max=1.0)  # infinite at the light
    nearer = (1 - bias) * edges.sum(1) - bernstein.product(scale, volume)
    size = relative.abs().amax((0, 2))
    reach = shared.place.abs().amax((0, 1)) + scale.amax(0) * position.abs().amax((0, 1))
    edge_noise = NOISE * reach * torch.stack([size[i] * size[j] for i, j in EDGES])
    volume_noise = NOISE * size.prod(0)
    even = torch.ones(len(edges) - len(volume) + 1, 1, dtype=volume.dtype, device=volume.device)
    sides = torch.stack([bernstein.product(volume, even), nearer], dim=1)
    side_noise = torch.stack([volume_noise, edge_noise.sum(0) + scale.amax(0) * volume_noise])
    return _Pairs(normals, torch.cat([edges, sides], dim=1), torch.cat([edge_noise, side_noise]))


def _along_direction(direction: Tensor, shared: Receivers, corners: Tensor, away: Tensor) -> _Pairs:
    """Return the polynomials of a light that travels along `direction` (2 or 1, 3, n)."""
    place, scale = shared.place, shared.scale
    normals = torch.stack([_cross(direction, corners[:, j] - corners[:, i]) for i, j in EDGES], dim=1)
    moments = torch.stack([_cross(corners[:, i], corners[:, j]) for i, j in EDGES], dim=1)
    constant = bernstein.product(moments, direction.unsqueeze(1)).sum(2)
    edges = bernstein.product(normals, place.unsqueeze(1)).sum(2) + bernstein.product(constant, scale.unsqueeze(1))
    first = corners[:, 0]
    area = _cross(corners[:, 1] - first, corners[:, 2] - first)
    height = place - bernstein.product(scale.unsqueeze(1), first)
    drop = bernstein.product(bernstein.product(area, direction).sum(1), scale)
    length = direction.mean(0).norm(dim=0)
    bias = away / torch.where(length > 0, length, 1.0)
    side = bernstein.product(area, height).sum(1) - bias * drop
    size, speed = corners.abs().amax((0, 2)), direction.abs().amax((0, 1))
    reach = place.abs().amax((0, 1))
    pairs = [speed * (reach * (size[i] + size[j]) + scale.amax(0) * size[i] * size[j]) for i, j in EDGES]
    span = (corners - first.unsqueeze(1)).abs().amax((0, 1, 2))
    side_noise = NOISE * span.square() * (reach + scale.amax(0) * size[0])
    noise = torch.cat([NOISE * torch.stack(pairs), side_noise.unsqueeze(0)])
    return _Pairs(normals, torch.cat([edges, side.unsqueeze(1)], dim=1), noise)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return coefficients of the cross product of vectors (d + 1, 3, n); swapped, to the bit its negative."""
    x, y, z = ((1, 2), (2, 0), (0, 1))
    rows = [bernstein.product(a[:, i], b[:, j]) - bernstein.product(a[:, j], b[:, i]) for i, j in (x, y, z)]
    return torch.stack(rows, dim=1)


def _outline(slices: _Slices) -> tuple[Tensor, Tensor]:
    """Return which slices (m,) may be blocked at some time, and which are at all times, by signs of coefficients."""
    low, high, noise = slices.signs.amin(0), slices.signs.amax(0), slices.noise
    room = noise.clone()
    room[:3] *= -1  # an edge that is 0 may count as either sign
    may = (high >= room).all(0) | (low <= -room).all(0)
    must = (low > noise).all(0) | (high < -noise).all(0)
    return may, must


def _pieces(slices: _Slices, normals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return pair, start and end (R,), as shares of the pair's time, of the pieces of slices in which it is blocked."""
    m = len(slices.pair)
    every = torch.arange(m, device=slices.pair.device)
    owner, u = bernstein.roots(slices.signs.flatten(1), slices.noise.flatten())
    zero = torch.zeros_like(slices.start)
    owner, start, end = between(torch.cat([every, every, owner % m]), torch.cat([zero, zero + 1, u]))
    of = slices.choose(owner)
    value = bernstein.value(of.signs, 0.5 * (start + end))
    sign = value.sign() * (value.abs() > of.noise)
    length = of.end - of.start
    start, end = of.start + start * length, torch.where(end == 1, of.end, of.start + end * length)
    is_zero = (sign[:3] == 0).any(0).nonzero().flatten()
    if len(is_zero):
        middle = (0.5 * (start + end))[is_zero]
        slopes = bernstein.value(normals[..., of.pair[is_zero]], middle).sign()  # (3 edges, 3, n)
        edges = sign[:3, is_zero]
        for k in range(3):
            edges = torch.where(edges == 0, slopes[:, k], edges)
        sign[:3, is_zero] = edges
    blocked = (sign.sum(0).abs() == len(sign)).nonzero().flatten()
    return of.pair[blocked], start[blocked], end[blocked]
