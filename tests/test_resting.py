"""Lit surfaces at rest under moving casters: points with shadows, as good as the paths that all else takes."""

from __future__ import annotations

import math

import pytest
import torch

import torchblur as tb
from torchblur import shadows
from torchblur.surfaces import build_surfaces

LAMPS = {
    "lamp": tb.PointLight((0.3, 2.5, 0.4), 20.0),
    "sun": tb.DirectionalLight((0.2, -1.0, 0.1), 3.0),
    "both": None,
    "spot that moves": tb.SpotLight([(0.0, 2.5, 0.4), (0.3, 2.5, 0.4)], (0, 0, 0), 20.0),
}
TWO = [[0, 1, 2], [0, 2, 3]]


def lamps(kind: str) -> list:
    """Return the lights of a kind."""
    return [LAMPS["lamp"], LAMPS["sun"]] if kind == "both" else [LAMPS[kind]]


def floor_scene(kind: str, opacity: float = 1.0, shift: float = 0.7) -> tb.Scene:
    """Return a textured lit floor and a step at rest, and a plate that turns and slides above them."""
    f64 = torch.float64
    floor = torch.tensor([[-2.0, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]], dtype=f64)
    step = torch.tensor([[-0.9, 0.3, 0.9], [-0.2, 0.3, 0.9], [-0.2, 0.3, -0.9], [-0.9, 0.3, -0.9]], dtype=f64)
    plate = torch.tensor([[-0.5, 0.9, 0.3], [0.3, 0.8, 0.4], [0.4, 1.0, -0.4], [-0.4, 0.9, -0.5]], dtype=f64)
    image = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0), dtype=f64)
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=f64)[torch.tensor(TWO)]
    turned = plate @ torch.tensor(
        [[math.cos(0.5), 0, math.sin(0.5)], [0, 1, 0], [-math.sin(0.5), 0, math.cos(0.5)]]
    ).to(f64)
    meshes = [
        tb.Mesh(floor, TWO, tb.Material(shading="lambert", texture=image), uv=uv),
        tb.Mesh(step, TWO, tb.Material((0.9, 0.5, 0.3), shading="lambert")),
        tb.Mesh(
            torch.stack([plate, turned + torch.tensor([shift, 0.0, 0.0], dtype=f64)]), TWO, tb.Material(opacity=opacity)
        ),
    ]
    camera = tb.Camera.look_at((0, 3.2, 3.0), (0, 0, 0), fov_y_deg=45, width=16, height=14, near=0.1, far=20)
    return tb.Scene(meshes, camera, (0.1, 0.1, 0.1), lights=lamps(kind), ambient=(0.05, 0.05, 0.05))


@pytest.mark.parametrize("many", [0, 1 << 60])
@pytest.mark.parametrize("opacity", [1.0, 0.4])
@pytest.mark.parametrize("kind", list(LAMPS))
def test_rest_is_as_good_as_paths(kind, opacity, many, monkeypatch):
    monkeypatch.setattr(shadows, "MANY", many)
    scene = floor_scene(kind, opacity)
    shutter = tb.Shutter.trapezoid(0.05, 0.3, 0.6, 0.9) if kind == "both" else None
    for memory_bytes in (1 << 28, 1 << 20)[: 1 + (kind == "both")]:
        options = {"shutter": shutter, "memory_bytes": memory_bytes}
        auto, every = (tb.render(scene, effects=effects, **options) for effects in ("auto", "all"))
        torch.testing.assert_close(auto.rgba, every.rgba, rtol=0, atol=1e-12 if kind != "spot that moves" else 1e-9)
        torch.testing.assert_close(auto.shadow, every.shadow, rtol=0, atol=1e-9)
        assert float(auto.shadow.min()) < 0.9


def test_what_rests_is_known():
    found = {kind: build_surfaces(floor_scene(kind)).rests.tolist() for kind in LAMPS}
    at_rest = [True] * 4 + [False] * 2
    assert found == {"lamp": at_rest, "sun": at_rest, "both": at_rest, "spot that moves": [False] * 6}
    assert not build_surfaces(floor_scene("lamp", shift=0.0)).rests[4:].any()
