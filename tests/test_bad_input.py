"""Every public constructor and function refuses wrong arguments with `name: expected …, got …` before any work."""

from __future__ import annotations

import numpy as np
import pytest
import scene_makers as make
import torch
from oracles import PlainScene

import torchblur as tb

CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
VERTICES = torch.tensor(CORNERS)
FACES = torch.tensor([[0, 1, 2]])
EYE4 = torch.eye(4, dtype=torch.float64)
NAN, INF = float("nan"), float("inf")
LOOK = {"eye": (0, 0, 5), "target": (0, 0, 0), "fov_y_deg": 40, "width": 4, "height": 3, "near": 0.1, "far": 10}
ORTHO = {"eye": (0, 0, 5), "target": (0, 0, 0), "height_world": 2, "width": 4, "height": 3, "near": 0.1, "far": 10}


def camera() -> tb.Camera:
    """Return a small camera."""
    return tb.Camera(EYE4, 4, 3)


def scene() -> tb.Scene:
    """Return a small scene."""
    return tb.Scene([tb.Mesh(VERTICES, FACES)], camera())


def with_value(tensor: torch.Tensor, value: float) -> torch.Tensor:
    """Return a copy whose last entry is `value`."""
    out = tensor.clone()
    out.reshape(-1)[-1] = value
    return out


def look(**changes) -> tb.Camera:
    """Return a look-at camera with some arguments changed."""
    return tb.Camera.look_at(**(LOOK | changes))


def ortho(**changes) -> tb.Camera:
    """Return an orthographic camera with some arguments changed."""
    return tb.Camera.orthographic(**(ORTHO | changes))


def on_meta() -> tb.Mesh:
    """Return a mesh on a device that is not the camera's."""
    mesh = tb.Mesh(VERTICES, FACES)
    object.__setattr__(mesh, "vertices", VERTICES.to("meta"))
    object.__setattr__(mesh, "faces", FACES.to("meta"))
    return mesh


