"""Prisms: canonical corners, knots, bounds; edge quadratics and their antisymmetry."""

import itertools

import pytest
import torch

import torchblur as tb
from torchblur import edges
from torchblur.camera import CENTRE
from torchblur.intervals import find_intervals
from torchblur.pairs import Block
from torchblur.prisms import build_prisms, canonical_corners, swept_bounds_px, window_times
from torchblur.surfaces import build_surfaces


def test_corners_are_the_same_whatever_corner_a_face_begins_with(generator):
    clip = torch.rand(2, 3, 4, 50, dtype=torch.float64, generator=generator)
    clip[:, 1, :, ::2] = clip[:, 0, :, ::2]  # equal corners too
    reference = None
    for order in itertools.permutations(range(3)):
        turned = clip[:, list(order)]
        corner_of, parity = canonical_corners(turned)
        stored = turned.gather(1, corner_of.reshape(1, 3, 1, -1).expand(2, 3, 4, -1))
        reference = stored if reference is None else reference
        assert torch.equal(stored, reference)
        even = order in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        _, first = canonical_corners(clip)
        assert torch.equal(parity[1::2], first[1::2] if even else -first[1::2])


def test_edges_of_neighbours_are_negatives_bit_for_bit(generator):
    x, y = torch.rand(2, 3, 1000, dtype=torch.float64, generator=generator) - 0.5
    forward, backward = edges.cross(x[0], y[0], x[1], y[1]), edges.cross(x[1], y[1], x[0], y[0])
    assert torch.equal(forward, -backward)


def test_quadratic_roots_need_no_thresholds():
    # One corner at the origin's distance 1, edge 2 joins corners 0 and 1; corners move so that e_2 is known.
    def corners(x, y):
        return edges.Corners(
            torch.tensor(x, dtype=torch.float64).unsqueeze(-1),
            torch.tensor(y, dtype=torch.float64).unsqueeze(-1),
            torch.ones(2, 3, 1, dtype=torch.float64),
        )

    linear = edges.edge_roots(corners([[-1, 3, 9], [-1, 3, 9]], [[-1, -1, 9], [3, 3, 9]]))  # c2 = 0: e_2 = -4 (1 - 4 t)
    assert sorted(linear[[2, 5], 0].tolist()) == pytest.approx([0.25, 1.0], abs=1e-15)
    still = edges.edge_roots(corners([[1, 2, 3], [1, 2, 3]], [[1, 3, 2], [1, 3, 2]]))
    assert (still == 1).all()
    nothing = edges.edge_roots(corners([[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]]))
    assert (nothing == 1).all()


def scene_with(k_mesh, k_camera, t_open=0.0, t_close=1.0):
    base = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    vertices = base if k_mesh == 0 else torch.stack([base + k / max(k_mesh, 1) for k in range(k_mesh + 1)])
    eye = (0.0, 0.0, 5.0) if k_camera == 0 else [[0.1 * k, 0.0, 5.0] for k in range(k_camera + 1)]
    camera = tb.Camera.look_at(eye, (0, 0, 0), fov_y_deg=60, width=8, height=8, near=0.1, far=50)
    scene = tb.Scene([tb.Mesh(vertices, [[0, 1, 2]])], camera)
    return scene, tb.Shutter.box(t_open, t_close)


@pytest.mark.parametrize(
    ("k_mesh", "k_camera", "window", "expected"),
    [
        (0, 0, (0.0, 1.0), [0, 1]),
        (1, 0, (0.0, 1.0), [0, 1]),
        (2, 3, (0.0, 1.0), [0, 1 / 3, 1 / 2, 2 / 3, 1]),
        (10, 0, (0.3, 0.5), [0.3, 0.4, 0.5]),
        (4, 2, (0.25, 0.9), [0.25, 0.5, 0.75, 0.9]),
    ],
)
def test_knots_of_mesh_camera_and_shutter_are_joined(k_mesh, k_camera, window, expected):
    scene, shutter = scene_with(k_mesh, k_camera, *window)
    assert window_times(scene, scene.meshes[0], (shutter.t_open, shutter.t_close)) == pytest.approx(expected, abs=1e-15)
    prisms = build_prisms(scene, build_surfaces(scene), (shutter.t_open, shutter.t_close))
    assert prisms.count == len(expected) - 1
    assert prisms.t_open.tolist() == pytest.approx(expected[:-1], abs=1e-15)


