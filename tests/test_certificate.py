"""The number of nodes that a panel asks for: Gauss's rule with so many is right, and with far fewer it is not."""

import numpy as np
import pytest
import torch

from torchblur import bernstein, certificate
from torchblur.certificate import Divider, Lookup

FLOAT64 = torch.float64
N = 4000


def vectors(generator, degree, width, spread):
    """Return (degree + 1, width, N) polynomials that vary by up to `spread` about a middle of length 1."""
    middle = torch.randn(1, width, N, dtype=FLOAT64, generator=generator)
    middle = middle / middle.norm(dim=1, keepdim=True)
    return middle + spread * (torch.rand(degree + 1, width, N, dtype=FLOAT64, generator=generator) - 0.5)


def looks(generator, spread, moved=None, by=0.0):
    """Return the dividers, the lookup, and a function of time in [0, 1] (K, N) with the size it is measured by; with
    one of scale, toward, normal and place `moved` by so much of their sizes, any way.
    """
    scale = vectors(generator, 2, 1, spread)
    toward, normal = vectors(generator, 3, 3, spread), vectors(generator, 2, 3, spread)
    at_ends = torch.rand(3, 2, N, dtype=FLOAT64, generator=generator)
    place = bernstein.product(scale[[0, 2]] * 0 + 1, at_ends[:2]) * scale  # some way across one texel
    every = torch.arange(N)
    if moved:
        at = {"scale": scale, "toward": toward, "normal": normal, "place": place}[moved]
        at += by * (torch.rand(at.shape, dtype=FLOAT64, generator=torch.Generator().manual_seed(6)) - 0.5)
    limits = (certificate.SCALE_LIMIT, certificate.VECTOR_LIMIT, certificate.VECTOR_LIMIT)
    dividers = [Divider(every, q, limit) for q, limit in zip((scale, toward, normal), limits, strict=True)]
    lookup = Lookup(every, place, scale[:, 0], torch.zeros(N, dtype=torch.bool))
    corners = torch.rand(2, 2, N, dtype=FLOAT64, generator=generator)

    def value(t):
        t = torch.as_tensor(t, dtype=FLOAT64).reshape(-1, 1)

        def at(c):
            return torch.stack([bernstein.value(c, s) for s in t])  # (K, c, N)

        s, v, n, x = at(scale)[:, 0], at(toward), at(normal), at(place)
        x = x / s.unsqueeze(1)
        low = corners[0, 0] + (corners[0, 1] - corners[0, 0]) * x[:, 0]
        high = corners[1, 0] + (corners[1, 1] - corners[1, 0]) * x[:, 0]
        light = s.square() * (n * v).sum(1) / (n.norm(dim=1) * v.norm(dim=1) ** 3)
        return (low + (high - low) * x[:, 1]) * light * (1 + t), s.square() / v.square().sum(1)

    return dividers, lookup, value


def gauss(n):
    place, weight = np.polynomial.legendre.leggauss(n)
    return 0.5 * (place + 1), torch.as_tensor(0.5 * weight, dtype=FLOAT64).unsqueeze(1)


@pytest.mark.parametrize("spread", [0.0, 1e-4, 0.01, 0.1, 0.25])
def test_the_nodes_asked_for_keep_the_tolerance(spread):
    dividers, lookup, value = looks(torch.Generator().manual_seed(5), spread)
    panels = torch.arange(N), torch.zeros(N, dtype=FLOAT64), torch.ones(N, dtype=FLOAT64)
    needed = certificate.nodes_needed(dividers, lookup, panels, N).ceil().clamp(min=1)
    place, weight = gauss(40)
    true, size = value(place)
    true, size = (weight * true).sum(0), 2 * size.amax(0)  # 2: the weight 1 + t
    asked = torch.isfinite(needed) & (needed <= 16)
    assert asked.sum() > N / 100, "the certificate gives up on nearly everything"
    for n in torch.unique(needed[asked]).long().tolist():
        chosen = asked & (needed == n)
        place, weight = gauss(n)
        error = ((weight * value(place)[0]).sum(0) - true).abs() / size
        assert error[chosen].max() <= certificate.TOLERANCE
    if spread == 0.1:  # two nodes are not enough there: the certificate is not idle
        place, weight = gauss(2)
        assert ((weight * value(place)[0]).sum(0) - true).abs().div(size)[asked].max() > certificate.TOLERANCE


