"""The compiled survey of prisms says what the plain one does."""

from __future__ import annotations

import numpy as np
import pytest
import scene_makers as make
import torch

import torchblur as tb
from torchblur import survey
from torchblur.prisms import build_prisms
from torchblur.surfaces import build_surfaces


def random_scene(k: int) -> tb.Scene:
    """Return a few triangles that move in some pieces or rest, partly behind the eye or turning; apart in some."""
    generator = np.random.default_rng(k)
    meshes = []
    for m in range(3):
        soup = make.random_triangles(generator, 1 + k % 7, size=0.3 + 0.1 * (k % 5), n_segments=(k + m) % 4)
        vertices = torch.tensor(soup.vertices) + torch.tensor([0.0, 0.0, 1.5 * m if k % 3 else 0.0])
        material = tb.Material(opacity=1.0 if k % 2 else 0.5, double_sided=bool(k % 4))
        meshes.append(tb.Mesh(vertices[0] if len(vertices) == 1 else vertices, torch.tensor(soup.faces), material))
    eye = (0.3, 0.2, 0.5 + 0.1 * (k % 60))
    return tb.Scene(meshes, tb.Camera.look_at(eye, (0, 0, 0), fov_y_deg=50, width=24, height=16, near=0.1, far=8))


@pytest.mark.parametrize("grids", [survey.GRIDS, (1,)])
def test_two_hundred_scenes_are_surveyed_alike(grids, monkeypatch):
    monkeypatch.setattr(survey, "GRIDS", grids)
    seen = {"still": 0, "front": 0, "back": 0, "cross": 0, "apart": 0}
    for k in range(200):
        scene = random_scene(k)
        prisms = build_prisms(scene, build_surfaces(scene), (0.0, 1.0) if k % 5 else (0.1, 0.7))
        found = []
        for many in (0, 1 << 60):
            monkeypatch.setattr(survey, "MANY", many)
            found.append(survey.survey_prisms(prisms, (24, 16)))
        compiled, plain = found
        for name in ("is_still", "hides", "facing", "nearness"):
            torch.testing.assert_close(getattr(compiled, name), getattr(plain, name), rtol=1e-14, atol=0)
        assert compiled.may_cross == plain.may_cross
        seen["still"] += int(plain.is_still.sum())
        seen["front"] += int((plain.facing > 0).sum())
        seen["back"] += int((plain.facing < 0).sum())
        seen["cross" if plain.may_cross else "apart"] += 1
    assert min(seen.values()) > 15, seen
