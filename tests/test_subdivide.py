"""Straight lines in time for depth and texture: bounds and pieces against dense sampling.

The oracle `true_at` follows nearness and uv from clip space at given times, without Bernstein coefficients.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import scene_makers as make
import torch
from oracles import PlainScene

import torchblur as tb
from torchblur import bernstein, cells, packed
from torchblur.camera import CENTRE
from torchblur.intervals import find_intervals
from torchblur.pairs import Block
from torchblur.prisms import build_prisms
from torchblur.subdivide import approximate, chord_error_bound
from torchblur.surfaces import build_surfaces

FLOAT64 = torch.float64
LINEAR = tb.Accuracy.linear()
WHITE = torch.ones(1, 1, 3, dtype=FLOAT64)
UV = torch.tensor([[[0.0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=FLOAT64)


def covered(scene):
    """The prisms of a scene and the intervals of all its pixels."""
    camera = scene.camera
    prisms = build_prisms(scene, build_surfaces(scene), (0.0, 1.0))
    block = Block(0, 0, camera.width, camera.height, CENTRE, camera.width, camera.height)
    return prisms, find_intervals(prisms, block, torch.arange(prisms.count))[0]


def textured(knots, uv=None, matrix=make.IDENTITY, size=1, faces=None):
    """Prisms and intervals of one textured mesh with (K+1, V, 3) knots; the triangles are loose without `faces`."""
    knots = torch.as_tensor(np.asarray(knots), dtype=FLOAT64)
    faces = torch.arange(knots.shape[1]).reshape(-1, 3) if faces is None else torch.as_tensor(faces)
    uv = torch.rand(len(faces), 3, 2, dtype=FLOAT64, generator=torch.Generator().manual_seed(1)) if uv is None else uv
    mesh = tb.Mesh(knots, faces, tb.Material(texture=WHITE), uv=uv)
    return covered(tb.Scene([mesh], tb.Camera(torch.as_tensor(matrix, dtype=FLOAT64), size, size)))


def soup(rng, n_segments=1, z=(-1.0, 1.5)):
    """Prisms and intervals of textured loose triangles whose corners each move their own way, in perspective."""
    knots = make.random_triangles(rng, 40, z=z, motion=0.6, n_segments=n_segments).vertices
    return textured(knots, matrix=make.perspective(eye=(0, 0, 3.5), near=0.5, far=20), size=16)


def true_at(prisms, intervals, which, t):
    """Nearness (m, T) and uv (m, 2, T) of intervals `which` (m,) at the times t (m, T), in plain numpy."""
    prism = intervals.prism[which]
    ray = intervals.ray_ndc[:, packed.owners(intervals.offsets)[which]].numpy()[:, :, None]
    opens, closes = (x[prism].numpy()[:, None] for x in (prisms.t_open, prisms.t_close))
    u = (np.asarray(t) - opens) / (closes - opens)
    start, end = prisms.clip[..., prism].numpy()[..., None]  # (3 corners, 4, m, 1)
    corner = (1 - u) * start + u * end
    a = np.stack([corner[:, 0] - ray[0] * corner[:, 3], corner[:, 1] - ray[1] * corner[:, 3]])
    e = np.stack([a[0, j] * a[1, k] - a[1, j] * a[0, k] for j, k in ((1, 2), (2, 0), (0, 1))])
    uv = prisms.surfaces.uv[prisms.face_of[prism], prisms.corner_of[:, prism]].numpy()  # (3, m, 2)
    place = np.einsum("imt,imk->mkt", e, uv) / e.sum(0)[:, None]
    return 2 - (e * corner[:, 2]).sum(0) / (e * corner[:, 3]).sum(0), place


def chord_errors(prisms, pieces):
    """The true greatest distance (m,) of nearness and of uv from their chords over each piece."""
    share = np.linspace(1e-7, 1 - 1e-7, 65)
    start, end = pieces.t_start.detach().numpy()[:, None], pieces.t_end.detach().numpy()[:, None]
    near, uv = true_at(prisms, pieces, torch.arange(pieces.count), start + share * (end - start))
    assert (pieces.near_den == 1).all()
    line = torch.stack([bernstein.value(pieces.near_num, torch.full_like(pieces.t_start, s)) for s in share], 1)
    straight = (1 - share) * uv[..., :1] + share * uv[..., -1:]
    return np.abs(near - line.detach().numpy()).max(1), np.abs(uv - straight).max((1, 2))


def owners_of(pieces, intervals):
    """Which interval each piece came from, by its prism, pixel and times."""
    key = list(zip(packed.owners(intervals.offsets).tolist(), intervals.prism.tolist(), strict=True))
    table = {}
    for k, pair in enumerate(key):
        table.setdefault(pair, []).append(k)
    owner = []
    for pixel, prism, t in zip(
        packed.owners(pieces.offsets).tolist(), pieces.prism.tolist(), pieces.t_start.tolist(), strict=True
    ):
        (found,) = [k for k in table[pixel, prism] if intervals.t_start[k] <= t < intervals.t_end[k]]
        owner.append(found)
    return torch.tensor(owner)


def spinning_quad(z=0.2, size=9):
    """A textured square that turns by 90 degrees about the line of sight between two knots."""
    square = np.array([[-1.0, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return textured(make.rotated(square, math.pi / 2, 1), UV, size=size, faces=faces)


@pytest.mark.parametrize("degree", [2, 3], ids=["uv", "depth"])
def test_the_bound_holds_and_is_tight(degree, generator):
    """10,000 ratios against 401 samples of each; `max(true, tiny)` keeps straight ones from dividing by zero."""
    den = 0.2 + torch.rand(degree + 1, 10_000, dtype=FLOAT64, generator=generator)
    den = den * torch.where(torch.arange(10_000) % 2 == 0, 1.0, -3.0)
    value = torch.rand(degree + 1, 10_000, dtype=FLOAT64, generator=generator)
    num = den * value
    bound = chord_error_bound(num, den)
    true = torch.zeros_like(bound)
    for u in torch.linspace(0, 1, 401, dtype=FLOAT64).tolist():
        at = torch.full_like(bound, u)
        ratio = bernstein.value(num, at) / bernstein.value(den, at)
        true = torch.maximum(true, (ratio - ((1 - u) * value[0] + u * value[-1])).abs())
    assert (true <= bound + 1e-15).all()
    assert float((bound / true.clamp(min=1e-9)).median()) < 3


def test_the_bound_is_at_most_the_methods_formula_for_uv(generator):
    q = 0.2 + torch.rand(3, 1000, dtype=FLOAT64, generator=generator)
    r = torch.rand(3, 1000, dtype=FLOAT64, generator=generator)
    delta = r[2] - r[0]
    first, last = -q[0] * delta + 2 * q[1] * (r[1] - r[0]), q[2] * delta + 2 * q[1] * (r[1] - r[2])
    formula = 0.25 * torch.maximum(first.abs(), last.abs()) / q.amin(0)
    assert (chord_error_bound(q * r, q) <= formula * (1 + 1e-12)).all()


@pytest.mark.parametrize("den", [[1.0, -1, 1], [-1.0, 1, 1], [0.0, 1, 1], [0.0, 0, 0], [math.nan, 1, 1]])
def test_there_is_no_bound_where_the_denominator_may_vanish(den):
    den = torch.tensor(den, dtype=FLOAT64).reshape(3, 1)
    assert chord_error_bound(torch.ones_like(den), den).tolist() == [math.inf]


def test_linear_is_exact_at_the_ends_and_touches_nothing_else(rng):
    prisms, intervals = soup(rng, n_segments=2)
    got = approximate(prisms, intervals, LINEAR)
    for name in ("offsets", "prism", "t_start", "t_end", "ray_ndc"):
        assert torch.equal(getattr(got, name), getattr(intervals, name)), name
    t = torch.stack([intervals.t_start, intervals.t_end], 1)
    near, _ = true_at(prisms, intervals, torch.arange(intervals.count), t.numpy())
    ends = got.near_num[[0, -1]].T
    torch.testing.assert_close(ends, torch.tensor(near), rtol=0, atol=1e-7)  # a corner that shrinks is ill-conditioned
    assert float((ends - torch.tensor(near)).abs().median()) < 1e-14
    torch.testing.assert_close(got.near_num.diff(dim=0), got.near_num.diff(dim=0).mean(0).expand(3, -1))
    exact = tb.Accuracy.exact()
    assert approximate(prisms, intervals, exact) is intervals


@pytest.mark.parametrize(
    ("tolerance", "how"),
    [(3e-2, {}), (1e-3, {"n_segments": 3}), (1e-3, {"z": (-1.0, 4.5)})],
    ids=["coarse", "segments", "behind the camera"],
)
def test_pieces_abut_cover_the_interval_and_keep_to_the_tolerance(rng, tolerance, how):
    prisms, intervals = soup(rng, **how)
    assert intervals.count > 400
    pieces = approximate(prisms, intervals, tb.Accuracy.adaptive(tolerance))
    assert pieces.count > intervals.count
    owner = owners_of(pieces, intervals)
    assert (owner.diff() >= 0).all()
    same = owner[1:] == owner[:-1]
    assert torch.equal(pieces.t_start[1:][same], pieces.t_end[:-1][same])
    first, last = torch.cat([torch.tensor([True]), ~same]), torch.cat([~same, torch.tensor([True])])
    assert torch.equal(owner[first], torch.arange(intervals.count))
    assert torch.equal(pieces.t_start[first], intervals.t_start)
    assert torch.equal(pieces.t_end[last], intervals.t_end)
    assert (pieces.t_start < pieces.t_end).all()
    assert int(pieces.offsets[-1]) == pieces.count
    jump = (pieces.near_num[0, 1:] - pieces.near_num[-1, :-1])[same]
    assert float(jump.abs().max()) < 1e-9
    whole = (intervals.t_end - intervals.t_start)[owner]
    reached = (pieces.t_end - pieces.t_start) > whole / 4096 * 1.001
    assert float(reached.double().mean()) > 0.99, "nearly all pieces end by the tolerance, not by the limit"
    for error in chord_errors(prisms, pieces):
        assert error[reached.numpy()].max() <= tolerance


def test_the_number_of_pieces_grows_like_the_root_of_the_tolerance():
    prisms, intervals = spinning_quad()
    counts = [approximate(prisms, intervals, tb.Accuracy.adaptive(x)).count for x in (1e-3, 1e-4, 1e-5, 1e-6)]
    for few, many in itertools.pairwise(counts):
        assert 2.2 < many / few < 4.5  # 10^(1/2) = 3.2, to within the powers of 2 that halving makes


def test_translation_towards_the_camera_is_never_cut_for_its_texture():
    """With near at 1e-6 the depth that can err is of that size: only uv, which is straight, could ask for a cut."""
    start = np.array([[-9.0, -8, 4], [9, -7, 4.5], [0, 9, 3.7]])
    knots = np.stack([start, start + np.array([0.3, 0.2, 4.0])])
    prisms, intervals = textured(knots, matrix=make.w_is_z(near=1e-6), size=5)
    assert intervals.count
    assert approximate(prisms, intervals, tb.Accuracy.adaptive(1e-6)).count == intervals.count
    prisms, intervals = textured(knots, matrix=make.w_is_z(near=0.5), size=5)
    assert approximate(prisms, intervals, tb.Accuracy.adaptive(1e-3)).count > intervals.count


def test_a_winding_flip_and_a_surface_that_shrinks_to_nothing_have_finite_ends():
    """S and D vanish at t = 1/2: singly where the surface turns over, twice where it shrinks to a point and grows."""
    flip = np.array([[[-1.0, -s, 0.1], [1, -s, 0.3], [0, 2 * s, 0.5]] for s in (1, -1)])
    shrink, grow = (np.array([[[-s, -s, 0.1], [s, -s, 0.3], [0, 2.0 * s, 0.5]] for s in x]) for x in ((1, -1), (0, 1)))
    for knots, n_intervals in ((flip, 2), (shrink, 1), (grow, 1)):
        prisms, intervals = textured(knots)
        assert intervals.count == n_intervals
        for accuracy in (LINEAR, tb.Accuracy.adaptive(1e-3)):
            got = approximate(prisms, intervals, accuracy)
            torch.testing.assert_close(got.near_num, torch.full_like(got.near_num, 2 - 0.3), rtol=0, atol=1e-9)
            assert got.count <= 2, "the limit is smooth: a cut where the surface is a point, and no other"


def test_intervals_of_no_length_and_no_intervals():
    prisms, intervals = spinning_quad(size=3)
    point = replace(intervals, t_end=intervals.t_start)
    none = intervals.of_pixels(torch.zeros(0, dtype=torch.int64))
    for accuracy in (LINEAR, tb.Accuracy.adaptive(1e-3)):
        got = approximate(prisms, point, accuracy)
        assert torch.equal(got.t_start, got.t_end)
        assert torch.isfinite(got.near_num).all()
        assert approximate(prisms, none, accuracy).count == 0


def test_original_ends_keep_their_gradient_and_cuts_have_none():
    knots = torch.tensor([[[-3.0, -1, 0], [-1, -1, 0], [-2, 1, 0.5]], [[1, -1.2, 0.2], [3, -1, 0], [2, 1, 0]]])
    knots = knots.double().requires_grad_()
    mesh = tb.Mesh(knots, [[0, 1, 2]], tb.Material(texture=WHITE), uv=UV[:1])
    prisms, intervals = covered(tb.Scene([mesh], tb.Camera(torch.eye(4, dtype=FLOAT64), 3, 3)))
    pieces = approximate(prisms, intervals, tb.Accuracy.adaptive(1e-4))
    assert pieces.count > intervals.count
    assert not pieces.near_num.requires_grad
    expected, got = (
        torch.autograd.grad((x.t_end**2 - x.t_start).sum(), knots, retain_graph=True)[0] for x in (intervals, pieces)
    )
    assert float(expected.abs().max()) > 0
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("w", [3.0, 3.4])
def test_the_papers_planes_change_places_when_each_accuracy_says(w):
    """A plane with w from 1 to 9 passes w = 3 at t = 1/4; with z / w straight in time it does at 3/4."""
    big = np.array([[-30.0, -30], [30, -30], [0, 40]])
    moving = make.triangle(np.c_[big, [1.0] * 3], np.c_[big, [9.0] * 3], opacity=0.5)
    still = make.triangle(np.c_[big, [w] * 3], opacity=0.5)
    prisms, intervals = covered(make.to_torch(PlainScene([moving, still], make.w_is_z(0.1, 100.0))))

    def swap(accuracy):
        pieces = approximate(prisms, intervals, accuracy)
        found = cells.cut_cells(prisms, pieces)
        front = prisms.face_of[pieces.prism[found.layer_interval[found.layer_offsets[:-1]]]]
        (k,) = front.diff().nonzero().flatten().tolist()
        return float(found.t_start[k + 1])

    scale = 2 * 0.1 * 100 / (100 - 0.1)  # z / w = constant - scale / w
    assert swap(tb.Accuracy.exact()) == pytest.approx((w - 1) / 8, abs=1e-9)
    assert swap(LINEAR) == pytest.approx((1 - 1 / w) / (1 - 1 / 9), abs=1e-9)
    for tolerance in (1e-2, 3e-4, 1e-5):
        early, late = (1 / (1 / w + side * tolerance / scale) for side in (1, -1))
        assert (early - 1) / 8 - 1e-9 <= swap(tb.Accuracy.adaptive(tolerance)) <= (late - 1) / 8 + 1e-9


@pytest.mark.parametrize(
    ("make_it", "error", "name"),
    [
        (lambda: tb.Accuracy.adaptive(0.0), ValueError, "tolerance"),
        (lambda: tb.Accuracy.adaptive(-0.1), ValueError, "tolerance"),
        (lambda: tb.Accuracy.adaptive(1.5), ValueError, "tolerance"),
        (lambda: tb.Accuracy.adaptive(math.nan), ValueError, "tolerance"),
        (lambda: tb.Accuracy.adaptive("0.1"), TypeError, "tolerance"),
        (lambda: tb.Accuracy(method="cubic"), ValueError, "method"),
        (lambda: tb.Accuracy(method="linear", tolerance=0.1), ValueError, "tolerance"),
        (lambda: tb.Accuracy.linear(1.0), ValueError, "transmittance_cutoff"),
    ],
)
def test_accuracies_refuse_what_they_cannot_be(make_it, error, name):
    with pytest.raises(error, match=f"^{name}: expected"):
        make_it()


def test_accuracies_have_what_they_were_given():
    assert tb.Accuracy.exact(0.01) == tb.Accuracy(0.01, "exact", 0.0)
    assert tb.Accuracy.linear(0.01) == tb.Accuracy(0.01, "linear", 0.0)
    assert tb.Accuracy.adaptive(0.5, 0.01) == tb.Accuracy(0.01, "adaptive", 0.5)
