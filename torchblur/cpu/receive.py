"""What light falls on along the rays, and what reaches it: receivers for shadows.py, and the ranges that it finds.

Before: curves.py, shadows.py.  After: bends.py, panels.py, expose.py, visibility.py.
Symbols as in curves.py; K receivers: lit layers of spans, and of cells in which nothing varies, which are looked at at
an instant; R ranges of time in which a lamp is blocked.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchblur.blocking import Receivers
from torchblur.cpu.curves import SQUARE, VARYING, Span, dot_of
from torchblur.cpu.jit import inlined, inner
from torchblur.cpu.lambert import DIRECTIONAL, Lit
from torchblur.shadows import NOTHING, Shadows
from torchblur.surfaces import Surfaces


class Received(NamedTuple):
    """Places that light falls on, over slices of time or at instants."""

    place: np.ndarray  # (room, 4, 3) coefficients of S times the place
    scale: np.ndarray  # (room, 3) of S, which is above 0
    t: np.ndarray  # (room, 2) shutter times
    face: np.ndarray  # (room,) int64
    rests: np.ndarray  # (room,) bool
    due: np.ndarray  # (room, lamps) bool: False where the surface faces away from the lamp at all times
    count: np.ndarray  # (1,) int64


class Shade(NamedTuple):
    """When lamps are blocked."""

    n_receivers: int  # 0 where nothing casts shadows
    first: np.ndarray  # (lamps, K + 1) int64 first range of each receiver
    start: np.ndarray  # (R,) share of the receiver's time
    end: np.ndarray  # (R,)
    alpha: np.ndarray  # (R,) opacity of what blocks


@inner
def make_received(n: int, n_lamps: int) -> Received:
    """Return room for so many receivers under so many lamps."""
    numbers = np.empty((n, 4, 3)), np.empty((n, 3)), np.empty((n, 2))
    return Received(
        *numbers, np.empty(n, np.int64), np.empty(n, np.bool_), np.empty((n, n_lamps), np.bool_), np.zeros(1, np.int64)
    )


@inner
def with_room(received: Received) -> Received:
    """Return the receivers with room for one more."""
    n = received.count[0]
    if n < len(received.face):
        return received
    more = make_received(2 * n, received.due.shape[1])
    for i in range(n):  # slices take seconds to compile
        more.face[i], more.rests[i], more.t[i, 0], more.t[i, 1] = (
            received.face[i],
            received.rests[i],
            received.t[i, 0],
            received.t[i, 1],
        )
        for d in range(3):
            more.scale[i, d] = received.scale[i, d]
            for k in range(4):
                more.place[i, k, d] = received.place[i, k, d]
        for lamp in range(received.due.shape[1]):
            more.due[i, lamp] = received.due[i, lamp]
    more.count[0] = n
    return more


@inlined
def receive(span: Span, m: int, lit: Lit, times: tuple[float, float], received: Received) -> None:
    """Append a lit layer of a span between shutter times; one that does not vary stays where it is in the middle."""
    n = received.count[0]
    received.count[0] = n + 1
    scale, place = span.scale[m], span.place[m]
    sign = np.sign(scale[0] + scale[1] + scale[2])
    rests = span.flags[m] & VARYING == 0
    received.t[n, 0], received.t[n, 1] = times
    received.face[n], received.rests[n] = span.face[m], rests
    middle = 0.25 * (scale[0] + 2 * scale[1] + scale[2])
    for d in range(3):
        if rests:
            point = 0.125 * (place[d, 0] + 3 * (place[d, 1] + place[d, 2]) + place[d, 3]) / middle
            for k in range(4):
                received.place[n, k, d] = point
            received.scale[n, d] = 1.0
            continue
        for k in range(4):
            received.place[n, k, d] = sign * place[d, k]
        received.scale[n, d] = sign * scale[d]
    normal = span.normal[m]
    for lamp in range(len(lit.kind)):
        vector = span.vector[m, lamp]
        side = span.side[m, 1 if lit.kind[lamp] == DIRECTIONAL else 0]
        cosine, is_due = span.room[SQUARE], False
        dot_of(normal, vector, cosine)
        for k in range(7):
            is_due |= side * cosine[k] > 0
        received.due[n, lamp] = is_due


@inlined
def visible_at(shade: Shade, lamp: int, receiver: int, tau: float) -> float:
    """Return the share of a lamp that reaches a receiver at a share of its time."""
    left = 1.0
    if shade.n_receivers > 0:
        for r in range(shade.first[lamp, receiver], shade.first[lamp, receiver + 1]):
            if shade.start[r] <= tau and tau < shade.end[r]:
                left *= 1 - shade.alpha[r]
    return left


def no_shade() -> Shade:
    """Return that nothing casts shadows. Source: ours."""
    nothing = np.zeros(0)
    return Shade(0, np.zeros((0, 0), dtype=np.int64), nothing, nothing, nothing)


def as_receivers(parts: Sequence[Received], are_instants: bool) -> tuple[Receivers, tuple[Tensor, ...]]:
    """Return receivers end to end, and lamp by lamp (K,) whether its light is due. Source: ours."""

    def cat(name: str) -> Tensor:
        return torch.from_numpy(np.concatenate([getattr(p, name)[: p.count[0]] for p in parts]))

    place, scale, t = cat("place").permute(1, 2, 0), cat("scale").T, cat("t").T
    if are_instants:
        place, scale = place[:1], scale[:1]
    due = cat("due")
    return Receivers(place, scale, t, cat("face"), cat("rests")), due.unbind(1)


def as_shade(surfaces: Surfaces, n_receivers: int, shadows: Shadows) -> Shade:
    """Return the ranges of shadows for compiled code. Source: ours."""
    first, starts, ends, alphas, before = [], [], [], [], 0
    for ranges in shadows.ranges:
        if ranges is None:
            first.append(np.full(n_receivers + 1, before, dtype=np.int64))
            continue
        first.append(ranges.offsets.numpy() + before)
        before += len(ranges.start)
        face = surfaces.casters.face[ranges.caster.clamp(min=0)]
        alphas.append(torch.where(ranges.caster == NOTHING, 1.0, surfaces.opacity.detach()[face]).numpy())
        starts.append(ranges.start.numpy())
        ends.append(ranges.end.numpy())
    parts = (np.concatenate(p) if p else np.zeros(0) for p in (starts, ends, alphas))
    return Shade(n_receivers, np.stack(first), *parts)
