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
NARROW = 2.0**-50  # bracket of a root


@jit
def cubic_at(c0: float, c1: float, c2: float, c3: float, u: float) -> float:
    """Return the value at `u` of the cubic of four coefficients."""
    v = 1.0 - u
    a, b, d = v * c0 + u * c1, v * c1 + u * c2, v * c2 + u * c3
    a, b = v * a + u * b, v * b + u * d
    return v * a + u * b


@jit
def restrict_cubic(
    c0: float, c1: float, c2: float, c3: float, part: tuple[float, float]
) -> tuple[float, float, float, float]:
    """Return the coefficients on a part (start, end) of the cubic of four coefficients."""
    u, t = part
    v, s = 1.0 - u, 1.0 - t
    a0, a1, a2 = v * c0 + u * c1, v * c1 + u * c2, v * c2 + u * c3
    b0, b1 = v * a0 + u * a1, v * a1 + u * a2
    d0, d1 = s * a0 + t * a1, s * a1 + t * a2
    e0, e1, e2 = s * c0 + t * c1, s * c1 + t * c2, s * c2 + t * c3
    e0, e1 = s * e0 + t * e1, s * e1 + t * e2
    return v * b0 + u * b1, s * b0 + t * b1, s * d0 + t * d1, s * e0 + t * e1


@jit
def sort_by(key: np.ndarray, column: int, order: np.ndarray, n: int) -> None:
    """Put `n` rows of `key` that `order` holds in ascending order of a column. Source: Shell 1959."""
    gap = 1
    while 3 * gap + 1 < n:
        gap = 3 * gap + 1
    while gap > 0:
        for k in range(gap, n):
            own, place = order[k], k
            value = key[own, column]
            while place >= gap and key[order[place - gap], column] > value:
                order[place] = order[place - gap]
                place -= gap
            order[place] = own
        gap //= 3


@jit
def signs_of(c: np.ndarray, row: int, n: int, noise: float) -> tuple[int, int, int]:
    """Return how often the sign changes along `n` coefficients, and the first and the last sign; noise counts as 0."""
    changes, first, last = 0, 0, 0
    for k in range(n):
        value = c[row, k]
        if abs(value) > noise:
            sign = 1 if value > 0 else -1
            if last * sign < 0:
                changes += 1
            if first == 0:
                first = sign
            last = sign
    return changes, first, last


@jit
def value_of(c: np.ndarray, row: int, n: int, u: float) -> float:
    """Return the value at `u` of the polynomial of `n` coefficients in a row of `c`, whose last row is worked in."""
    last = len(c) - 1
    for k in range(n):
        c[last, k] = c[row, k]
    for m in range(n - 1, 0, -1):
        for k in range(m):
            c[last, k] = (1.0 - u) * c[last, k] + u * c[last, k + 1]
    return c[last, 0]


@jit
def roots_of(room: np.ndarray, n: int, noise: float, found: np.ndarray) -> int:
    """Write the places in (0, 1) at which a polynomial changes sign to `found`, and return how many there are.

    Args:
        room: (MAX_HALVINGS + 4, MAX_DEGREE + 3) with the coefficients in the first row; overwritten.
        n: their number, at most MAX_DEGREE + 1.
        noise: size below which a coefficient is rounding.
        found: (MAX_DEGREE,) of which no more can be filled.
    """
    count, top, last = 0, 1, len(room) - 1
    room[0, n], room[0, n + 1] = 0.0, 1.0  # where the part begins, and how long it is
    while top > 0:
        top -= 1
        changes, first, _ = signs_of(room, top, n, noise)
        start, width = room[top, n], room[top, n + 1]
        if changes == 0:
            continue
        if changes == 1:
            low, high = 0.0, 1.0
            at_low, at_high = room[top, 0] * first, room[top, n - 1] * first
            for step in range(2 * BISECTIONS):
                middle = (low + high) / 2
                if step % 3 < 2 and at_low > 0 > at_high:  # false position, and each third time a bisection
                    middle = min(max(low + (high - low) * (at_low / (at_low - at_high)), low), high)
                at_middle = value_of(room, top, n, middle) * first
                if at_middle > 0:
                    if at_high < 0 and step % 3 == 1:
                        at_high *= 0.5  # Illinois
                    low, at_low = middle, at_middle
                else:
                    if at_low > 0 and step % 3 == 1:
                        at_low *= 0.5
                    high, at_high = middle, at_middle
                if not (high - low) * width > NARROW:
                    break
            if count < MAX_DEGREE:
                found[count] = start + width * (low + high) / 2
                count += 1
            continue
        if width <= 2.0**-MAX_HALVINGS:
            continue
        for k in range(n):
            room[last, k] = room[top, k]
        room[top + 1, n - 1] = room[last, n - 1]
        # the left part replaces this one, the right part follows it
        for m in range(n - 1, 0, -1):
            for k in range(m):
                room[last, k] = 0.5 * room[last, k] + 0.5 * room[last, k + 1]
            room[top, n - m] = room[last, 0]
            room[top + 1, m - 1] = room[last, m - 1]
        room[top, n + 1] = room[top + 1, n + 1] = width / 2
        room[top + 1, n] = start + width / 2
        if abs(room[top, n - 1]) <= noise:
            _, _, before = signs_of(room, top, n, noise)
            _, after, _ = signs_of(room, top + 1, n, noise)
            if before * after < 0 and count < MAX_DEGREE:
                found[count] = start + width / 2
                count += 1
        top += 2
    return count
