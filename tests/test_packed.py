"""Ragged tensors and stable sorts, against plain loops."""

import pytest
import torch

from torchblur import packed
from torchblur.sort import argsort_by, argsort_descending_in, inverse, is_tied, reorder_ties

COUNTS = [[], [0], [3], [0, 2, 0, 0, 5, 1, 0], [1] * 7]


@pytest.mark.parametrize("counts", COUNTS)
def test_offsets_owners_and_expand_agree_with_loops(counts):
    offsets = packed.offsets_from_counts(torch.tensor(counts, dtype=torch.int64))
    assert offsets.tolist() == [sum(counts[:k]) for k in range(len(counts) + 1)]
    expected = [o for o, c in enumerate(counts) for _ in range(c)]
    assert packed.owners(offsets).tolist() == expected
    assert (
        packed.offsets_from_owners(torch.tensor(expected, dtype=torch.int64), len(counts)).tolist() == offsets.tolist()
    )
    first = torch.arange(len(counts)) * 10
    values, owner = packed.expand(first, torch.tensor(counts, dtype=torch.int64))
    assert values.tolist() == [10 * o + k for o, c in enumerate(counts) for k in range(c)]
    assert owner.tolist() == expected


def test_select_takes_owners_in_the_order_asked_for():
    offsets = torch.tensor([0, 2, 2, 5, 6])
    values, chosen = packed.select(offsets, torch.tensor([2, 1, 0]))
    assert values.tolist() == [2, 3, 4, 0, 1]
    assert chosen.tolist() == [0, 3, 3, 5]


@pytest.mark.parametrize("counts", COUNTS)
def test_sum_by_owner_is_the_loop(counts, generator):
    offsets = packed.offsets_from_counts(torch.tensor(counts, dtype=torch.int64))
    values = torch.rand(int(offsets[-1]), 3, dtype=torch.float64, generator=generator)
    sums = packed.sum_by_owner(values, offsets)
    assert sums.shape == (len(counts), 3)
    for o in range(len(counts)):
        expected = values[offsets[o] : offsets[o + 1]].sum(0)
        torch.testing.assert_close(sums[o], expected, rtol=0, atol=1e-15)


def loop_transmittance(alpha, offsets, cutoff):
    before, after = [0.0] * len(alpha), []
    for o in range(len(offsets) - 1):
        left = 1.0
        for k in range(offsets[o], offsets[o + 1]):
            if k > offsets[o] and left <= cutoff:
                break
            before[k] = left
            left *= 1 - alpha[k]
        after.append(left)
    return before, after


@pytest.mark.parametrize("cutoff", [0.0, 0.1])
def test_transmittance_is_the_loop_with_opaque_and_clear_values(cutoff, generator):
    offsets = packed.offsets_from_counts(torch.tensor([4, 0, 1, 30, 2]))
    alpha = torch.rand(37, dtype=torch.float64, generator=generator)
    alpha[1], alpha[10], alpha[20] = 1.0, 0.0, 1.0
    before, after = packed.transmittance(alpha, offsets, cutoff)
    expected = loop_transmittance(alpha.tolist(), offsets.tolist(), cutoff)
    assert before.tolist() == expected[0]
    assert after.tolist() == expected[1]
    assert torch.isfinite(before).all()


def test_transmittance_has_the_gradient_of_what_lies_behind_an_opaque_value():
    offsets = torch.tensor([0, 3])
    light = torch.tensor([0.3, 0.7, 0.2], dtype=torch.float64)

    def seen(alpha):
        before, after = packed.transmittance(alpha, offsets)
        return (before * alpha * light).sum() + 0.9 * after.sum()

    alpha = torch.tensor([1.0, 0.5, 0.25], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(seen, (alpha,))
    (gradient,) = torch.autograd.grad(seen(alpha), alpha)
    behind = 0.5 * 0.7 + 0.5 * (0.25 * 0.2 + 0.75 * 0.9)
    assert float(gradient[0]) == pytest.approx(0.3 - behind, abs=1e-15)


def test_argsort_is_lexicographic_and_stable():
    a = torch.tensor([1, 0, 1, 0, 1])
    b = torch.tensor([2.0, 5.0, 1.0, 5.0, 2.0])
    order = argsort_by(a, b)
    assert order.tolist() == [1, 3, 2, 0, 4]
    assert inverse(order)[order].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("spread", [1.0, 1e-9, 1e-14])
def test_falling_values_within_owners_are_sorted_exactly_however_close(spread, generator):
    owner = torch.randint(0, 400, (5000,), generator=generator) + 3_000_000  # a joined key keeps 31 bits of the value
    value = 1.0 + spread * torch.rand(5000, dtype=torch.float64, generator=generator)
    value[::50] = torch.inf
    value[1::50] = 1e-12
    order = argsort_descending_in(owner, value)
    assert sorted(order.tolist()) == list(range(5000))
    pairs = list(zip(owner[order].tolist(), (-value[order]).tolist(), strict=True))
    assert pairs == sorted(pairs)


def test_ties_chain_and_are_reordered_by_rank():
    owner = torch.tensor([0, 0, 0, 1, 1])
    value = torch.tensor([1.0, 1.0 + 5e-12, 1.0 + 1e-11, 1.0 + 1e-11, 2.0], dtype=torch.float64)
    tied = is_tied(owner, value)
    assert tied.tolist() == [False, True, True, False, False]
    order = reorder_ties(torch.arange(5), tied, torch.tensor([2, 0, 1, 9, 3]))
    assert order.tolist() == [1, 2, 0, 3, 4]
