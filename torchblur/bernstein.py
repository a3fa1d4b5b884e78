"""Polynomials of low degree on [0, 1] by their Bernstein coefficients: product, value, halves, roots.

Before: nothing.  After: edges.py (near and far planes), cells.py (crossings in depth).
Symbols: n polynomials at once, degree d, coefficients (d + 1, n); u in [0, 1] is the local parameter.
Coefficients of one sign certify that there is no root: the polynomial lies in their convex hull.
Source: Farouki & Rajan 1987 (arithmetic); Lane & Riesenfeld 1981 (roots by subdivision and variation of sign).
"""

from __future__ import annotations

from functools import cache, reduce
from math import comb

import torch
from torch import Tensor

MAX_HALVINGS = 44  # isolate roots down to 2^-44 of the range: below any time step that can be seen
BISECTIONS = 52  # then to the last bit of float64


@cache
def _product_weights(degree_a: int, degree_b: int) -> tuple[tuple[float, ...], ...]:
    total = degree_a + degree_b
    return tuple(
        tuple(comb(degree_a, i) * comb(degree_b, j) / comb(total, i + j) for j in range(degree_b + 1))
        for i in range(degree_a + 1)
    )


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return the (d_a + d_b + 1, ...) coefficients of the product of `a` (d_a + 1, ...) and `b` (d_b + 1, ...)."""
    weights = _product_weights(len(a) - 1, len(b) - 1)
    rows: list[Tensor | None] = [None] * (len(a) + len(b) - 1)
    for i in range(len(a)):
        for j in range(len(b)):
            term = weights[i][j] * (a[i] * b[j])
            rows[i + j] = term if rows[i + j] is None else rows[i + j] + term
    return torch.stack(rows)


def length(vectors: Tensor, dim: int) -> Tensor:
    """Return the lengths of vectors along `dim`, many times faster than torch's norm; where they are 0, no gradient."""
    return reduce(torch.hypot, vectors.unbind(dim)).abs()


def value(coefficients: Tensor, u: Tensor) -> Tensor:
    """Return the (n,) values of (d + 1, n) polynomials at `u` (n,), by de Casteljau."""
    rows = coefficients
    v = 1 - u
    while len(rows) > 1:
        rows = v * rows[:-1] + u * rows[1:]
    return rows[0]


def split(coefficients: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return the coefficients on [0, u] and on [u, 1], each (d + 1, n), by de Casteljau."""
    left, right = [coefficients[0]], [coefficients[-1]]
    rows = coefficients
    v = 1 - u
    while len(rows) > 1:
        rows = v * rows[:-1] + u * rows[1:]
        left.append(rows[0])
        right.append(rows[-1])
    return torch.stack(left), torch.stack(right[::-1])


def restrict(coefficients: Tensor, u_start: Tensor, u_end: Tensor) -> Tensor:
    """Return the (d + 1, n) coefficients on [u_start, u_end] (n,), by blossoming: no shift of the origin.

    The k-th coefficient is the polar form with d - k arguments u_start and k arguments u_end.
    """
    degree = len(coefficients) - 1
    columns = [coefficients]  # columns[s]: s arguments u_start used so far
    for _ in range(degree):
        columns.append((1 - u_start) * columns[-1][:-1] + u_start * columns[-1][1:])
    out = []
    for k in range(degree + 1):
        rows = columns[degree - k]
        while len(rows) > 1:
            rows = (1 - u_end) * rows[:-1] + u_end * rows[1:]
        out.append(rows[0])
    return torch.stack(out)


def ratio_range(numerator: Tensor, denominator: Tensor) -> tuple[Tensor, Tensor]:
    """Return bounds (K,) of the quotient of polynomials of one degree (d + 1, K): a rational Bezier lies in the hull of
    its ratios. Infinities where the denominator may vanish.
    """
    is_proper = (denominator > 0).all(0) | (denominator < 0).all(0)
    ratio = numerator / torch.where(is_proper, denominator, 1.0)
    return torch.where(is_proper, ratio.amin(0), -torch.inf), torch.where(is_proper, ratio.amax(0), torch.inf)


def sign_changes(coefficients: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return how often the sign changes along the coefficients, and the first and the last sign, all (n,) int64.

    Coefficients of at most `noise` (n,) in size are rounding and count as zero.
    """
    sign = coefficients.sign() * (coefficients.abs() > noise)
    last = sign[0]
    first = sign[0]
    changes = torch.zeros_like(last, dtype=torch.int64)
    for row in sign[1:]:
        changes += (row * last) < 0
        last = torch.where(row != 0, row, last)
        first = torch.where(first != 0, first, row)
    return changes, first.long(), last.long()


def roots(coefficients: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return all places in (0, 1) at which the polynomials change sign.

    Args:
        coefficients: (d + 1, n) float64.
        noise: (n,) size below which a coefficient is rounding; a polynomial that is all noise has no roots.

    Returns:
        (R,) int64 which polynomial, (R,) float64 u. In no particular order. Places where the sign does not change
        (double roots) are left out; so are pairs of roots closer than 2^-44.
    """
    owner = torch.arange(coefficients.shape[1], device=coefficients.device)
    start = torch.zeros_like(noise)
    found_owner, found_u = [], []
    width = 1.0
    for _ in range(MAX_HALVINGS):
        changes, _, _ = sign_changes(coefficients, noise)
        one = (changes == 1).nonzero().flatten()
        if len(one):
            found_owner.append(owner[one])
            found_u.append(start[one] + width * _bisect(coefficients[:, one], noise[one]))
        many = (changes > 1).nonzero().flatten()
        if len(many) == 0:
            break
        owner, start, noise = owner[many], start[many], noise[many]
        left, right = split(coefficients[:, many], torch.full_like(start, 0.5))
        width /= 2
        _, _, before = sign_changes(left, noise)
        _, after, _ = sign_changes(right, noise)
        at_middle = ((left[-1].abs() <= noise) & (before * after < 0)).nonzero().flatten()
        found_owner.append(owner[at_middle])
        found_u.append(start[at_middle] + width)
        coefficients = torch.cat([left, right], dim=1)
        owner, start, noise = owner.repeat(2), torch.cat([start, start + width]), noise.repeat(2)
    if not found_owner:
        return owner[:0], start[:0]
    return torch.cat(found_owner), torch.cat(found_u)


def _bisect(coefficients: Tensor, noise: Tensor) -> Tensor:
    """Return the (n,) root of polynomials whose coefficients change sign exactly once."""
    _, first, _ = sign_changes(coefficients, noise)
    low = torch.zeros_like(noise)
    high = torch.ones_like(noise)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        is_before = value(coefficients, middle) * first > 0
        low, high = torch.where(is_before, middle, low), torch.where(is_before, high, middle)
    return (low + high) / 2
