"""Which pairs of receivers and casters may block a light at all, compiled: most candidates do not.

Before: blocking.py.  After: blocked.py.
Symbols: as in blocking.py; a pair is left out only where the Bernstein coefficients show, on every slice that is looked
at, that no time has all signs alike.
Source: ours.
"""

from __future__ import annotations

from torchblur.blocking import HALVINGS
from torchblur.cpu.jit import jit

N_EDGES = 3  # of the signs: an edge that is 0 may count as either sign


@jit
def may_be_alike(signs, noise, n_signs, n):
    """Return whether `n` coefficients each of `signs` (halvings + 1, 5, 6), of which the first are given, may have one
    sign at some time, to `noise` (5,).
    """
    halves, depth = 0, 0  # bit l: the second half of level l is looked at
    while True:
        can_be_up, can_be_down = True, True
        surely_up, surely_down = True, True
        for q in range(n_signs):
            low, high = signs[depth, q, 0], signs[depth, q, 0]
            for k in range(1, n):
                low, high = min(low, signs[depth, q, k]), max(high, signs[depth, q, k])
            least = -noise[q] if q < N_EDGES else noise[q]
            can_be_up &= high >= least
            can_be_down &= low <= -least
            surely_up &= low > noise[q]
            surely_down &= high < -noise[q]
        if surely_up or surely_down:
            return True
        if can_be_up or can_be_down:
            if depth == HALVINGS:
                return True
            _halve(signs, depth, n_signs, n)
            depth += 1
            halves &= ~(1 << depth)
            continue
        while depth > 0 and halves >> depth & 1:
            depth -= 1
        if depth == 0:
            return False
        halves |= 1 << depth
        _second_half(signs, depth, n_signs, n)


@jit
def _halve(signs, depth, n_signs, n):
    """Write the coefficients on the first half of level `depth` to the next."""
    for q in range(n_signs):
        for k in range(n):
            signs[depth + 1, q, k] = signs[depth, q, k]
        for m in range(n - 1):
            for k in range(n - 1, m, -1):
                signs[depth + 1, q, k] = 0.5 * (signs[depth + 1, q, k - 1] + signs[depth + 1, q, k])


@jit
def _second_half(signs, depth, n_signs, n):
    """Write the coefficients on the second half of the level before `depth` to it."""
    for q in range(n_signs):
        for k in range(n):
            signs[depth, q, k] = signs[depth - 1, q, k]
        for m in range(n - 1, 0, -1):
            for k in range(m):
                signs[depth, q, k] = 0.5 * (signs[depth, q, k] + signs[depth, q, k + 1])
