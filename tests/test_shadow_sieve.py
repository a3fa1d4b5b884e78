"""The compiled join of shadow pairs finds when which pairs block as the plain path does, and looks at fewer."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
import scene_makers as make
import torch
from test_shadows import SCENES, moving_lamps

import torchblur as tb
from torchblur import shadow_pairs, shadows
from torchblur.blocking import Receivers, when_blocked
from torchblur.casters import find_casters
from torchblur.lights import DirectionalLight
from torchblur.sort import SAME_TIME

LAMPS = {
    "point": lit.point(np.array([[0.3, -0.4, 2.0], [-0.2, 0.1, 1.6], [0.1, 0.3, 1.9]]), 9.0),
    "spot": lit.spot((0.2, 0.3, 2.2), (0, 0, 0), 5.0),
    "sun": lit.sun(np.array([[0.3, 0.2, -1], [-0.2, 0.4, -1]]), 1.5),
    "still sun": lit.sun((0.1, 0.2, -1)),
}


def every_pair(receivers: Receivers, casters) -> tuple[torch.Tensor, torch.Tensor]:
    i = torch.arange(receivers.count).repeat_interleave(casters.count)
    j = torch.arange(casters.count).repeat(receivers.count)
    keep = shadow_pairs._share_time(receivers, casters, i, j) & (receivers.face[i] != casters.face[j])
    return i[keep], j[keep]


def random_receivers(generator: np.random.Generator, n: int, instants: bool) -> Receivers:
    """Return points that move over random slices of time, seen through random weights; some touch casters' corners."""
    tensor = lambda a: torch.tensor(a, dtype=torch.float64)  # noqa: E731
    t = np.sort(generator.uniform(0, 1, (2, n)), axis=0)
    t[:, : n // 4] = [[0.0], [0.5]]
    t[1] = np.where(t[0] < 0.5, np.minimum(t[1], 0.5), t[1])  # the lamp has a knot there
    if instants:
        place, scale, t = generator.normal(size=(1, 3, n)), np.ones((1, n)), t[[0, 0]]
    else:
        place, scale = generator.normal(size=(4, 3, n)), generator.uniform(0.5, 2.0, (3, n))
        place[:, :, : n // 2] = place[:1, :, : n // 2] + 0.05 * place[:, :, : n // 2]  # nearly still ones
        scale[:, : n // 2] = 1.0
    rests = torch.arange(n) % 3 == 0
    return Receivers(*at_rest(rests, tensor(place), tensor(scale)), tensor(t), torch.full((n,), -1), rests)


def at_rest(rests: torch.Tensor, place: torch.Tensor, scale: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return places and scales of which those that rest do."""
    return torch.where(rests, place[:1], place), torch.where(rests, scale[:1], scale)


def random_lit(generator: np.random.Generator, k: int, kind: str, n_faces: int, instants: bool):
    """Return the light, receivers and casters of a random scene; in some, edges touch and corners meet."""
    soup = make.random_triangles(generator, n_faces, size=0.7, n_segments=1 + k % 3)
    vertices = soup.vertices if k % 2 else np.round(soup.vertices, 1)
    mesh = lit.LookMesh(vertices, soup.faces, color=soup.color)
    scene = lit.to_torch(lit.one_pixel(mesh, [LAMPS[kind]]), casts_shadows=True)
    casters, receivers = find_casters(scene), random_receivers(generator, 300, instants)
    if not k % 2:
        receivers.place.mul_(10).round_().div_(10)
    return scene.lights[0], receivers, casters


def merged(receiver, caster, start, end) -> np.ndarray:
    """Return (n, 4) rows in order, once each, those of a pair that touch made one."""
    rows = torch.stack([receiver.double(), caster.double(), start, end], dim=1).unique(dim=0).tolist()
    out = rows[:1]
    for row in rows[1:]:
        if row[:2] == out[-1][:2] and row[2] <= out[-1][3] + SAME_TIME:
            out[-1][3] = max(out[-1][3], row[3])
        else:
            out.append(row)
    return np.array(out).reshape(-1, 4)


def plainly(light, receivers: Receivers, casters, pairs) -> np.ndarray:
    """Return when pairs block, as tensors have it."""
    which, start, end = when_blocked(light, receivers, casters, pairs)
    return merged(*(p[which] for p in pairs), start, end)


def compiled(light, receivers: Receivers, casters) -> tuple[np.ndarray, int]:
    """Return when pairs block, as compiled code has it, and among how many, where no caster is opaque."""
    found, n = shadow_pairs.blocked_ranges(light, receivers, casters, torch.zeros(casters.count, dtype=torch.bool))
    return merged(*found), n


def assert_same_times(found: np.ndarray, expected: np.ndarray) -> None:
    """Compare ends of pieces; where polynomials all but touch 0 their roots magnify the rounding of another sum."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
    assert (np.abs(found - expected) > 1e-13).mean() < 0.01


@pytest.mark.parametrize("instants", [False, True])
@pytest.mark.parametrize("kind", list(LAMPS))
def test_no_pair_that_blocks_is_left_out(kind, instants):
    generator = np.random.default_rng(5)
    n_seen = n_blocked = n_all = 0
    for k in range(4):
        light, receivers, casters = random_lit(generator, k, kind, 40, instants)
        assert isinstance(light, DirectionalLight) == ("sun" in kind)
        pairs = every_pair(receivers, casters)
        every, (found, n) = plainly(light, receivers, casters, pairs), compiled(light, receivers, casters)
        np.testing.assert_array_equal(found[:, :2], every[:, :2])
        assert_same_times(found[:, 2:], every[:, 2:])
        n_all, n_seen, n_blocked = n_all + len(pairs[0]), n_seen + n, n_blocked + len(found)
    assert n_blocked > 50
    assert n_seen < 0.75 * n_all


@pytest.mark.parametrize("few", [0, 1 << 17])
def test_a_hundred_scenes_have_the_pairs_and_times_of_the_plain_path(few, monkeypatch):
    monkeypatch.setattr(shadow_pairs, "FEW_PAIRS", few)
    n_blocked = 0
    for k in range(100):
        kind = list(LAMPS)[k % 4]
        light, receivers, casters = random_lit(np.random.default_rng(k), k // 4, kind, 20, k % 5 == 0)
        pairs = shadow_pairs.together(list(shadow_pairs.candidate_pairs(light, receivers, casters)))
        plain, (found, n) = plainly(light, receivers, casters, pairs), compiled(light, receivers, casters)
        assert n == len(pairs[0])
        np.testing.assert_array_equal(found[:, :2], plain[:, :2])
        assert_same_times(found[:, 2:], plain[:, 2:])
        n_blocked += len(plain)
    assert n_blocked > 1000


def test_images_are_the_same_with_and_without_it(monkeypatch):
    scenes = [lit.to_torch(make_scene(), casts_shadows=True) for make_scene in (moving_lamps, SCENES["mirrored_soup"])]
    monkeypatch.setattr(shadows, "MANY", 1 << 60)
    plain = [tb.render(scene) for scene in scenes]
    monkeypatch.setattr(shadows, "MANY", 0)
    for scene, frame in zip(scenes, plain, strict=True):
        fast = tb.render(scene)
        torch.testing.assert_close(fast.rgba, frame.rgba, rtol=0, atol=1e-12)
        torch.testing.assert_close(fast.shadow, frame.shadow, rtol=0, atol=1e-12)
        assert 0 < fast.counts["shadow_pairs"] < frame.counts["shadow_pairs"]  # what is dark already is not looked at
        assert 0 < fast.counts["shadow_ranges"] <= frame.counts["shadow_ranges"]
