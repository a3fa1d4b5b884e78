"""Bernstein polynomials against their power form and against dense sampling."""

from math import comb

import numpy as np
import pytest
import torch

from torchblur import bernstein

NO_NOISE = 1e-15


def from_roots(roots, degree=6):
    """Bernstein coefficients (degree + 1, 1) of the monic polynomial with these roots."""
    power = np.atleast_1d(np.poly(roots))[::-1]
    power = np.concatenate([power, np.zeros(degree + 1 - len(power))])
    return torch.tensor(
        [[sum(comb(k, i) / comb(degree, i) * power[i] for i in range(k + 1))] for k in range(degree + 1)],
        dtype=torch.float64,
    )


def found(coefficients, noise=NO_NOISE):
    which, u = bernstein.roots(coefficients, torch.full((coefficients.shape[1],), noise, dtype=torch.float64))
    assert (which == 0).all()
    return sorted(u.tolist())


@pytest.mark.parametrize("width", [1, 2, 5])
def test_length_is_the_norm_however_small_or_large(width, generator):
    vectors = torch.rand(4, width, 30, dtype=torch.float64, generator=generator) - 0.5
    expected = torch.linalg.vector_norm(vectors, dim=1)
    for size in (1.0, 2.0**-600, 2.0**600):
        torch.testing.assert_close(bernstein.length(size * vectors, 1) / size, expected, rtol=1e-15, atol=0)
    assert not bernstein.length(0 * vectors, 1).any()


def test_value_split_restrict_and_product_are_one_polynomial(generator):
    a = torch.rand(7, 40, dtype=torch.float64, generator=generator) - 0.5
    b = torch.rand(4, 40, dtype=torch.float64, generator=generator) - 0.5
    u, lo, hi = torch.rand(3, 40, dtype=torch.float64, generator=generator)
    at = bernstein.value(a, lo + u * (hi - lo))
    torch.testing.assert_close(bernstein.value(bernstein.restrict(a, lo, hi), u), at, rtol=0, atol=1e-14)
    left, right = bernstein.split(a, lo)
    torch.testing.assert_close(bernstein.value(left, u), bernstein.value(a, lo * u), rtol=0, atol=1e-14)
    torch.testing.assert_close(bernstein.value(right, u), bernstein.value(a, lo + (1 - lo) * u), rtol=0, atol=1e-14)
    both = bernstein.value(bernstein.product(a, b), u)
    torch.testing.assert_close(both, bernstein.value(a, u) * bernstein.value(b, u), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "roots",
    [
        [0.5],
        [0.25],
        [0.5, 0.75],
        [0.1, 0.2, 0.3, 0.6, 0.8, 0.95],
        [0.5, 0.5 + 1e-6],
        [0.125, 0.25, 0.375, 0.5, 0.625, 0.875],
        [-0.2, 0.3, 1.4],
        [],
    ],
)
def test_simple_roots_are_all_found(roots):
    inside = [r for r in roots if 0 < r < 1]
    got = found(from_roots(roots))
    assert len(got) == len(inside)
    assert np.allclose(got, sorted(inside), rtol=0, atol=1e-9)


def test_a_triple_root_is_one_sign_change_and_a_double_root_none():
    # A triple root is known to the cube root of rounding: 1e-16 ** (1 / 3).
    assert found(from_roots([0.5] * 3)) == [pytest.approx(0.5, abs=1e-4)]
    assert found(from_roots([0.5, 0.5])) == []
    assert found(from_roots([0.3, 0.3]), noise=1e-14) == []


def test_noise_has_no_roots():
    assert found(torch.tensor([[1e-16], [-1e-16], [1e-16], [-1e-16]], dtype=torch.float64)) == []


def test_random_polynomials_have_the_sign_changes_that_sampling_sees(generator):
    n = 400
    c = torch.rand(7, n, dtype=torch.float64, generator=generator) - 0.5
    which, u = bernstein.roots(c, torch.full((n,), NO_NOISE, dtype=torch.float64))
    grid = torch.linspace(0, 1, 4001, dtype=torch.float64)
    values = torch.stack([bernstein.value(c, g.expand(n)) for g in grid])
    seen = ((values[1:] * values[:-1]) < 0).sum(0)
    assert seen.sum() > n
    assert (torch.bincount(which, minlength=n) == seen).all()
    assert bernstein.value(c[:, which], u).abs().max() < 1e-14
