"""The compiled join and sieve of shadow pairs leave out most pairs that do not block, and none that does."""

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
    return Receivers(tensor(place), tensor(scale), tensor(t), torch.full((n,), -1))


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


def sifted(light, receivers: Receivers, casters) -> tuple[tuple[torch.Tensor, torch.Tensor], int]:
    """Return the pairs that compiled code leaves, end to end, and among how many candidates."""
    parts = list(shadow_pairs.sifted_pairs(light, receivers, casters))
    return shadow_pairs.together([pairs for pairs, _ in parts]), sum(n for _, n in parts)


@pytest.mark.parametrize("instants", [False, True])
@pytest.mark.parametrize("kind", list(LAMPS))
def test_no_pair_that_blocks_is_left_out(kind, instants):
    generator = np.random.default_rng(5)
    n_kept = n_blocked = n_all = 0
    for k in range(4):
        light, receivers, casters = random_lit(generator, k, kind, 40, instants)
        assert isinstance(light, DirectionalLight) == ("sun" in kind)
        pairs = every_pair(receivers, casters)
        found = when_blocked(light, receivers, casters, pairs)
        kept, _ = sifted(light, receivers, casters)
        after = when_blocked(light, receivers, casters, kept)
        rows = torch.stack([*(p[found[0]].double() for p in pairs), *found[1:]], dim=1)
        rows_after = torch.stack([*(p[after[0]].double() for p in kept), *after[1:]], dim=1)
        assert set(map(tuple, rows.tolist())) == set(map(tuple, rows_after.tolist()))
        n_kept += torch.stack(kept).unique(dim=1).shape[1]  # the sides of a cube share some
        n_all, n_blocked = n_all + len(pairs[0]), n_blocked + len(found[0].unique())
    assert n_blocked > 50
    assert n_blocked <= n_kept < 1.5 * n_blocked
    assert n_kept < 0.5 * n_all


@pytest.mark.parametrize("few", [0, 1 << 17])
def test_a_hundred_scenes_have_the_pairs_of_the_plain_path_in_its_order(few, monkeypatch):
    monkeypatch.setattr(shadow_pairs, "FEW_PAIRS", few)
    n_blocked = 0
    for k in range(100):
        kind = list(LAMPS)[k % 4]
        light, receivers, casters = random_lit(np.random.default_rng(k), k // 4, kind, 20, k % 5 == 0)
        plain = shadow_pairs.together(list(shadow_pairs.candidate_pairs(light, receivers, casters)))
        kept, n = sifted(light, receivers, casters)
        assert n == len(plain[0])
        rows = []
        for pairs in (plain, kept):
            which, start, end = when_blocked(light, receivers, casters, pairs)
            times = torch.stack([*(p[which].double() for p in pairs), start, end], dim=1)
            rows.append((torch.stack(pairs)[:, which.unique()].tolist(), times.tolist()))
        assert rows[0] == rows[1]
        n_blocked += len(rows[0][0][0])
    assert n_blocked > 1000


def test_images_are_the_same_with_and_without_it(monkeypatch):
    scenes = [lit.to_torch(make_scene(), casts_shadows=True) for make_scene in (moving_lamps, SCENES["mirrored_soup"])]
    monkeypatch.setattr(shadows, "MANY", 1 << 60)
    plain = [tb.render(scene) for scene in scenes]
    monkeypatch.setattr(shadows, "MANY", 0)
    for scene, frame in zip(scenes, plain, strict=True):
        compiled = tb.render(scene)
        torch.testing.assert_close(compiled.rgba, frame.rgba, rtol=0, atol=1e-12)
        torch.testing.assert_close(compiled.shadow, frame.shadow, rtol=0, atol=1e-12)
        assert compiled.counts["shadow_pairs"] == frame.counts["shadow_pairs"]
        assert compiled.counts["shadow_ranges"] == frame.counts["shadow_ranges"] > 0
