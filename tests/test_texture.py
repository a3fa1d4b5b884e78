"""Textures: lookups by hand, exact integration against closed forms and accumulation, gradients, refusals."""

import math

import numpy as np
import pytest
import torch

import torchblur as tb
from torchblur.surfaces import build_surfaces
from torchblur.texture import lookup

FLOAT64 = torch.float64
SQUARE = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=FLOAT64)
FACES = [[0, 1, 2], [0, 2, 3]]
UV = torch.tensor([[[0.0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=FLOAT64)


def flat_camera(n=1, height=None):
    return tb.Camera(torch.eye(4, dtype=FLOAT64), n, height or n)


def image(*shape, seed=0):
    return torch.rand(*shape, dtype=FLOAT64, generator=torch.Generator().manual_seed(seed))


def hand_lookup(texture, u, v, wrap):
    """Bilinear lookup in plain Python: texel centres at (k + 0.5) / size, row 0 on top, v = 0 at the bottom."""
    h, w = texture.shape[:2]
    x, y = u * w - 0.5, (1 - v) * h - 0.5
    total = 0
    for dx in (0, 1):
        for dy in (0, 1):
            i, j = math.floor(x) + dx, math.floor(y) + dy
            weight = (1 - abs(x - i)) * (1 - abs(y - j))
            i, j = (i % w, j % h) if wrap == "repeat" else (min(max(i, 0), w - 1), min(max(j, 0), h - 1))
            total = total + weight * texture[j, i]
    return total


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_lookup_is_the_hand_written_one(wrap):
    texture = image(5, 7, 4)
    mesh = tb.Mesh(SQUARE, FACES, tb.Material(texture=texture, wrap=wrap), uv=UV)
    surfaces = build_surfaces(tb.Scene([tb.Mesh(SQUARE, FACES), mesh], flat_camera()))
    uv = torch.tensor([[0.0, 0.31, 0.999, -0.7, 3.2, 0.5 / 7], [0.0, 0.77, 0.5, 1.4, -2.6, 0.5 / 5]], dtype=FLOAT64)
    face = torch.full((uv.shape[1],), 2)
    got = lookup(surfaces, face, uv, torch.zeros(uv.shape[1], dtype=FLOAT64))
    for k in range(uv.shape[1]):
        expected = hand_lookup(texture, float(uv[0, k]), float(uv[1, k]), wrap)
        torch.testing.assert_close(got[k], expected, rtol=0, atol=1e-13)


def test_a_static_texture_is_looked_up_at_the_pixel_centres():
    texture = image(6, 4, 3)
    mesh = tb.Mesh(SQUARE, FACES, tb.Material((1.0, 0.5, 2.0), texture=texture, wrap="clamp"), uv=UV)
    scene = tb.Scene([mesh], flat_camera(9, 5))
    for frame in (tb.render(scene), tb.render_instant(scene, 0.3)):
        for row in range(5):
            for column in range(9):
                expected = hand_lookup(texture, (column + 0.5) / 9, 1 - (row + 0.5) / 5, "clamp")
                expected = expected * torch.tensor([1.0, 0.5, 2.0], dtype=FLOAT64)
                torch.testing.assert_close(frame.rgba[row, column, :3], expected, rtol=0, atol=1e-12)


def test_a_sliding_texture_is_the_mean_over_its_path():
    """A row of texels slides past the pixel: a piecewise linear function, integrated by trapezoids at its bends."""
    texture = image(1, 16, 3, seed=3)
    end = SQUARE + torch.tensor([0.9, 0.0, 0.0], dtype=FLOAT64)
    mesh = tb.Mesh(
        torch.stack([SQUARE, end]),
        FACES,
        tb.Material((1.0, 1.0, 1.0), texture=texture, wrap="clamp", mipmap=False),
        uv=UV,
    )
    got = tb.render(tb.Scene([mesh], flat_camera())).rgba[0, 0, :3]
    u_start, u_end = 0.5, (1 - 0.9) / 2
    bends = [(k + 0.5) / 16 for k in range(16) if u_end < (k + 0.5) / 16 < u_start]
    u = np.array([u_end, *bends, u_start])
    values = np.stack([hand_lookup(texture, x, 0.5, "clamp").numpy() for x in u])
    expected = np.trapezoid(values, u, axis=0) / (u_start - u_end)
    np.testing.assert_allclose(got.numpy(), expected, rtol=0, atol=1e-13)


def test_20_correlated_opacities_are_multiplied_at_each_time():
    """Two white layers with opacities t and 1 - t over black give 5/6; the product of their means would give 3/4."""
    ramp = torch.ones(1, 2, 4, dtype=FLOAT64)
    ramp[0, :, 3] = torch.tensor([0.0, 1.0])
    # A ramp between two texel centres, u in [1/4, 3/4], passes the pixel during the exposure.
    uv = UV.clone()
    uv[..., 0] = 0.25 + 0.5 * uv[..., 0]
    right = SQUARE + torch.tensor([1.0, 0.0, 0.0], dtype=FLOAT64)
    left = SQUARE - torch.tensor([1.0, 0.0, 0.0], dtype=FLOAT64)
    back = torch.tensor([0.0, 0.0, 0.5], dtype=FLOAT64)
    layers = []
    for start, end in ((right, left), (left + back, right + back)):
        material = tb.Material((1.0, 1.0, 1.0), texture=ramp, wrap="clamp")
        layers.append(tb.Mesh(torch.stack([start, end]), FACES, material, uv=uv))
    rgba = tb.render(tb.Scene(layers, flat_camera())).rgba[0, 0]
    np.testing.assert_allclose(rgba.numpy(), [5 / 6] * 4, rtol=0, atol=1e-12)


def spinning(theta, uv, texture, z0=0.2):
    """Return the scene of a big square that turns by theta between its end poses, seen at z0 from the centre."""
    turn = torch.tensor([[math.cos(theta), -math.sin(theta), 0], [math.sin(theta), math.cos(theta), 0], [0, 0, 1]])
    shift = torch.tensor([z0, 0.0, 0.0], dtype=FLOAT64)
    knots = torch.stack([SQUARE * 2 - shift, (SQUARE * 2) @ turn.T.to(FLOAT64) - shift])
    material = tb.Material((1.0, 1.0, 1.0), texture=texture, wrap="clamp", mipmap=False)
    mesh = tb.Mesh(knots, FACES, material, uv=uv)
    return tb.Scene([mesh], flat_camera())


def test_14_a_colour_linear_in_place_over_a_spin_has_its_closed_form():
    """Object coordinate z0 / g(t), g = (1 - t) + t e^(i theta): mean z0 i theta / (e^(i theta) - 1)."""
    theta = math.pi / 2
    # Texel values linear in place, so that a bilinear lookup is linear: red in x, green in y, over the square [-2, 2].
    n = 64
    place = (torch.arange(n, dtype=FLOAT64) + 0.5) / n
    texture = torch.zeros(n, n, 3, dtype=FLOAT64)
    texture[..., 0], texture[..., 1] = place.unsqueeze(0), 1 - place.unsqueeze(1)
    rgba = tb.render(spinning(theta, UV, texture)).rgba[0, 0]
    mean = 0.2 * 1j * theta / (np.exp(1j * theta) - 1)
    expected = [0.5 + mean.real / 4, 0.5 + mean.imag / 4]
    np.testing.assert_allclose(rgba[:2].numpy(), expected, rtol=0, atol=1e-9)  # Gauss with 4 nodes a panel


def varied(seed, alpha=False, wrap="repeat", k=1):
    generator = torch.Generator().manual_seed(seed)
    knots = torch.stack([(torch.rand(18, 3, dtype=FLOAT64, generator=generator) - 0.5) * 3 for _ in range(k + 1)])
    texture = torch.rand(5, 6, 4 if alpha else 3, dtype=FLOAT64, generator=generator)
    uv = torch.rand(6, 3, 2, dtype=FLOAT64, generator=generator) * 2 - 0.5
    material = tb.Material((0.9, 0.8, 0.7), 0.8 if alpha else 1.0, texture=texture, wrap=wrap)
    mesh = tb.Mesh(knots, torch.arange(18).reshape(6, 3), material, uv=uv)
    plain = tb.Mesh(SQUARE * 0.6, FACES, tb.Material((0.2, 0.9, 0.4), 0.5))
    camera = tb.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y_deg=40, width=10, height=8, near=0.1, far=10)
    return tb.Scene([mesh, plain], camera, background=(0.1, 0.2, 0.3))


@pytest.mark.parametrize(("alpha", "wrap", "k"), [(False, "repeat", 1), (True, "clamp", 1), (True, "repeat", 3)])
def test_accumulation_closes_in_on_textured_scenes(alpha, wrap, k):
    scene = varied(11, alpha, wrap, k)
    exact = tb.render(scene).rgba
    gaps = [float((tb.accumulate(scene, n).rgba - exact).abs().mean()) for n in (64, 1024)]
    assert gaps[1] < gaps[0] / 8  # 1 / N would be 16; one draw of events leaves room of 2
    assert gaps[1] < 5e-4


@pytest.mark.parametrize("alpha", [False, True])
def test_parts_of_the_exposure_average_to_the_whole(alpha):
    scene = varied(5, alpha)
    halves = tb.render_windows(scene, [(0, 0.37), (0.37, 1)])
    mean = 0.37 * halves[0].rgba + 0.63 * halves[1].rgba
    torch.testing.assert_close(mean, tb.render(scene).rgba, rtol=0, atol=1e-7)  # Gauss's rule on other panels


def test_any_shutter_and_rolling_lines_agree_with_accumulation():
    scene = varied(7, True)
    for shutter in (tb.Shutter((0.1, 0.3, 0.9), (0.0, 2.0, 1.0)), tb.Shutter.rolling(0.06, 0.4, "left")):
        exact = tb.render(scene, shutter=shutter).rgba
        gaps = [float((tb.accumulate(scene, n, shutter=shutter).rgba - exact).abs().mean()) for n in (64, 1024)]
        assert gaps[1] < gaps[0] / 6
        assert gaps[1] < 1e-3


def test_memory_and_blocks_change_nothing():
    scene = varied(9, True)
    whole = tb.render(scene).rgba
    torch.testing.assert_close(tb.render(scene, memory_bytes=1 << 20).rgba, whole, rtol=0, atol=1e-12)


def test_order_of_corners_does_not_matter():
    scene = varied(13)
    mesh = scene.meshes[0]
    for order in ([1, 2, 0], [2, 1, 0]):
        turned = tb.Mesh(mesh.vertices, mesh.faces[:, order], mesh.material, uv=mesh.uv[:, order])
        again = tb.Scene([turned, scene.meshes[1]], scene.camera, scene.background)
        torch.testing.assert_close(tb.render(again).rgba, tb.render(scene).rgba, rtol=0, atol=1e-12)


def test_an_opaque_texture_hides_and_a_clear_one_does_not():
    clear = torch.ones(2, 2, 4, dtype=FLOAT64)
    clear[..., 3] = 0
    behind = tb.Mesh(SQUARE + torch.tensor([0, 0, 0.5], dtype=FLOAT64), FACES, tb.Material((0.0, 1.0, 0.0)))
    for texture, expected in ((clear, [0, 1, 0, 1]), (clear[..., :3], [1, 1, 1, 1])):
        front = tb.Mesh(SQUARE, FACES, tb.Material((1.0, 1.0, 1.0), texture=texture), uv=UV)
        scene = tb.Scene([front, behind], flat_camera())
        assert tb.render(scene).rgba[0, 0].tolist() == pytest.approx(expected, abs=1e-15)
        now = tb.render_instant(scene)
        assert now.rgba[0, 0].tolist() == expected
        assert int(now.mesh_id[0, 0]) == (1 if texture is clear else 0)
        coverage = [float(texture is not clear), float(texture is clear)]
        assert tb.render(scene).coverage[0, 0].tolist() == pytest.approx(coverage, abs=1e-15)


@pytest.mark.parametrize("alpha", [False, True])
def test_gradients_reach_texture_uv_vertices_and_colour(alpha):
    generator = torch.Generator().manual_seed(2)
    texture = torch.rand(3, 4, 4 if alpha else 3, dtype=FLOAT64, generator=generator) * 0.8 + 0.1
    end = SQUARE * 1.1 + torch.tensor([0.35, 0.23, 0.1], dtype=FLOAT64)
    back = tb.Mesh(SQUARE * 0.9 + 0.3, FACES, tb.Material((0.3, 0.2, 0.9)))

    def seen(vertices, texture, uv, color):
        mesh = tb.Mesh(vertices, FACES, tb.Material(color, 0.7, texture=texture, wrap="clamp"), uv=uv)
        return tb.render(tb.Scene([mesh, back], flat_camera(3, 2))).rgba

    inputs = (torch.stack([SQUARE, end]), texture, UV * 0.93 + 0.021, torch.tensor([0.5, 0.6, 0.7], dtype=FLOAT64))
    assert torch.autograd.gradcheck(seen, tuple(i.clone().requires_grad_() for i in inputs), atol=1e-6)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: tb.Material(texture=torch.ones(2, 2)), "texture"),
        (lambda: tb.Material(texture=torch.ones(2, 2, 2)), "texture"),
        (lambda: tb.Material(texture=torch.ones(0, 2, 3)), "texture"),
        (lambda: tb.Material(texture=-torch.ones(2, 2, 3)), "texture"),
        (lambda: tb.Material(texture=torch.full((2, 2, 4), 1.5)), "texture's opacity"),
        (lambda: tb.Material(texture=torch.full((2, 2, 3), torch.nan)), "texture"),
        (lambda: tb.Material(texture=torch.ones(2, 2, 3, dtype=torch.uint8)), "texture"),
        (lambda: tb.Material(wrap="mirror"), "wrap"),
        (lambda: tb.Mesh(SQUARE, FACES, tb.Material(texture=torch.ones(2, 2, 3))), "uv"),
        (lambda: tb.Mesh(SQUARE, FACES, uv=torch.zeros(4, 2)), "uv"),
        (lambda: tb.Mesh(SQUARE, FACES, uv=torch.full((2, 3, 2), torch.inf)), "uv"),
        (lambda: tb.Mesh(SQUARE, FACES, uv=torch.full((2, 3, 2), -1.1e6)), "uv"),
    ],
)
def test_bad_textures_are_refused_by_name(make, name):
    with pytest.raises((TypeError, ValueError), match=rf"^{name}: expected .*, got "):
        make()


@pytest.mark.parametrize("place", [1e6, -1e6])
def test_the_farthest_places_that_are_allowed_give_colours_of_the_texture(place):
    far = torch.full_like(UV, place)  # a step of float32 there is a sixteenth of the texture
    moved = torch.stack([SQUARE, SQUARE + torch.tensor([0.3, 0.2, 0.0])])
    mesh = tb.Mesh(moved, FACES, tb.Material(texture=image(4, 4, 3), wrap="repeat"), uv=far)
    scene = tb.Scene([mesh], flat_camera(3))
    for backend in ("cpu", "torch"):
        rgba = tb.render(scene, backend=backend).rgba  # which texels these are is rounding; that it ends is not
        assert (rgba >= 0).all()
        assert (rgba <= 1 + 1e-6).all()
        assert rgba[1, 1, 3] > 0.99
