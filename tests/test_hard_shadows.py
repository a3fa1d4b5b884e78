"""Shadows where they are easily lost: faces that touch or share a plane, lights close by, knots of their own."""

from __future__ import annotations

import math

import lit_scenes as lit
import numpy as np
import pytest
from oracle_looks import LookMesh, LookScene

import torchblur as tb

FLOOR = np.array([[-5.0, -5, -1], [5, -5, -1], [5, 6, -1], [-5, 6, -1]])  # its diagonal misses the centre
PLATE = np.array([[-1.0, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]])
SUN = lit.sun((0, 0, -1), math.pi)
UP = np.array([0.0, 0, 1])


def quad(corners, **material) -> LookMesh:
    """Return a white square that a viewer above sees."""
    return LookMesh(np.asarray(corners, dtype=float), [[0, 1, 2], [0, 2, 3]], color=(1.0, 1.0, 1.0), **material)


def unseen(corners) -> LookMesh:
    """Return a square that casts, and of which a viewer above sees nothing."""
    return LookMesh(np.asarray(corners, dtype=float), [[2, 1, 0], [3, 2, 0]], double_sided=False)


def shadow_of(meshes, *lights, n=1) -> np.ndarray:
    """Return the share of the light that no shadow takes away, seen from above."""
    plain = LookScene(meshes, lit.UPRIGHT, n, n, lights=list(lights))
    return tb.render(lit.to_torch(plain, casts_shadows=True)).shadow.numpy()


def test_what_leaves_the_plane_of_the_floor_at_its_own_knot_casts_from_then_on():
    """A plate lies in the floor until 1/2, then rises; nothing else has a knot there."""
    late = np.stack([PLATE, PLATE, PLATE + UP])
    assert shadow_of([quad(FLOOR), unseen(late)], SUN) == pytest.approx(0.5, abs=1e-4)  # casters.GAP after it left
    fast = np.stack([PLATE, PLATE + UP, PLATE + 2 * UP])  # as far in each half as the floor in the whole
    assert shadow_of([quad(np.stack([FLOOR, FLOOR + UP])), unseen(fast)], SUN) == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("lamp", [SUN, lit.point((0, 0, 3), 5.0)], ids=["sun", "point"])
def test_what_is_far_away_takes_no_shadow_off_what_is_near(lamp):
    """A plate a thousandth over the floor keeps its shadow beside a far triangle, on a huge floor, and far away."""
    plate = unseen(PLATE + 0.001 * UP)
    far = LookMesh(np.array([[2000.0, 0, 0], [2000, 1, 0], [2000, 0, 1]]), [[0, 1, 2]])
    assert shadow_of([quad(FLOOR), plate, far], lamp) == pytest.approx(0)
    assert shadow_of([quad(FLOOR * [2000, 2000, 1]), plate], lamp) == pytest.approx(0)
