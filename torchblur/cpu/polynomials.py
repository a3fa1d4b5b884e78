"""Polynomials by their Bernstein coefficients, one at a time: what bernstein.py does for many at once.

Before: jit.py.  After: coverage.py, sweep.py.
Symbols: rows of arrays hold the coefficients on [0, 1]; u in [0, 1].
Source: as bernstein.py.
"""

from __future__ import annotations

import numpy as np

from torchblur.bernstein import BISECTIONS, MAX_HALVINGS
from torchblur.cpu.jit import jit

MAX_DEGREE = 6  # of a difference of two nearnesses
BINOMIALS = np.array([1.0, 3.0, 3.0, 1.0])
BINOMIALS_6 = np.array([1.0, 6.0, 15.0, 20.0, 15.0, 6.0, 1.0])


@jit
def cubic_at(c: np.ndarray, u: float) -> float:
    """Return the value of a cubic (4,) at `u`, by de Casteljau."""
    v = 1.0 - u
    a, b, d = v * c[0] + u * c[1], v * c[1] + u * c[2], v * c[2] + u * c[3]
    a, b = v * a + u * b, v * b + u * d
    return v * a + u * b


@jit
def restrict_cubic(c: np.ndarray, u_start: float, u_end: float, out: np.ndarray) -> float:
    """Write the coefficients of a cubic on [u_start, u_end] to `out` (4,), and return the largest in size."""
    v, s = 1.0 - u_start, 1.0 - u_end
    a0, a1, a2 = v * c[0] + u_start * c[1], v * c[1] + u_start * c[2], v * c[2] + u_start * c[3]
    b0, b1 = v * a0 + u_start * a1, v * a1 + u_start * a2
    out[0] = v * b0 + u_start * b1
    out[1] = s * b0 + u_end * b1
    d0, d1 = s * a0 + u_end * a1, s * a1 + u_end * a2
    out[2] = s * d0 + u_end * d1
    e0, e1, e2 = s * c[0] + u_end * c[1], s * c[1] + u_end * c[2], s * c[2] + u_end * c[3]
    e0, e1 = s * e0 + u_end * e1, s * e1 + u_end * e2
    out[3] = s * e0 + u_end * e1
    return max(max(abs(out[0]), abs(out[1])), max(abs(out[2]), abs(out[3])))


@jit
def signs_of(c: np.ndarray, n: int, noise: float) -> tuple[int, int, int]:
    """Return how often the sign changes along `n` coefficients, and the first and the last sign; noise counts as 0."""
    changes, first, last = 0, 0, 0
    for k in range(n):
        sign = 0
        if c[k] > noise:
            sign = 1
        elif c[k] < -noise:
            sign = -1
        if sign != 0:
            if last * sign < 0:
                changes += 1
            if first == 0:
                first = sign
            last = sign
    return changes, first, last


@jit
def value_of(c: np.ndarray, n: int, u: float, rows: np.ndarray) -> float:
    """Return the value at `u` of the polynomial of `n` coefficients; `rows` is room for as many."""
    for k in range(n):
        rows[k] = c[k]
    for m in range(n - 1, 0, -1):
        for k in range(m):
            rows[k] = (1.0 - u) * rows[k] + u * rows[k + 1]
    return rows[0]


@jit
def roots_of(coefficients: np.ndarray, n: int, noise: float, room: np.ndarray, found: np.ndarray) -> int:
    """Write the places in (0, 1) at which a polynomial changes sign to `found`, and return how many there are.

    Args:
        coefficients: (n,) of it.
        n: their number, at most MAX_DEGREE + 1.
        noise: size below which a coefficient is rounding.
        room: (MAX_HALVINGS + 4, MAX_DEGREE + 3) to work in.
        found: (MAX_DEGREE,) of which no more can be filled.
    """
    count, top = 0, 1
    room[0, :n] = coefficients[:n]
    room[0, n], room[0, n + 1] = 0.0, 1.0  # where the part begins, and how long it is
    rows = room[len(room) - 1]
    while top > 0:
        top -= 1
        part = room[top]
        changes, first, _ = signs_of(part, n, noise)
        start, width = part[n], part[n + 1]
        if changes == 0:
            continue
        if changes == 1:
            low, high = 0.0, 1.0
            for _ in range(BISECTIONS):
                middle = (low + high) / 2
                if value_of(part, n, middle, rows) * first > 0:
                    low = middle
                else:
                    high = middle
                if not low < (low + high) / 2 < high:
                    break
            if count < MAX_DEGREE:
                found[count] = start + width * (low + high) / 2
                count += 1
            continue
        if width <= 2.0**-MAX_HALVINGS:
            continue
        following = room[top + 1]
        rows[:n] = part[:n]
        following[n - 1] = rows[n - 1]
        # the left part replaces this one, the right part follows it
        for m in range(n - 1, 0, -1):
            for k in range(m):
                rows[k] = 0.5 * rows[k] + 0.5 * rows[k + 1]
            part[n - m] = rows[0]
            following[m - 1] = rows[m - 1]
        part[n + 1] = following[n + 1] = width / 2
        following[n] = start + width / 2
        if abs(part[n - 1]) <= noise:
            _, _, before = signs_of(part, n, noise)
            _, after, _ = signs_of(following, n, noise)
            if before * after < 0 and count < MAX_DEGREE:
                found[count] = start + width / 2
                count += 1
        top += 2
    return count