def test_bounds_hold_all_swept_points_of_prisms_through_the_camera(generator):
    n = 400
    clip = (torch.rand(2, 3, 4, n, dtype=torch.float64, generator=generator) - 0.5) * 4
    clip[:, :, 2] = clip[:, :, 3] - 0.2  # z = w - 0.2: the near plane z + w = 0 lies at w = 0.1
    near = clip[:, :, 2] + clip[:, :, 3]
    bounds = swept_bounds_px(clip, near, 100, 80)
    seen = 0
    for _ in range(300):
        t, a, b = torch.rand(3, n, dtype=torch.float64, generator=generator)
        a, b = torch.where(a + b > 1, 1 - a, a), torch.where(a + b > 1, 1 - b, b)
        p = (1 - t) * clip[0] + t * clip[1]
        p = (1 - a - b) * p[0] + a * p[1] + b * p[2]
        front = p[2] + p[3] > 0
        x, y = (p[0] / p[3] + 1) * 50, (1 - p[1] / p[3]) * 40
        inside = (x >= bounds[0]) & (x <= bounds[2]) & (y >= bounds[1]) & (y <= bounds[3])
        assert (inside | ~front).all()
        seen += int(front.sum())
    assert seen > 10_000


def test_no_ray_inside_the_bounds_is_forgotten_in_any_block(generator):
    scene, shutter = scene_with(1, 0)
    prisms = build_prisms(scene, build_surfaces(scene), (shutter.t_open, shutter.t_close))
    every = torch.arange(prisms.count)
    whole, _ = find_intervals(prisms, Block(0, 0, 8, 8, CENTRE, 8, 8), every)
    parts = []
    for y0, x0 in itertools.product((0, 3), (0, 5)):
        block = Block(x0, y0, 5 if x0 == 0 else 3, 3 if y0 == 0 else 5, CENTRE, 8, 8)
        part, _ = find_intervals(prisms, block, every)
        parts.append((block, part))
    total = 0
    for block, part in parts:
        total += part.count
        for p in range(block.n_pixels):
            q = (block.y0 + p // block.width) * 8 + block.x0 + p % block.width
            mine, theirs = slice(*part.offsets[p : p + 2].tolist()), slice(*whole.offsets[q : q + 2].tolist())
            assert torch.equal(part.t_start[mine], whole.t_start[theirs])
            assert torch.equal(part.t_end[mine], whole.t_end[theirs])
    assert total == whole.count > 10


@pytest.mark.parametrize("seed", range(6))
def test_an_edge_that_slides_along_itself_is_covered_once(seed):
    """On such an edge e is 0 but for rounding: both faces must still take opposite signs, at all times."""
    generator = torch.Generator().manual_seed(seed)
    for n in (7, 20, 33):
        half, shift = torch.rand(2, dtype=torch.float64, generator=generator) * torch.tensor([0.5, 0.8]) + 0.4
        square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64) * half
        move = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64) * (shift - 0.6)
        vertices = torch.stack([square, square + move])
        camera = tb.Camera(torch.eye(4, dtype=torch.float64), n, n)
        faces = [tb.Mesh(vertices, [f]) for f in ([0, 1, 2], [0, 2, 3])]
        both = tb.render(tb.Scene(faces, camera)).coverage.sum(-1)
        whole = tb.render(tb.Scene([tb.Mesh(vertices, [[0, 1, 2], [0, 2, 3]])], camera)).coverage[..., 0]
        # The union can at most equal the sum; equality means that no instant is covered twice. A hole would show
        # against the axis-aligned square's own closed form along the diagonal.
        torch.testing.assert_close(both, whole, rtol=0, atol=1e-12)
        place = (2 * (torch.arange(n, dtype=torch.float64) + 0.5) / n - 1).flip(0)
        low = ((place - half) / move[0]).clamp(0, 1)
        high = ((place + half) / move[0]).clamp(0, 1)
        expected = (high - low).abs()
        torch.testing.assert_close(both.flip(1).diagonal(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("k_mesh", "k_camera"), [(1, 1), (2, 3), (1, 4), (3, 0)])
def test_a_window_shows_the_motion_of_the_whole_exposure(k_mesh, k_camera):
    """Mesh and camera both move: a window must lie on the chord between their knots, not on a chord of its own."""
    scene, _ = scene_with(k_mesh, k_camera)
    whole = tb.render(scene).rgba
    parts = [tb.render(scene, shutter=tb.Shutter.box(*ends)).rgba for ends in ((0.0, 0.4), (0.4, 1.0))]
    torch.testing.assert_close(0.4 * parts[0] + 0.6 * parts[1], whole, rtol=0, atol=1e-6)  # float32 results
    window = tb.Shutter.box(0.3, 0.45)
    gap = (tb.render(scene, shutter=window).rgba - tb.accumulate(scene, 2000, shutter=window).rgba).abs().max()
    assert gap < 2e-3  # a few events of contrast 1, each within 1 / 4000
