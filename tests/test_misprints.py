"""The misprints of Ronnow et al. 2022, alg. 1, numbered as in `Accuracy.adaptive`.

Each test writes down the printed rule, shows that it fails, and that ours does not.
"""

import math
from dataclasses import replace

import pytest
import torch
from test_subdivide import LINEAR, chord_errors, spinning_quad

import torchblur as tb
from torchblur import bernstein
from torchblur.subdivide import _Curves, _cut, approximate, chord_error_bound, sampled_extrema

FLOAT64 = torch.float64
GRID = torch.linspace(0, 1, 65, dtype=FLOAT64)


def cubic(*power, t=(0.0, 1.0)):
    """Bernstein coefficients (4, 1) on the slice `t` of the cubic with these coefficients, constant first."""
    power = [*power, 0.0, 0.0, 0.0][:4]
    rows = [sum(math.comb(k, i) / math.comb(3, i) * power[i] for i in range(k + 1)) for k in range(4)]
    ends = (torch.tensor([x], dtype=FLOAT64) for x in t)
    return bernstein.restrict(torch.tensor(rows, dtype=FLOAT64).reshape(4, 1), *ends)


def turns(num, t=(0.0, 1.0), den=None):
    """Times at which our sampling sees the ratio turn over the slice `t`."""
    which, u = sampled_extrema(num, torch.ones_like(num) if den is None else den, torch.tensor([t[1] - t[0]]).double())
    assert (which == 0).all()
    return [t[0] + x * (t[1] - t[0]) for x in u.tolist()]


def cut_curve(num, tolerance, length=1.0):
    """Our pieces of the polynomial (4, 1) over an untextured interval: sorted ends (2, m), values there (2, m)."""
    one = torch.ones(3, 1, 1, dtype=FLOAT64)
    curves = _Curves(num, torch.ones_like(num), one, one[:, :0])
    pieces = _cut(curves, torch.tensor([length], dtype=FLOAT64), tolerance, 1e-9)
    order = pieces.u[0].argsort()
    return pieces.u[:, order], pieces.nearness[:, order]


def curve_errors(num, u, values):
    """The greatest distance of a polynomial (4, 1) from each chord."""
    place = u[0] + GRID[:, None] * (u[1] - u[0])
    true = bernstein.value(num, place.flatten()).reshape(place.shape)
    return (true - (values[0] + GRID[:, None] * (values[1] - values[0]))).abs().amax(0)


def printed_loop(depth, ts, te, eps):
    """The printed search for extrema, as it stands: (time, depth) of all places kept."""
    n = 20.0 * (te - ts)
    dt = (te - ts) * (1.0 / n)
    t = ts + dt
    kept = [(ts, depth(ts))]
    before, here = depth(ts), depth(te) if n < 2 else depth(t)
    k = 0
    while k < n:
        t = t + dt
        after = depth(te) if k == int(n - 1) else depth(t + dt)
        if abs(before - after) > eps:
            if (here - before) * (after - here) < 0:
                kept.append((t, here))
            before, here = here, after
        k += 1
    return [*kept, (te, depth(te))]


def test_misprint_1_an_extremum_is_filed_at_its_own_sample():
    """Smallest at 0.06: of the samples 0, 0.05, 0.1 it is the second; printed, its depth is filed at 0.1."""
    assert turns(cubic(0.0036, -0.12, 1.0)) == pytest.approx([0.05], abs=1e-12)
    _, (time, depth), _ = printed_loop(lambda t: (t - 0.06) ** 2, 0.0, 1.0, 1e-6)
    assert time == pytest.approx(0.1)
    assert depth == pytest.approx(0.01**2)


def test_misprint_2_nothing_is_looked_at_beyond_the_end():
    slice_ = (0.1, 0.437)
    assert turns(cubic(0.0, 1.0, t=slice_), slice_) == []
    times = [t for t, _ in printed_loop(lambda t: t, *slice_, 1e-6)]
    assert times == pytest.approx([0.1, 0.45, 0.5, 0.437])


def test_misprint_3_the_number_of_steps_is_whole_and_never_zero():
    """In 0.06 of time there are 1.2 steps as printed, in 0.04 there are 0.8, and no inner sample."""
    for end in (0.06, 0.04):
        slice_, turn = (0.0, end), 0.4 * end
        assert turns(cubic(turn**2, -2 * turn, 1.0, t=slice_), slice_) == pytest.approx([end / 2], abs=1e-12)
        assert len(printed_loop(lambda t, turn=turn: (t - turn) ** 2, *slice_, 1e-9)) == 2
    assert turns(cubic(1.0, 0, 0, t=(0.5, 0.5)), (0.5, 0.5)) == []
    with pytest.raises(ZeroDivisionError):
        printed_loop(lambda t: t, 0.5, 0.5, 1e-6)


