"""Stable lexicographic sorts of values that belong to owners.

Before: packed.py.  After: intervals.py (by pixel), cells.py (by time, by depth).
Source: ours; `torch.sort` is stable only when asked.
"""

from __future__ import annotations

import torch
from torch import Tensor

SAME_TIME = 1e-12  # of the owner's time
TIE = 1e-11  # relative: nearness of surfaces that count as coplanar (float64 rounding, with room for thin triangles)


def argsort_by(*keys: Tensor) -> Tensor:
    """Return the stable order by the first key, then the second, and so on (N,) int64; all ascending. Source: ours."""
    order = None
    for key in reversed(keys):
        if order is None:
            order = torch.sort(key, stable=True).indices
        else:
            order = order[torch.sort(key[order], stable=True).indices]
    return order


def argsort_descending_in(owner_of: Tensor, value: Tensor) -> Tensor:
    """Return the order by owner, then by falling `value` (N,) int64, which must be positive.

    One sort of a joined key, whose rounding may put close values the wrong way round; owners in which that happened
    are sorted again by the values themselves. Source: ours.
    """
    largest = torch.where(torch.isfinite(value), value, 0.0).max() if len(value) else value.sum()
    share = (value / largest.clamp(min=torch.finfo(value.dtype).tiny)).clamp(max=1.0)
    order = torch.sort(owner_of + 0.75 * (1 - share), stable=True).indices
    owner, sorted_value = owner_of[order], value[order]
    wrong = (owner[1:] == owner[:-1]) & (sorted_value[1:] > sorted_value[:-1])
    if wrong.any():
        again = torch.isin(owner, owner[1:][wrong]).nonzero().flatten()
        order[again] = order[again][argsort_by(owner[again], -sorted_value[again])]
    return order


def inverse(order: Tensor) -> Tensor:
    """Return where each value went, so that `inverse(order)[order]` counts up. Source: ours."""
    place = torch.zeros_like(order)
    place[order] = torch.arange(len(order), device=order.device)
    return place


def is_tied(owner_of: Tensor, value: Tensor) -> Tensor:
    """Return (N,) bool, whether a value all but equals the one before it of the same owner. Source: ours."""
    tied = torch.zeros_like(owner_of, dtype=torch.bool)
    tied[1:] = (owner_of.diff() == 0) & (value.diff().abs() <= TIE * value[1:].abs())
    return tied


def reorder_ties(order: Tensor, tied_to_previous: Tensor, rank: Tensor) -> Tensor:
    """Return `order` with each run of tied neighbours put in ascending order of `rank`.

    Args:
        order: (N,) int64 values in their present order.
        tied_to_previous: (N,) bool by place: tied to the value before it.
        rank: (N,) int64 by value.

    Returns:
        (N,) int64. Source: ours.
    """
    if not tied_to_previous.any():
        return order
    group = torch.cumsum((~tied_to_previous).long(), dim=0)
    return order[argsort_by(group, rank[order])]


def between(owner: Tensor, tau: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the owner, start and end of the slices between the times `tau` (n,) of each `owner` (n,). Ours."""
    order = argsort_by(owner, tau)
    owner, tau = owner[order], tau[order]
    real = ((owner[1:] == owner[:-1]) & (tau[1:] - tau[:-1] > SAME_TIME)).nonzero().flatten()
    return owner[real], tau[real], tau[real + 1]