BAD = {
    # Mesh
    "vertices": {
        "flat": lambda: tb.Mesh(torch.zeros(9), FACES),
        "two columns": lambda: tb.Mesh(torch.zeros(3, 2), FACES),
        "four axes": lambda: tb.Mesh(torch.zeros(1, 2, 3, 3), FACES),
        "one knot": lambda: tb.Mesh(VERTICES[None], FACES),
        "no knot": lambda: tb.Mesh(torch.zeros(0, 3, 3), FACES),
        "integers": lambda: tb.Mesh(torch.zeros(3, 3, dtype=torch.int64), FACES),
        "half": lambda: tb.Mesh(VERTICES.half(), FACES),
        "complex": lambda: tb.Mesh(VERTICES.to(torch.complex64), FACES),
        "nan": lambda: tb.Mesh(with_value(VERTICES, NAN), FACES),
        "inf": lambda: tb.Mesh(with_value(VERTICES, INF), FACES),
        "text": lambda: tb.Mesh("cube.obj", FACES),
        "none": lambda: tb.Mesh(None, FACES),
        "big-endian": lambda: tb.Mesh(np.array(CORNERS, dtype=">f4"), FACES),
    },
    "faces": {
        "too large": lambda: tb.Mesh(VERTICES, [[0, 1, 3]]),
        "negative": lambda: tb.Mesh(VERTICES, [[0, 1, -1]]),
        "quads": lambda: tb.Mesh(VERTICES, torch.zeros(1, 4, dtype=torch.int64)),
        "flat": lambda: tb.Mesh(VERTICES, torch.tensor([0, 1, 2])),
        "floats": lambda: tb.Mesh(VERTICES, FACES.float()),
        "bool": lambda: tb.Mesh(VERTICES, torch.ones(1, 3, dtype=torch.bool)),
        "float lists": lambda: tb.Mesh(VERTICES, [[0.0, 1.0, 2.0]]),
        "no vertices": lambda: tb.Mesh(torch.zeros(0, 3), FACES),
    },
    "material": {
        "colour instead": lambda: tb.Mesh(VERTICES, FACES, (1, 0, 0)),
        "none": lambda: tb.Mesh(VERTICES, FACES, None),
    },
    "name": {"number": lambda: tb.Mesh(VERTICES, FACES, name=3)},
    # Material
    "color": {
        "negative": lambda: tb.Material((-0.1, 0, 0)),
        "four": lambda: tb.Material((1, 0, 0, 1)),
        "nan": lambda: tb.Material((NAN, 0, 0)),
        "inf": lambda: tb.Material((INF, 0, 0)),
        "text": lambda: tb.Material("red"),
        "bytes": lambda: tb.Material(torch.zeros(3, dtype=torch.uint8)),
        "not one a face": lambda: tb.Mesh(VERTICES, FACES, tb.Material(torch.ones(2, 3))),
    },
    "opacity": {
        "above one": lambda: tb.Material(opacity=1.5),
        "below zero": lambda: tb.Material(opacity=-0.1),
        "nan": lambda: tb.Material(opacity=NAN),
        "matrix": lambda: tb.Material(opacity=torch.ones(1, 1)),
        "text": lambda: tb.Material(opacity="half"),
        "not one a face": lambda: tb.Mesh(VERTICES, FACES, tb.Material(opacity=torch.ones(2))),
    },
    "double_sided": {"number": lambda: tb.Material(double_sided=1)},
    # Camera
    "world_to_clip": {
        "3x3": lambda: tb.Camera(torch.eye(3), 4, 3),
        "one knot": lambda: tb.Camera(EYE4[None], 4, 3),
        "integers": lambda: tb.Camera(torch.eye(4, dtype=torch.int64), 4, 3),
        "nan": lambda: tb.Camera(with_value(EYE4, NAN), 4, 3),
        "inf": lambda: tb.Camera(with_value(EYE4, INF), 4, 3),
        "w is zero": lambda: tb.Camera(torch.diag(torch.tensor([1.0, 1, 1, 0])), 4, 3),
    },
    "width": {
        "zero": lambda: tb.Camera(EYE4, 0, 3),
        "negative": lambda: tb.Camera(EYE4, -4, 3),
        "float": lambda: tb.Camera(EYE4, 4.0, 3),
        "bool": lambda: tb.Camera(EYE4, True, 3),
        "huge": lambda: tb.Camera(EYE4, 1 << 40, 3),
        "look_at": lambda: look(width=0),
        "orthographic": lambda: ortho(width=2.5),
    },
    "height": {"zero": lambda: tb.Camera(EYE4, 4, 0), "text": lambda: tb.Camera(EYE4, 4, "3")},
    "fov_y_deg": {
        "zero": lambda: look(fov_y_deg=0),
        "flat": lambda: look(fov_y_deg=180),
        "nan": lambda: look(fov_y_deg=NAN),
        "text": lambda: look(fov_y_deg="wide"),
    },
    "near": {
        "zero": lambda: look(near=0),
        "negative": lambda: look(near=-1),
        "inf": lambda: look(near=INF),
        "orthographic": lambda: ortho(near=NAN),
    },
    "far": {
        "before near": lambda: look(far=0.05),
        "equal": lambda: look(far=0.1),
        "inf": lambda: look(far=INF),
        "orthographic": lambda: ortho(far=0.1),
    },
    "eye": {"two": lambda: look(eye=(0, 0)), "nan": lambda: look(eye=(NAN, 0, 1)), "text": lambda: look(eye="here")},
    "target": {"is the eye": lambda: look(target=(0, 0, 5)), "shape": lambda: look(target=torch.zeros(2, 2))},
    "up": {"along the view": lambda: look(up=(0, 0, 1)), "zero": lambda: look(up=(0, 0, 0))},
    "eye, target, up": {
        "knots": lambda: look(eye=torch.rand(3, 3) + 2, target=torch.rand(4, 3)),
        "one knot": lambda: look(eye=torch.ones(1, 3)),
    },
    "height_world": {"zero": lambda: ortho(height_world=0), "negative": lambda: ortho(height_world=-2)},
    # Scene
    "meshes": {
        "one mesh": lambda: tb.Scene(tb.Mesh(VERTICES, FACES), camera()),
        "tensors": lambda: tb.Scene([VERTICES], camera()),
        "none": lambda: tb.Scene(None, camera()),
    },
    "camera": {"matrix": lambda: tb.Scene([], EYE4), "none": lambda: tb.Scene([], None)},
    "background": {
        "four": lambda: tb.Scene([], camera(), (0, 0, 0, 1)),
        "wrong size": lambda: tb.Scene([], camera(), torch.zeros(4, 3, 3)),
        "channels first": lambda: tb.Scene([], camera(), torch.zeros(3, 3, 4)),
        "negative": lambda: tb.Scene([], camera(), (-1, 0, 0)),
        "nan": lambda: tb.Scene([], camera(), (NAN, 0, 0)),
        "bytes": lambda: tb.Scene([], camera(), torch.zeros(3, 4, 3, dtype=torch.uint8)),
    },
    "devices": {"two": lambda: tb.Scene([on_meta()], camera())},
    # Shutter and Accuracy
    "t_open": {
        "below": lambda: tb.Shutter.box(-0.1, 1),
        "nan": lambda: tb.Shutter.box(NAN, 1),
        "text": lambda: tb.Shutter.box("0", 1),
    },
    "t_close": {
        "above": lambda: tb.Shutter.box(0, 1.1),
        "empty": lambda: tb.Shutter.box(0.5, 0.5),
        "backwards": lambda: tb.Shutter.box(0.6, 0.5),
    },
    "transmittance_cutoff": {
        "negative": lambda: tb.Accuracy.exact(transmittance_cutoff=-0.1),
        "above one": lambda: tb.Accuracy.exact(transmittance_cutoff=1.5),
        "one": lambda: tb.Accuracy.exact(transmittance_cutoff=1.0),
        "nan": lambda: tb.Accuracy.exact(transmittance_cutoff=NAN),
    },
    # functions
    "scene": {
        "render": lambda: tb.render([VERTICES]),
        "instant": lambda: tb.render_instant(None),
        "accumulate": lambda: tb.accumulate("scene"),
        "motion_to": lambda: tb.motion_to(tb.render_instant(scene()), None, 0.5),
        "motion_to other size": lambda: tb.motion_to(
            tb.render_instant(scene()), tb.Scene([tb.Mesh(VERTICES, FACES)], tb.Camera(EYE4, 5, 3)), 0.5
        ),
        "motion_to fewer meshes": lambda: tb.motion_to(tb.render_instant(scene()), tb.Scene([], camera()), 0.5),
    },
    "accuracy": {"number": lambda: tb.render(scene(), accuracy=0.1)},
    "shutter": {
        "pair": lambda: tb.render(scene(), shutter=(0, 1)),
        "accumulate": lambda: tb.accumulate(scene(), shutter=(0, 1)),
    },
    "rays_per_pixel": {
        "zero": lambda: tb.render(scene(), rays_per_pixel=0),
        "float": lambda: tb.render(scene(), rays_per_pixel=4.0),
        "instant": lambda: tb.render_instant(scene(), rays_per_pixel=-1),
        "accumulate": lambda: tb.accumulate(scene(), times=2, rays_per_pixel=0),
        "huge": lambda: tb.render(scene(), rays_per_pixel=10**9),
    },
    "memory_bytes": {
        "zero": lambda: tb.render(scene(), memory_bytes=0),
        "float": lambda: tb.render(scene(), memory_bytes=1e9),
        "tiny": lambda: tb.render(scene(), memory_bytes=10),
    },
    "t": {
        "below": lambda: tb.render_instant(scene(), t=-0.1),
        "above": lambda: tb.render_instant(scene(), t=1.01),
        "nan": lambda: tb.render_instant(scene(), t=NAN),
        "text": lambda: tb.render_instant(scene(), t="0"),
        "motion_to": lambda: tb.motion_to(tb.render_instant(scene()), scene(), 2.0),
    },
    "now": {"frame": lambda: tb.motion_to(tb.render(scene()), scene(), 0.5)},
    "times": {"zero": lambda: tb.accumulate(scene(), times=0), "float": lambda: tb.accumulate(scene(), times=8.0)},
}
ROWS = [(name, case, call) for name, cases in BAD.items() for case, call in cases.items()]


