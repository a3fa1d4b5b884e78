"""What prisms can do at most: cheap conservative bounds by which effects are left out.

Before: prisms.py, cpu/bounds.py.  After: hidden.py, effects.py.
Symbols: P prisms; D(t) = det(p_0, p_1, p_2) of their clip-space corners without z, a cubic whose sign is the facing.
Nearness as in intervals.py: larger in front, between those of the six corners while all w are above 0.
Source: signs of Bernstein coefficients; bounds by corners: the hit point is a mean of them. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchblur import bernstein, packed
from torchblur.cpu import bounds
from torchblur.prisms import Prisms

NOISE = 1e-13  # of the product of the corners' sizes: smaller D may be rounding
GRIDS = (32, 16, 8, 4, 2, 1)  # tiles along a side
TOUCHING = 1e-12  # of the nearness: smaller overlaps are rounding, as in cells.py
MANY = 1 << 10  # prisms; fewer are not worth loading compiled code
MAX_PLACES = 8  # a prism and slice of time on average, else the grid is coarser


@dataclass(frozen=True)
class Survey:
    """Bounds of the prisms of a scene; what is not certain counts as it costs more."""

    is_still: Tensor  # (P,) bool: rests on screen all through the window
    hides: Tensor  # (P,) bool: opaque at all times, so that nothing behind it is seen
    facing: Tensor  # (P,) int8: +1 shows its front at all times, -1 its back; 0 may turn, or reaches behind the eye
    nearness: Tensor  # (2, P) least and greatest; -inf and inf where w may be 0
    may_cross: bool  # whether the order in depth of two prisms may change in time

    def choose(self, chosen: Tensor) -> Survey:
        """Return the bounds of the prisms `chosen` (C,)."""
        parts = {name: getattr(self, name)[..., chosen] for name in ("is_still", "hides", "facing", "nearness")}
        return replace(self, **parts)


@torch.no_grad()
def survey_prisms(prisms: Prisms, size_px: tuple[int, int]) -> Survey:
    """Return the bounds of all prisms on an image of width and height `size_px`. Source: ours."""
    start, end = prisms.window
    whole = (prisms.t_open == start) & (prisms.t_close == end)
    rests, facing, nearness = _bounds(prisms)
    is_still = rests & whole & ~prisms.is_clipped
    return Survey(
        is_still=is_still,
        hides=prisms.surfaces.is_opaque[prisms.face_of],
        facing=facing,
        nearness=nearness,
        may_cross=_may_cross(prisms, (nearness, ~is_still, shows_back(prisms, facing)), size_px),
    )


def _is_compiled(prisms: Prisms) -> bool:
    """Return whether prisms are looked at one by one, by compiled code."""
    return prisms.count >= MANY and prisms.clip.device.type == "cpu"


def _bounds(prisms: Prisms) -> tuple[Tensor, Tensor, Tensor]:
    """Return whether prisms do not move on screen (P,), their facing (P,) and nearness (2, P)."""
    if _is_compiled(prisms):
        flags = prisms.parity.detach().numpy(), prisms.is_clipped.numpy()
        found = bounds.bound(prisms.clip.detach().numpy(), flags, prisms.orders_by_w, NOISE)
        return tuple(torch.from_numpy(part) for part in found)
    rests = (prisms.clip[0] == prisms.clip[1]).all(0).all(0)
    return rests, _facing(prisms), _nearness_range(prisms)


def shows_back(prisms: Prisms, facing: Tensor) -> Tensor:
    """Return (P,) whether a one-sided prism shows only its back, by its `facing`: nothing of it is seen. Ours."""
    return prisms.surfaces.is_one_sided[prisms.face_of] & (facing < 0)


def _nearness_range(prisms: Prisms) -> Tensor:
    """Return (2, P) the least and greatest nearness of the corners."""
    z, w = prisms.clip[:, :, 2].flatten(0, 1), prisms.clip[:, :, 3].flatten(0, 1)
    is_proper = (w > 0).all(0) & ~prisms.is_clipped
    safe = torch.where(w > 0, w, 1.0)
    nearness = 1 / safe if prisms.orders_by_w else 2 - z / safe
    low = torch.where(is_proper, nearness.amin(0), -torch.inf)
    return torch.stack([low, torch.where(is_proper, nearness.amax(0), torch.inf)])


def _facing(prisms: Prisms) -> Tensor:
    """Return (P,) int8 the side that is seen: D keeps its sign where its Bernstein coefficients have one."""
    a, b = prisms.clip[:, :, [0, 1, 3]]  # (3 corners, x y w, P)
    rows = torch.zeros_like(a[0, 0].expand(4, -1))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):  # the blossom: each corner from either end
        across = torch.linalg.cross((a, b)[i][1], (a, b)[j][2], dim=0)
        for end, corner in enumerate((a[0], b[0])):
            k = i + j + end
            rows[k] += (corner * across).sum(0) / (1, 3, 3, 1)[k]
    size = torch.maximum(bernstein.length(a, 1), bernstein.length(b, 1)).prod(0)
    rows = rows * prisms.parity
    sure = (rows > NOISE * size).all(0).to(torch.int8) - (rows < -NOISE * size).all(0).to(torch.int8)
    return torch.where(prisms.is_clipped, 0, sure)


def _may_cross(prisms: Prisms, known: tuple[Tensor, Tensor, Tensor], size_px: tuple[int, int]) -> bool:
    """Return whether the nearness of two prisms overlaps in a tile of the screen and slice of time in which one moves.

    Ranges that only touch keep their order: those of faces in one plane at rest in depth, or one in front of another.
    `known` are the nearness (2, P), whether each moves (P,), and whether each is left out (P,).
    """
    nearness, moves, is_out = known
    if prisms.count < 2 or not moves.any():
        return False
    knots, slices = _slices(prisms)
    if _is_compiled(prisms):
        seen = (part.detach().numpy() for part in (prisms.bounds_px, *known))
        rules = GRIDS, MAX_PLACES, TOUCHING
        return bounds.may_cross(tuple(seen), (*(s.numpy() for s in slices), len(knots) - 1), size_px, rules)
    chosen = (~is_out).nonzero().flatten()
    prisms, nearness, moves = prisms.choose(chosen), nearness[:, chosen], moves[chosen]
    if prisms.count < 2 or not moves.any():
        return False
    slices = [part[chosen] for part in slices]
    n_slices = slices[1] - slices[0]
    size = torch.tensor(size_px, dtype=torch.float64, device=nearness.device).unsqueeze(1)
    low, high = (torch.minimum(b.clamp(min=0), size) / size for b in (prisms.bounds_px[:2], prisms.bounds_px[2:]))
    for n in GRIDS:
        first, last = ((b * n).floor().clamp(max=n - 1).long() for b in (low, high))
        spans = last - first + 1
        places = spans.prod(0) * n_slices
        if int(places.sum()) <= MAX_PLACES * int(n_slices.sum()):
            break
    index, of = packed.expand(torch.zeros_like(places), places)
    column = first[0, of] + index % spans[0, of]
    row = first[1, of] + index // spans[0, of] % spans[1, of]
    time = slices[0][of] + index // (spans[0] * spans[1])[of]
    place = (time * n + row) * n + column
    is_lively = torch.zeros((len(knots) - 1) * n * n, dtype=torch.bool, device=place.device)
    is_lively[place[moves[of]]] = True
    lively = is_lively[place].nonzero().flatten()
    place, of = place[lively], of[lively]
    # most scenes that may cross show it by any one prism of each place, which saves the sorts
    one = torch.zeros_like(is_lively, dtype=torch.int64).index_put_((place,), of)[place]
    (least, greatest), (other_least, other_greatest) = nearness[:, of], nearness[:, one]
    reach = torch.where(least <= other_least, greatest, other_greatest)
    if bool(((one != of) & (torch.maximum(least, other_least) * (1 + TOUCHING) < reach)).any()):
        return True
    order = torch.sort(nearness[0, of], stable=True).indices
    order = order[torch.sort(place[order], stable=True).indices]
    place, (least, greatest) = place[order], nearness[:, of[order]]
    # sorted by their least, two overlap somewhere just if two neighbours do
    return bool(((place[1:] == place[:-1]) & (least[1:] * (1 + TOUCHING) < greatest[:-1])).any())


def _slices(prisms: Prisms) -> tuple[Tensor, list[Tensor]]:
    """Return the times (n + 1,) between which no prism begins or ends, and the first slice of each (P,) and the first
    after it (P,).
    """
    start, end = prisms.window
    if bool((prisms.t_open == start).all()) and bool((prisms.t_close == end).all()):
        first = torch.zeros_like(prisms.face_of)
        return torch.tensor([start, end]), [first, first + 1]
    knots = torch.unique(torch.cat([prisms.t_open, prisms.t_close]))
    return knots, [torch.searchsorted(knots, t) for t in (prisms.t_open, prisms.t_close)]
