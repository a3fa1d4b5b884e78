"""Ragged tensors: flat values sorted by owner, plus `offsets` (owners + 1), the one encoding used everywhere.

Before: nothing.  After: every stage that holds lists per pixel or per cell.
Symbols: O owners, N values; the values of owner o are values[offsets[o]:offsets[o + 1]].
Source: compressed sparse rows; the product follows Ronnow et al. 2021, alg. 1 (front-to-back OVER).
"""

from __future__ import annotations

import torch
from torch import Tensor


def offsets_from_counts(counts: Tensor) -> Tensor:
    """Return (O+1,) int64 offsets of owners that have `counts` (O,) values each. Source: ours."""
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, dim=0, out=offsets[1:])
    return offsets


def offsets_from_owners(owner_of: Tensor, n_owners: int) -> Tensor:
    """Return (O+1,) int64 offsets of values whose sorted owners are `owner_of` (N,). Source: ours."""
    return offsets_from_counts(torch.bincount(owner_of, minlength=n_owners))


def owners(offsets: Tensor) -> Tensor:
    """Return (N,) int64 the owner of each value. Source: ours."""
    counts = offsets.diff()
    return torch.repeat_interleave(torch.arange(len(counts), device=offsets.device), counts)


def expand(first: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the runs first[o], first[o]+1, … of length counts[o], end to end, and the owner of each element.

    Returns:
        (N,) int64 values and (N,) int64 owners, N = counts.sum(). Source: ours.
    """
    offsets = offsets_from_counts(counts)
    owner_of = owners(offsets)
    within = torch.arange(len(owner_of), device=first.device) - offsets[owner_of]
    return first[owner_of] + within, owner_of


def select(offsets: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices of the values of the `chosen` owners (C,), in that order, and their (C+1,) offsets."""
    counts = offsets.diff()[chosen]
    values, _ = expand(offsets[chosen], counts)
    return values, offsets_from_counts(counts)


def sum_by_owner(values: Tensor, offsets: Tensor) -> Tensor:
    """Return (O, ...) sums of `values` (N, ...) in order of storage: the same bits on every run. Source: ours."""
    if len(values) == 0:
        return values.new_zeros((len(offsets) - 1, *values.shape[1:]))
    return torch.segment_reduce(values, "sum", offsets=offsets, axis=0, initial=0.0)


def transmittance(alpha: Tensor, offsets: Tensor, cutoff: float = 0.0) -> tuple[Tensor, Tensor]:
    """Return what is left of the light before each value and behind the last one, exactly, value by value.

    A plain product in order, never exp(cumsum(log1p(-alpha))): that gives NaN behind an opaque value.

    Args:
        alpha: (N,) opacity, front to back within each owner.
        offsets: (O+1,).
        cutoff: stop where at most this much is left; values behind then get 0. Nothing is cut while `alpha` asks
            for gradients: what lies behind an opaque value decides the gradient of its opacity.

    Returns:
        (N,) product of (1 - alpha) before each value; (O,) the product over all values of the owner.
        With a cut-off, an owner that was stopped keeps what was left of it in the second: at most `cutoff`.

    Accuracy: exact for cutoff 0; else a pixel changes by at most cutoff times the largest colour behind.
    Cost: one pass per depth rank over the owners that are still open.
    """
    floor = -1.0 if alpha.requires_grad else cutoff
    n_owners = len(offsets) - 1
    counts = offsets.diff()
    open_owner = counts.nonzero().flatten()
    left = alpha.new_ones(len(open_owner))
    index_parts, before_parts, owner_parts, after_parts = [], [], [], []
    rank = 0
    while len(open_owner):
        index = offsets[open_owner] + rank
        index_parts.append(index)
        before_parts.append(left)
        left = left * (1 - alpha[index])
        rank += 1
        going = (counts[open_owner] > rank) & (left.detach() > floor)
        ended = ~going
        owner_parts.append(open_owner[ended])
        after_parts.append(left[ended])
        open_owner, left = open_owner[going], left[going]
    before = alpha.new_zeros(len(alpha))
    after = alpha.new_ones(n_owners)
    if index_parts:
        before = before.index_put((torch.cat(index_parts),), torch.cat(before_parts))
        after = after.index_put((torch.cat(owner_parts),), torch.cat(after_parts))
    return before, after
