"""Polynomials by their Bernstein coefficients, one at a time: what bernstein.py does for many at once.

Before: jit.py.  After: coverage.py, sweep.py, bends.py.
Symbols: rows of arrays hold the coefficients on [0, 1]; u in [0, 1].
Source: as bernstein.py.
"""

from __future__ import annotations

import numpy as np

from torchblur.bernstein import MAX_HALVINGS
from torchblur.cpu.jit import inlined, inner

MAX_DEGREE = 8  # 6 of a difference of two nearnesses, 8 of mip levels and cones
NARROW = 2.0**-51  # relative: step or bracket that ends the search for a root
MAX_STEPS = 100  # twice the bits there are


@inlined
def cubic_at(c0: float, c1: float, c2: float, c3: float, u: float) -> float:
    """Return the value at `u` of the cubic of four coefficients."""
    v = 1.0 - u
    a, b, d = v * c0 + u * c1, v * c1 + u * c2, v * c2 + u * c3
    a, b = v * a + u * b, v * b + u * d
    return v * a + u * b


@inlined
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


@inner
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


@inlined
def sort_few(values: np.ndarray, n: int) -> None:
    """Put the first `n` values in ascending order, by insertion."""
    for k in range(1, n):
        value, place = values[k], k
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value


@inlined
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


@inner
def _only_root(c: np.ndarray, row: int, n: int, first: int) -> float:
    """Return the place in [0, 1] at which the polynomial of `n` coefficients in a row of `c` changes sign, which it
    does once, from `first`. Worked in the last row of `c`.

    With s = u / (1 - u) the polynomial is (1 - u)^(n - 1) times one in s whose coefficients change sign once, too, so
    that it has one positive root; the half of [0, 1] that holds it is mapped to s in [0, 1]. Newton's steps, inside a
    bracket.
    """
    last = len(c) - 1
    at_half, scale = 0.0, 1.0
    for k in range(n):
        c[last, k] = scale * c[row, k]
        at_half += c[last, k]
        scale = scale * (n - 1 - k) / (k + 1)
    if at_half == 0:
        return 0.5
    is_late = at_half * first > 0
    if is_late:
        for k in range(n // 2):
            c[last, k], c[last, n - 1 - k] = c[last, n - 1 - k], c[last, k]
    low, high = 0.0, 1.0
    s = c[last, 0] / (c[last, 0] - at_half) if c[last, 0] * at_half < 0 else 0.5
    for _ in range(MAX_STEPS):
        value, slope = c[last, n - 1], 0.0
        for k in range(n - 2, -1, -1):
            slope = slope * s + value
            value = value * s + c[last, k]
        if value == 0:
            break
        if value * at_half < 0:
            low = s
        else:
            high = s
        step = value / slope
        if not (low < s - step < high):
            step = s - 0.5 * (low + high)
        s -= step
        if abs(step) <= NARROW * s or not high - low > NARROW * s:
            break
    return 1.0 / (1.0 + s) if is_late else s / (1.0 + s)


@inner
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
            root = _only_root(room, top, n, first)
            if count < MAX_DEGREE:
                found[count] = start + width * root
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
