"""Wrong lights, normals and looks are refused with `name: expected …, got …`; right ones of any kind are taken."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchblur as tb

CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
FACES = [[0, 1, 2]]
UP = [[0.0, 0.0, 1.0]] * 3
MOVING = torch.tensor([CORNERS, CORNERS])
CAMERA = tb.Camera(torch.eye(4), 2, 2)
NAN, INF = float("nan"), float("inf")
ANGLES = {"inner_angle_deg": 25.0, "outer_angle_deg": 25.0}


def mesh(normals, vertices=CORNERS) -> tb.Mesh:
    """Return a triangle with these normals."""
    return tb.Mesh(vertices, FACES, normals=normals)


def point(position=(0.0, 0, 1), intensity=1.0) -> tb.PointLight:
    """Return a point light with an argument changed."""
    return tb.PointLight(position, intensity)


def spot(position=(0.0, 0, 1), target=(0.0, 0, 0), intensity=1.0, inner=10.0, outer=20.0) -> tb.SpotLight:
    """Return a spot light with an argument changed."""
    return tb.SpotLight(position, target, intensity, inner_angle_deg=inner, outer_angle_deg=outer)


def sun(direction=(0.0, 0, -1), irradiance=1.0) -> tb.DirectionalLight:
    """Return a directional light with an argument changed."""
    return tb.DirectionalLight(direction, irradiance)


def scene(**options) -> tb.Scene:
    """Return a scene with options."""
    return tb.Scene([tb.Mesh(CORNERS, FACES)], CAMERA, **options)


def bad_vectors(make) -> dict:
    """Return calls with what neither (3,) nor (K+1, 3) floats are."""
    return {
        "two numbers": lambda: make((0.0, 1.0)),
        "one knot": lambda: make([(0.0, 0, 1)]),
        "no knot": lambda: make(torch.zeros(0, 3)),
        "three axes": lambda: make(torch.ones(2, 1, 3)),
        "nan": lambda: make((0.0, NAN, 1)),
        "inf": lambda: make([(0.0, 0, 1), (0.0, 0, INF)]),
        "integers": lambda: make(torch.tensor([0, 0, 1])),
        "text": lambda: make("up"),
        "none": lambda: make(None),
    }


def bad_powers(make) -> dict:
    """Return calls with what neither a number nor RGB is."""
    return {
        "two numbers": lambda: make((1.0, 1.0)),
        "knots": lambda: make(torch.ones(2, 3)),
        "nan": lambda: make(NAN),
        "inf": lambda: make((1.0, INF, 1.0)),
        "text": lambda: make("bright"),
        "none": lambda: make(None),
    }


BAD = {
    "normals": {
        "too few": lambda: mesh(UP[:2]),
        "too many": lambda: mesh([*UP, *UP]),
        "flat": lambda: mesh(torch.ones(9)),
        "two columns": lambda: mesh(torch.ones(3, 2)),
        "moving on a still mesh": lambda: mesh(torch.ones(2, 3, 3)),
        "other knots": lambda: mesh(torch.ones(3, 3, 3), MOVING),
        "one knot": lambda: mesh(torch.ones(1, 3, 3), MOVING),
        "zero": lambda: mesh([*UP[:2], [0.0, 0.0, 0.0]]),
        "zero at a knot": lambda: mesh(
            torch.stack([torch.ones(3, 3), torch.eye(3) * torch.tensor([1.0, 1, 0])]), MOVING
        ),
        "nan": lambda: mesh([*UP[:2], [0.0, NAN, 1.0]]),
        "inf": lambda: mesh([*UP[:2], [0.0, INF, 1.0]]),
        "integers": lambda: mesh(torch.ones(3, 3, dtype=torch.int64)),
        "text": lambda: mesh("smooth"),
    },
    "position": bad_vectors(point),
    "position of a spot": bad_vectors(spot),
    "target": bad_vectors(lambda v: spot(target=v))
    | {
        "the position": lambda: spot((0.0, 0, 1), (0.0, 0, 1)),
        "the position at a knot": lambda: spot((0.0, 0, 1), [(0.0, 0, 0), (0.0, 0, 1)]),
    },
    "direction": bad_vectors(sun)
    | {"zero": lambda: sun((0.0, 0, 0)), "zero at a knot": lambda: sun([(0.0, 0, 1), (0.0, 0, 0)])},
    "intensity": bad_powers(lambda v: point(intensity=v)),
    "intensity of a spot": bad_powers(lambda v: spot(intensity=v)),
    "irradiance": bad_powers(lambda v: sun(irradiance=v)),
    "inner_angle_deg": {
        "above outer": lambda: spot(inner=30.0, outer=20.0),
        "negative": lambda: spot(inner=-1.0),
        "nan": lambda: spot(inner=NAN),
        "text": lambda: spot(inner="10"),
    },
    "outer_angle_deg": {
        "zero": lambda: spot(inner=0.0, outer=0.0),
        "negative": lambda: spot(inner=-20.0, outer=-10.0),
        "obtuse": lambda: spot(outer=90.5),
        "half a turn": lambda: spot(outer=180.0),
        "nan": lambda: spot(outer=NAN),
        "none": lambda: spot(outer=None),
    },
    "lights": {
        "one light": lambda: scene(lights=point()),
        "a mesh": lambda: scene(lights=[tb.Mesh(CORNERS, FACES)]),
        "a number": lambda: scene(lights=[1.0]),
        "none": lambda: scene(lights=None),
    },
    "ambient": {
        "two numbers": lambda: scene(ambient=(1.0, 1.0)),
        "an image": lambda: scene(ambient=torch.ones(2, 2, 3)),
        "nan": lambda: scene(ambient=(0.0, NAN, 0.0)),
        "text": lambda: scene(ambient="sky"),
        "none": lambda: scene(ambient=None),
    },
    "shading": {
        "unknown": lambda: tb.Material(shading="phong"),
        "none": lambda: tb.Material(shading=None),
        "upper case": lambda: tb.Material(shading="Lambert"),
    },
    "mipmap": {
        "a number": lambda: tb.Material(mipmap=1),
        "text": lambda: tb.Material(mipmap="yes"),
        "none": lambda: tb.Material(mipmap=None),
    },
}
ROWS = [(name, case, call) for name, cases in BAD.items() for case, call in cases.items()]


@pytest.mark.parametrize(("name", "case", "call"), ROWS, ids=[f"{n}-{c}" for n, c, _ in ROWS])
def test_is_refused_by_name(name, case, call):
    with pytest.raises((ValueError, TypeError)) as error:
        call()
    first, found, rest = str(error.value).partition(": expected ")
    assert found, f"{case}: {error.value}"
    names = ("inner_angle_deg", "outer_angle_deg") if "angle" in name else (name.split()[0],)
    assert any(n in first for n in names), f"{case}: {error.value}"
    assert rest.partition(", got ")[2].strip(), f"{case}: what was found is not said: {error.value}"


def test_looks_are_given_by_name():
    with pytest.raises(TypeError):
        tb.Material((1.0, 1.0, 1.0), 1.0, True)
    with pytest.raises(TypeError):
        tb.SpotLight((0.0, 0, 1), (0.0, 0, 0), 1.0, 10.0, 20.0)
    with pytest.raises(TypeError):
        tb.Scene([], CAMERA, (0.0, 0, 0), [point()])


@pytest.mark.parametrize("kind", [list, tuple, np.array, torch.tensor])
def test_good_input_of_many_kinds_is_taken(kind):
    """Numbers and RGB, still places and any number of knots, one light or none: nothing here may be refused."""
    up, way = kind(UP), kind([[0.0, 0, 1], [0.5, 0, 1], [0.5, 0.5, 1], [0.0, 0, 2]])
    lights = [
        tb.PointLight(kind([0.0, 0, 1]), 2),
        tb.PointLight(way, kind([1.0, 2.0, 3.0])),
        tb.SpotLight(way, kind([[0.0, 0, 0], [0.0, 0.1, 0]]), 1.5, inner_angle_deg=0, outer_angle_deg=45),
        tb.SpotLight(kind([0.0, 0, 1]), kind([0.1, 0, 0]), 0.0, **ANGLES),
        tb.DirectionalLight(way, 1.0),
        tb.DirectionalLight(kind([0.0, 0, -9]), kind([0.0, 1.0, 2.0])),
    ]
    material = tb.Material(shading="lambert", mipmap=False)
    meshes = [tb.Mesh(CORNERS, FACES, material, normals=up), tb.Mesh(MOVING, FACES, material, normals=up)]
    for chosen in ((), lights[:1], tuple(lights)):
        frame = tb.render(tb.Scene(meshes, CAMERA, lights=chosen, ambient=kind([0.1, 0.2, 0.3])))
        assert torch.isfinite(frame.rgba).all()
