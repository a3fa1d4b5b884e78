"""Find intervals without looking at what opaque surfaces hide all the time, and at what rests only once.

Before: survey.py, intervals.py.  After: cells.py.
Symbols: P prisms; pixels of a block, one ray each; a cover is an opaque surface, or several that follow each other
without a gap, in front of a ray during the whole window; its nearness the least that it has.
What is left out is behind a cover at all times: it is seen at none, and its ends cut no cell in two that shows.
Source: ours.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchblur import bernstein, edges, packed
from torchblur.intervals import Intervals, find_intervals, join_intervals, nearness_coefficients, solve_pairs
from torchblur.pairs import Block, find_pairs
from torchblur.prisms import Prisms
from torchblur.sort import argsort_by
from torchblur.survey import Survey

CLEARLY = 1e-9  # of the nearness: by so much what is hidden lies behind; coplanar surfaces stay


def find_visible_intervals(
    prisms: Prisms, survey: Survey, block: Block, candidates: Tensor
) -> tuple[Intervals, dict[str, int]]:
    """Return the intervals of all rays of `block` that may be seen.

    Args:
        prisms: of the scene.
        survey: of the prisms.
        block: pixels and ray.
        candidates: (C,) int64 prisms whose bounds may touch the block.

    Returns:
        Intervals sorted by pixel, then prism, then time; and how many pairs were solved in time ("pairs"), looked at
        once ("still_pairs"), and left out as hidden ("hidden_pairs").

    Accuracy: the image is that of all intervals, up to the rounding of sums with other parts.
    Gradient: as for `find_intervals`; what is hidden has none.
    Source: ours.
    """
    is_still = survey.is_still[candidates]
    leads = survey.hides[candidates] & (survey.facing[candidates] > 0) & ~is_still
    cover = torch.zeros(block.n_pixels, dtype=torch.float64, device=candidates.device)
    counts = {"pairs": 0, "still_pairs": 0, "hidden_pairs": 0}
    found = []
    if is_still.any():
        still, cover, counts["still_pairs"] = _find_still(prisms, survey, block, candidates[is_still])
        found.append(still)
    for chosen in (candidates[leads], candidates[~leads & ~is_still]):
        if len(chosen) == 0:
            continue
        with torch.no_grad():
            prism, pixel = find_pairs(prisms, block, chosen)
            kept = survey.nearness[1, prism] >= (1 - CLEARLY) * cover[pixel]
            prism, pixel = prism[kept], pixel[kept]
        counts["pairs"] += len(prism)
        counts["hidden_pairs"] += len(kept) - len(prism)
        found.append(solve_pairs(prisms, block, prism, pixel))
        if leads.any():
            cover = torch.maximum(cover, _lasting_cover(prisms, survey, found[-1]))
    if not found:
        return find_intervals(prisms, block, candidates)[0], counts
    joined = join_intervals(prisms, found)
    return (_drop_hidden(joined, cover) if (cover > 0).any() else joined), counts


@torch.no_grad()
def _find_still(prisms: Prisms, survey: Survey, block: Block, candidates: Tensor) -> tuple[Intervals, Tensor, int]:
    """Return the intervals of prisms at rest, the nearness (pixels,) of the opaque ones, and the number of pairs.

    Bit for bit the decisions of `intervals.solve_pairs`, whose polynomials are constant here.
    """
    prism, pixel = find_pairs(prisms, block, candidates)
    n_pairs = len(prism)
    corners = edges.reduce_corners(prisms.clip, prism, block.ray_ndc(pixel))
    sign = edges.still_sign(corners)
    one_sided = prisms.surfaces.is_one_sided[prisms.face_of[prism]]
    kept = ((sign != 0) & ~(one_sided & (sign == -prisms.parity[prism]))).nonzero().flatten()
    prism, pixel, corners = prism[kept], pixel[kept], corners[kept]
    ends = torch.stack([torch.zeros_like(pixel), torch.ones_like(pixel)]).to(torch.float64)
    num, den = nearness_coefficients(prisms, prism, corners, ends)
    nearness = num[0] / torch.where(den[0] != 0, den[0], 1.0)
    hides = survey.hides[prism] & (den[0] != 0)
    cover = torch.zeros(block.n_pixels, dtype=torch.float64, device=prism.device)
    cover = cover.scatter_reduce(0, pixel[hides], nearness[hides], "amax")
    kept = (nearness >= (1 - CLEARLY) * cover[pixel]).nonzero().flatten()
    kept = kept[torch.sort(pixel[kept], stable=True).indices]
    prism, pixel = prism[kept], pixel[kept]
    still = Intervals(
        offsets=packed.offsets_from_owners(pixel, block.n_pixels),
        prism=prism,
        t_start=prisms.t_open[prism],
        t_end=prisms.t_close[prism],
        near_num=num[:, kept],
        near_den=den[:, kept],
        ray_ndc=block.ray_ndc(torch.arange(block.n_pixels, device=prism.device)),
        spacing_ndc=block.spacing_ndc,
    )
    return still, cover, n_pairs


@torch.no_grad()
def _lasting_cover(prisms: Prisms, survey: Survey, intervals: Intervals) -> Tensor:
    """Return (pixels,) the nearness of the opaque intervals that together last the whole window; 0 where they do not.

    In any order, intervals that each start before the latest end so far leave no gap.
    """
    start, end = prisms.window
    n_pixels = len(intervals.offsets) - 1
    low, _ = bernstein.ratio_range(intervals.near_num, intervals.near_den)
    pixel = packed.owners(intervals.offsets)
    usable = survey.hides[intervals.prism] & (low > 0)
    length = torch.where(usable, intervals.t_end - intervals.t_start, 0.0)
    total = length.new_zeros(n_pixels).index_add(0, pixel, length)
    usable = (usable & (total > (1 - CLEARLY) * (end - start))[pixel]).nonzero().flatten()
    usable = usable[argsort_by(pixel[usable], intervals.t_start[usable])]
    pixel, t_start, t_end, low = pixel[usable], intervals.t_start[usable], intervals.t_end[usable], low[usable]
    before = torch.full_like(t_end, start)  # the latest end of those before it in its pixel
    is_next = pixel[1:] == pixel[:-1]
    before[1:] = torch.where(is_next, t_end[:-1], start)
    step = 1
    while step < len(pixel):
        same = pixel[step:] == pixel[:-step]
        if not same.any():
            break
        before[step:] = torch.where(same, torch.maximum(before[step:], before[:-step]), before[step:])
        step *= 2
    is_open = torch.zeros(n_pixels, dtype=torch.bool, device=pixel.device)
    is_open[pixel[t_start > before]] = True
    last = torch.full_like(total, -torch.inf).scatter_reduce(0, pixel, t_end, "amax")
    least = torch.full_like(total, torch.inf).scatter_reduce(0, pixel, low, "amin")
    return torch.where(is_open | (last < end), 0.0, least)


def _drop_hidden(intervals: Intervals, cover: Tensor) -> Intervals:
    """Return the intervals that are not behind the `cover` (pixels,) of their pixel at all times."""
    pixel = packed.owners(intervals.offsets)
    _, high = bernstein.ratio_range(intervals.near_num, intervals.near_den)
    kept = high >= (1 - CLEARLY) * cover[pixel]
    if kept.all():
        return intervals
    kept = kept.nonzero().flatten()
    return replace(
        intervals,
        offsets=packed.offsets_from_owners(pixel[kept], len(cover)),
        prism=intervals.prism[kept],
        t_start=intervals.t_start[kept],
        t_end=intervals.t_end[kept],
        near_num=intervals.near_num[:, kept],
        near_den=intervals.near_den[:, kept],
    )
