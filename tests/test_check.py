"""What numpy and torch would silently turn into numbers, or lose, is refused by name."""

import numpy as np
import pytest
import torch

import torchblur as tb

VERTICES = torch.eye(3)


def mesh(vertices=VERTICES, faces=((0, 1, 2),)):
    return tb.Mesh(vertices, faces)


@pytest.mark.parametrize(
    "faces",
    [
        [[0, 1], [0]],
        "abc",
        None,
        [torch.tensor([0, 1, 2])],
        [[0, 1, 2**70]],
        [[0.0, 1, 2]],
        torch.zeros(1, 3),
        [[True, False, True]],
        np.array([[0, 1, 2**63]], dtype=np.uint64),
        [[0, 1, 3]],
        [[0, -1, 2]],
    ],
)
def test_faces_that_are_no_indices(faces):
    with pytest.raises((TypeError, ValueError), match=r"^faces: expected .*, got "):
        mesh(faces=faces)


@pytest.mark.parametrize(
    "vertices",
    [
        [torch.zeros(3, requires_grad=True)] * 3,
        VERTICES.to_sparse(),
        VERTICES.to("meta"),
        np.zeros((3, 3), np.longdouble),
        np.ma.zeros((3, 3)),
        np.zeros((3, 3), ">f8"),
        "x",
        [["1", "2", "3"]] * 3,
        [[True, False, True]] * 3,
        np.zeros((3, 3), complex),
        torch.zeros(3, 3, dtype=torch.float16),
    ],
)
def test_vertices_that_would_be_changed_on_the_way(vertices):
    with pytest.raises((TypeError, ValueError), match=r"^vertices: expected .*, got "):
        mesh(vertices=vertices)


@pytest.mark.parametrize("opacity", [True, [True], "0.5", None, 1.5, [[0.5]]])
def test_opacities_that_are_no_numbers(opacity):
    with pytest.raises((TypeError, ValueError), match=r"^opacity: expected .*, got "):
        tb.Material(opacity=opacity)


def test_arrays_are_copied_and_keep_their_type():
    array = np.eye(3, dtype=np.float32)[::-1]
    made = mesh(vertices=array, faces=np.array([[2, 1, 0]], dtype=np.uint16))
    assert made.vertices.dtype == torch.float32
    assert made.faces.dtype == torch.int64
    array[0, 0] = 9
    assert torch.equal(made.vertices, torch.eye(3).flip(0))


def test_no_faces_at_all_are_a_mesh():
    assert mesh(faces=[]).n_faces == 0


def test_huge_vertices_leave_the_frame_finite():
    vertices = torch.full((3, 3), 3e38, requires_grad=True)
    frame = tb.render(tb.Scene([mesh(vertices)], tb.Camera(torch.eye(4), 4, 4)))
    assert torch.isfinite(frame.rgba).all()