@pytest.mark.parametrize(("name", "case", "call"), ROWS, ids=[f"{n}-{c}" for n, c, _ in ROWS])
def test_is_refused_by_name(name, case, call):
    with pytest.raises((ValueError, TypeError)) as error:
        call()
    first, found, rest = str(error.value).partition(": expected ")
    assert found, f"{case}: {error.value}"
    assert first.replace("meshes[0].", "").replace("scene.", "") == name
    assert ", got " in rest, f"{case}: {error.value}"
    assert rest.partition(", got ")[2].strip(), f"{case}: what was found is not said: {error.value}"


def test_large_arrays_must_be_on_the_scene_device():
    mesh = tb.Mesh(VERTICES, FACES)
    object.__setattr__(mesh.material, "color", torch.ones(1, 3, device="meta"))
    with pytest.raises(ValueError, match=r"meshes\[0\]\.material\.color: expected a tensor on cpu, got .* on meta"):
        tb.Scene([mesh], camera())


def test_fewer_faces_than_in_the_instant_are_refused():
    quad = make.quad(-1, 1, -1, 1, 0)
    now = tb.render_instant(make.to_torch(PlainScene([quad], make.IDENTITY, 4, 4)))
    one = tb.Scene([tb.Mesh(torch.tensor(quad.vertices), [[0, 1, 2]])], tb.Camera(EYE4, 4, 4))
    with pytest.raises(ValueError, match=r"meshes\[0\]: expected at least 2 faces"):
        tb.motion_to(now, one, 0.5)


def test_good_input_of_other_kinds_is_accepted():
    """Lists, arrays, read-only and strided arrays, narrow integers, single numbers: nothing here may be refused."""
    read_only = np.array(CORNERS)
    read_only.setflags(write=False)
    strided = np.array([CORNERS, CORNERS])[:, ::-1]
    for vertices in (CORNERS, read_only, strided, VERTICES.T.contiguous().T, VERTICES.double()):
        for faces in ([[0, 1, 2]], np.array([[0, 1, 2]], dtype=np.int32), FACES.to(torch.uint8), FACES.int()):
            mesh = tb.Mesh(vertices, faces, tb.Material(color=[0.5, 0.25, 2.0], opacity=1))
            frame = tb.render(tb.Scene([mesh], camera(), [0.0, 0.5, 1.0]))
            assert torch.isfinite(frame.rgba).all()


def test_arguments_are_not_changed():
    vertices, faces = VERTICES.clone(), FACES.clone()
    tb.render(tb.Scene([tb.Mesh(vertices, faces)], camera()))
    assert torch.equal(vertices, VERTICES)
    assert torch.equal(faces, FACES)
