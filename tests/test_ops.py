"""`render_meshes` is an operator in torch's own terms: same images as `render`, gradients of the plain path, traced."""

from __future__ import annotations

import pytest
import torch

import torchblur as tb

VIEW = [torch.eye(4), torch.tensor([0.1, 0.2, 0.3])]


def meshes(dtype=torch.float32, requires_grad=False):
    """Return two half-hidden triangles, of which one moves, as tensors."""
    start = torch.tensor([[-0.7, -0.6, 0.1], [0.6, -0.5, 0.0], [0.1, 0.7, -0.1]], dtype=dtype)
    rest = torch.tensor([[-0.5, -0.8, 0.3], [0.8, -0.1, 0.2], [-0.3, 0.6, 0.4]], dtype=dtype)
    move = torch.stack([start, start + torch.tensor([0.3, 0.1, 0.05], dtype=dtype)])
    floats = [move, rest, torch.tensor([0.9, 0.4, 0.2], dtype=dtype), torch.tensor([[0.2, 0.5, 0.8]], dtype=dtype)]
    floats += [torch.tensor(0.6, dtype=dtype), torch.tensor([1.0], dtype=dtype)]
    first, second, red, blue, half, whole = (t.requires_grad_(requires_grad) for t in floats)
    faces = torch.tensor([[0, 1, 2]])
    return [first, faces, red, half, second, faces.clone(), blue, whole]


def scene(parts, size=(9, 7)):
    solids = [tb.Mesh(v, f, tb.Material(c, o)) for v, f, c, o in (parts[:4], parts[4:])]
    return tb.Scene(solids, tb.Camera(VIEW[0], *size), VIEW[1])


@pytest.mark.parametrize("rays", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_images_are_those_of_render(dtype, rays):
    rgba, coverage = tb.render_meshes(meshes(dtype), VIEW, (9, 7), rays)
    frame = tb.render(scene(meshes(dtype)), rays_per_pixel=rays)
    assert torch.equal(rgba, frame.rgba)
    assert torch.equal(coverage, frame.coverage)
    assert float(coverage.max()) > 0.5


def test_gradients_are_those_of_the_plain_path():
    ours, theirs = meshes(torch.float64, True), meshes(torch.float64, True)
    weight = torch.linspace(-1, 1, 9 * 7 * 4, dtype=torch.float64).reshape(7, 9, 4)
    rgba, coverage = tb.render_meshes(ours, VIEW, (9, 7))
    ((rgba * weight).sum() + coverage.square().sum()).backward()
    frame = tb.render(scene(theirs), backend="torch")
    ((frame.rgba * weight).sum() + frame.coverage.square().sum()).backward()
    for own, other in zip(ours, theirs, strict=True):
        if own.is_floating_point():
            torch.testing.assert_close(own.grad, other.grad, rtol=1e-7, atol=1e-9)
            assert own is ours[4] or float(own.grad.abs().max()) > 0  # the shape at rest has none, by point samples


@pytest.mark.parametrize("requires_grad", [False, True])
def test_torch_finds_nothing_wrong_with_the_operator(requires_grad):
    torch.library.opcheck(
        torch.ops.torchblur.render_meshes.default, (meshes(requires_grad=requires_grad), VIEW, [6, 5], 1)
    )


def test_a_graph_holds_it_whole():
    @torch.compile(backend="aot_eager", fullgraph=True)
    def brightness(shift, parts):
        moved = [parts[0] + shift, *parts[1:]]
        rgba, _ = tb.render_meshes(moved, VIEW, (9, 7))
        return rgba.sum()

    shift = torch.zeros(3, requires_grad=True)
    value = brightness(shift, meshes())
    value.backward()
    plain = torch.zeros(3, requires_grad=True)
    parts = meshes()
    expected = tb.render_meshes([parts[0] + plain, *parts[1:]], VIEW, (9, 7))[0].sum()
    expected.backward()
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(shift.grad, plain.grad)
    assert float(shift.grad.abs().max()) > 0


def test_an_empty_view():
    rgba, coverage = tb.render_meshes([], VIEW, (3, 2))
    assert rgba.shape == (2, 3, 4)
    assert coverage.shape == (2, 3, 0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"meshes": meshes()[:3]}, "meshes: expected 4 tensors a mesh"),
        ({"view": VIEW[:1]}, "view: expected world_to_clip and background"),
        ({"size_px": (3,)}, "size_px: expected width and height"),
        ({"size_px": (0, 3)}, "width"),
        ({"meshes": [torch.full((3, 3), torch.nan), *meshes()[1:]]}, "vertices"),
    ],
)
def test_bad_input(change, told):
    arguments = {"meshes": meshes(), "view": VIEW, "size_px": (3, 2)} | change
    with pytest.raises((TypeError, ValueError), match=told):
        tb.render_meshes(**arguments)