@pytest.mark.parametrize("moved", ["scale", "toward", "normal", "place"])
@pytest.mark.parametrize("spread", [0.0, 0.01, 0.1])
def test_the_nodes_asked_for_keep_slopes(spread, moved):
    """Central differences of the error; at spread 0 only slopes vary with time, for which one node is not enough."""
    panels = torch.arange(N), torch.zeros(N, dtype=FLOAT64), torch.ones(N, dtype=FLOAT64)
    step = 1e-4
    (dividers, lookup, value), forth, back = (
        looks(torch.Generator().manual_seed(5), spread, moved, by) for by in (0.0, step, -step)
    )
    size = 2 * value(gauss(40)[0])[1].amax(0)

    def errors(n):
        means = [[(w * f(t)[0]).sum(0) for t, w in (gauss(n), gauss(40))] for f in (forth[2], back[2])]
        return ((means[0][0] - means[0][1]) - (means[1][0] - means[1][1])).abs() / (2 * step) / size

    needed = certificate.nodes_needed(dividers, lookup, panels, N, slopes=True).ceil().clamp(min=1)
    asked = needed <= 16
    assert asked.sum() > N / 100
    for n in torch.unique(needed[asked]).long().tolist():
        assert errors(n)[asked & (needed == n)].max() <= 10 * certificate.TOLERANCE
    without = certificate.nodes_needed(dividers, lookup, panels, N).ceil().clamp(min=1)
    assert (without <= needed).all()
    if spread == 0.0:
        assert max(errors(n)[without == n].max() for n in torch.unique(without).long().tolist()) > 1e-3


def test_a_place_that_bends_while_the_scale_rests_counts():
    """x = t^2, y = t^2 makes a lookup of degree 4, which two nodes miss whatever the scale."""
    square = torch.tensor([0.0, 0.0, 1.0], dtype=FLOAT64).reshape(3, 1, 1).expand(3, 2, 1)
    one = torch.ones(3, 1, dtype=FLOAT64)
    none = torch.zeros(1, dtype=torch.bool)
    panel = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=FLOAT64), torch.ones(1, dtype=FLOAT64)
    needed = certificate.nodes_needed([], Lookup(panel[0], square, one, none), panel, 1)
    assert 2 < float(needed) <= 3


def test_layers_of_textured_opacity_ask_for_more():
    """Their opacities multiply, so degrees add up."""
    needed = []
    for n in (1, 2, 4):
        line = torch.tensor([0.0, 0.5, 1.0], dtype=FLOAT64).reshape(3, 1, 1).expand(3, 2, n)
        lookup = Lookup(torch.zeros(n, dtype=torch.int64), line, torch.ones(3, n, dtype=FLOAT64), torch.ones(n).bool())
        panel = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=FLOAT64), torch.ones(1, dtype=FLOAT64)
        needed.append(float(certificate.nodes_needed([], lookup, panel, 1)))
    assert needed == sorted(needed)
    assert needed[0] < needed[1] < needed[2] <= 6


def test_a_divider_that_vanishes_has_no_certificate():
    q = torch.tensor([1.0, 0.0, -1.0], dtype=FLOAT64).reshape(3, 1, 1)
    none = Lookup(
        torch.zeros(0, dtype=torch.int64),
        torch.zeros(3, 2, 0, dtype=FLOAT64),
        torch.zeros(3, 0, dtype=FLOAT64),
        torch.zeros(0, dtype=torch.bool),
    )
    panel = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=FLOAT64), torch.ones(1, dtype=FLOAT64)
    divider = Divider(panel[0], q, certificate.SCALE_LIMIT)
    assert torch.isinf(certificate.nodes_needed([divider], none, panel, 1)).all()