def test_misprint_4_depths_and_times_stay_in_step():
    """Turns at 0.3 and 0.72: the samples around 0.3 are equal to within eps, and from there on all is filed late."""

    def depth(t):
        return t**3 / 3 - 0.51 * t**2 + 0.216 * t

    assert turns(cubic(0, 0.216, -0.51, 1 / 3)) == pytest.approx([0.3, 0.7], abs=1e-12)
    kept = printed_loop(depth, 0.0, 1.0, 2e-4)
    assert any(abs(depth(t) - filed) > 1e-6 for t, filed in kept[1:-1])


@pytest.mark.parametrize("turn", [0.5, 0.525, 0.3])
def test_misprint_5_a_symmetric_extremum_is_seen(turn):
    """On a sample the two beside it are equal, half way between two samples these are: the middle is taken."""
    assert turns(cubic(turn**2, -2 * turn, 1.0)) == pytest.approx([turn], abs=1e-12)
    f = [(k / 20 - turn) ** 2 for k in range(21)]
    steps = [(f[k] - f[k - 1], f[k + 1] - f[k], abs(f[k + 1] - f[k - 1]) > 1e-9) for k in range(1, 20)]
    assert not any(a * b < 0 and apart for a, b, apart in steps if abs(a) > 1e-9 and abs(b) > 1e-9)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_misprint_6_halving_goes_on_until_the_whole_chord_fits(tolerance):
    """(t - 1/2)^3 is on its chord at the middle and off by 0.048; one halving of t^2 leaves an error of 1/16."""
    for num, printed_pieces in ((cubic(-0.125, 0.75, -1.5, 1.0), 1), (cubic(0, 0, 1.0), 2)):
        at = {x: float(bernstein.value(num, torch.tensor([x], dtype=FLOAT64))) for x in (0.0, 0.5, 1.0)}
        wrong_in_the_middle = abs(at[0.5] - 0.5 * (at[0.0] + at[1.0])) > tolerance
        ends = torch.tensor([0.0, 0.5, 1.0] if wrong_in_the_middle else [0.0, 1.0], dtype=FLOAT64)
        u = torch.stack([ends[:-1], ends[1:]])
        assert u.shape[1] == printed_pieces
        printed = curve_errors(num, u, torch.tensor([[at[float(x)] for x in row] for row in u]).double())
        assert float(printed.max()) > tolerance
        u, values = cut_curve(num, tolerance)
        assert float(curve_errors(num, u, values).max()) <= tolerance
        assert torch.equal(u[0, 1:], u[1, :-1])


def test_misprint_7_rounding_is_no_extremum_and_time_is_halved(generator):
    """Constants as ratios of proportional cubics: with eps = 0 their last bits turn more often than there is room."""
    den = 0.2 + torch.rand(4, 40, dtype=FLOAT64, generator=generator)
    num = den / 3

    def printed_places(k):
        def depth(t):
            at = torch.tensor([t], dtype=FLOAT64)
            return float(bernstein.value(num[:, k : k + 1], at) / bernstein.value(den[:, k : k + 1], at))

        return len(printed_loop(depth, 0.0, 1.0, 0.0))

    assert max(printed_places(k) for k in range(40)) > 6
    assert len(sampled_extrema(num, den, torch.ones(40, dtype=FLOAT64))[0]) == 0
    u, _ = cut_curve(cubic(0, 0.1, 3.0, 1.0), 1e-3)
    assert u.shape[1] > 4
    assert torch.equal(u * 4096, (u * 4096).round())


def test_misprint_8_a_texture_that_spins_at_constant_depth_is_cut():
    prisms, intervals = spinning_quad()
    depth = chord_error_bound(intervals.near_num, intervals.near_den)
    assert float(depth.max()) < 1e-12, "by depth alone, as printed, nothing is cut"
    assert chord_errors(prisms, approximate(prisms, intervals, LINEAR))[1].max() > 0.05
    pieces = approximate(prisms, intervals, tb.Accuracy.adaptive(1e-2))
    assert pieces.count > 2 * intervals.count
    assert chord_errors(prisms, pieces)[1].max() <= 1e-2
    plain = replace(prisms, surfaces=replace(prisms.surfaces, is_textured=torch.zeros(2, dtype=torch.bool)))
    assert approximate(plain, intervals, tb.Accuracy.adaptive(1e-2)).count == intervals.count


def test_an_instant_without_depth_is_no_extremum():
    """t as a ratio of cubics that vanish at 1/2, where a sample lies."""
    assert turns(cubic(0.0, 1.0, -4, 4), den=cubic(1.0, -4, 4)) == []
