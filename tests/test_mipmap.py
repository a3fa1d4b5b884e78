"""Mip levels: the pyramid, which level a lookup takes, and what moving textures look like through them.

Everything is asked of rendered images. An n x m image of a w x h texture that fills it has a footprint of
rho = sqrt(((w / n)^2 + (h / m)^2) / 2) texels; with w / n = h / m = 2^k it shows level k, texel by texel.
Static images are right to rounding (1e-12), means over the exposure to 1e-6 of the brightest.
"""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import lit_scenes as lit
import numpy as np
import pytest
import scene_makers as make
import torch
from lit_scenes import UPRIGHT, square_uv
from oracle_looks import LookMesh, LookScene, bilinear, footprint, image_at, mean_over_exposure, pyramid, trilinear
from oracles import clip_at
from scene_makers import perspective

import torchblur as tb
from torchblur.camera import pixel_rays

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
BIG = np.array([[-5.0, -4, 0], [6, -5, 0], [0.3, 7, 0]])  # no edge passes a pixel
FULL = [[0, 0], [1, 0], [1, 1], [0, 1]]


def texture_of(h, w, channels=3, seed=0):
    """Return random texels."""
    return np.random.default_rng(seed).uniform(0, 1, (h, w, channels))


def filled(texture, size, uv=FULL, corners=None, **options) -> LookScene:
    """Return a scene with an unlit textured plate.

    Without corners it is one triangle that fills the image of `size` (w, h), whose own corners have the `uv` (4, 2):
    lower left, lower right, upper right, upper left. Otherwise these are the uv of the plate's corners.
    """
    options = {"wrap": "clamp", "shading": "unlit", "color": (1.0, 1.0, 1.0), "texture": texture} | options
    if corners is None:
        uv = np.asarray(uv, dtype=np.float64)
        share = (BIG[:, :2] + 1) / 2
        uv_big = uv[0] + share[:, :1] * (uv[1] - uv[0]) + share[:, 1:] * (uv[3] - uv[0])
        return LookScene([LookMesh(BIG, [[0, 1, 2]], uv=uv_big[None], **options)], UPRIGHT, *size)
    return LookScene([LookMesh(corners, [[0, 1, 2], [0, 2, 3]], uv=square_uv(uv), **options)], UPRIGHT, *size)


def rendered(scene: LookScene, **options) -> np.ndarray:
    """Return the (H, W, 4) image."""
    return tb.render(lit.to_torch(scene), **options).rgba.numpy()


def shown(scene: LookScene) -> np.ndarray:
    """Return the image of a still scene after making sure that an instant and the oracle show it too."""
    got = rendered(scene)
    np.testing.assert_allclose(tb.render_instant(lit.to_torch(scene), 0.4).rgba.numpy(), got, rtol=0, atol=1e-12)
    np.testing.assert_allclose(image_at(scene, 0.4), got, rtol=0, atol=1e-12)
    return got


def check_mean(scene: LookScene, every=1) -> None:
    """Compare a moving scene with the oracle, some pixels left out."""
    got = rendered(scene)
    for row, col in [(r, c) for r in range(scene.height) for c in range(scene.width)][::every]:
        answer = mean_over_exposure(scene, row, col)
        np.testing.assert_allclose(got[row, col], answer.rgba, rtol=0, atol=1e-6 * max(1, answer.brightest))


@pytest.mark.parametrize("k", [1, 2, 3])
def test_levels_of_even_sizes_are_block_means(k):
    texture, n = texture_of(8, 16), 2**k
    got = shown(filled(texture, (16 // n, 8 // n)))
    expected = texture.reshape(8 // n, n, 16 // n, n, 3).mean((1, 3))
    np.testing.assert_allclose(got[..., :3], expected, rtol=0, atol=1e-12)


def mean_of_strip(n: int, m: int) -> np.ndarray:
    """Return (m, n) shares of n texels in m equal parts of their length, in rational numbers."""
    share = np.zeros((m, n))
    for i in range(m):
        a, b = Fraction(i * n, m), Fraction((i + 1) * n, m)
        for j in range(n):
            share[i, j] = float(max(Fraction(0), min(b, Fraction(j + 1)) - max(a, Fraction(j))) / (b - a))
    return share


def test_odd_sizes_overlap_by_their_areas():
    """5 x 3 texels become 2 x 1 and then 1 x 1; a 2 x 1 image of them looks between these two."""
    texture = texture_of(3, 5)
    np.testing.assert_allclose(mean_of_strip(5, 2)[0], [0.4, 0.4, 0.2, 0, 0], atol=1e-15)
    first = np.einsum("kl,jlc->kc", mean_of_strip(5, 2), texture) / 3
    last = first.mean(0)
    share = np.log2(np.sqrt((2.5**2 + 3**2) / 2)) - 1
    got = shown(filled(texture, (2, 1)))[0, :, :3]
    np.testing.assert_allclose(got, (1 - share) * first + share * last, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("h", "w"), [(7, 13), (1, 9), (6, 1), (1, 1), (2, 31)])
def test_the_last_level_is_one_texel(h, w):
    """Level by level, each the area mean of the one before; far beyond the last level everything is its one texel."""
    texture = texture_of(h, w)
    values, sizes = texture, [(h, w)]
    while values.shape[:2] != (1, 1):
        rows, columns = (mean_of_strip(n, max(1, n // 2)) for n in values.shape[:2])
        values = np.einsum("ij,kl,jlc->ikc", rows, columns, values)
        sizes.append(values.shape[:2])
    assert [level.shape[:2] for level in pyramid(texture)] == sizes
    for uv in (np.multiply(FULL, 100), [[-99, 3], [400, 3], [400, 777], [-99, 777]]):
        got = shown(filled(texture, (1, 1), uv, wrap="repeat"))
        np.testing.assert_allclose(got[0, 0, :3], values[0, 0], rtol=0, atol=1e-12)


def test_colours_are_weighted_by_opacity():
    """Clear texels do not tint their neighbours; where all are clear the plain mean is kept for what lies between."""
    texture = texture_of(4, 4, 4)
    texture[:2, 2:, 3] = 0
    blocks = texture.reshape(2, 2, 2, 2, 4).transpose(0, 2, 1, 3, 4).reshape(2, 2, 4, 4)
    alpha = blocks[..., 3].mean(2)
    weighted = (blocks[..., :3] * blocks[..., 3:]).mean(2)
    rgb = np.where(alpha[..., None] > 0, weighted / np.maximum(alpha, 1e-9)[..., None], blocks[..., :3].mean(2))
    got = shown(filled(texture, (2, 2)))
    np.testing.assert_allclose(got[..., 3], alpha, rtol=0, atol=1e-12)
    np.testing.assert_allclose(got[..., :3], rgb * alpha[..., None], rtol=0, atol=1e-12)
    # half-way between the clear texel and its left neighbour in level 1
    rgba = shown(filled(texture, (2, 2), np.array(FULL) + np.array([0.25, 0])))[0, 0]
    straight, opacity = rgb[0].mean(0), alpha[0].mean()
    np.testing.assert_allclose(rgba, [*(straight * opacity), opacity], rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", [0.3, 1.0, 1.7, 2.0, 5.3, 40.0])
def test_level_of_a_plate_that_faces_the_viewer(scale):
    """`scale` texels a pixel both ways: level log2(scale) between the first and the last."""
    texture = texture_of(16, 16)
    n = 3 * scale / 16  # uv that 3 pixels span
    got = shown(filled(texture, (3, 3), np.multiply(FULL, n)))[..., :3]
    levels = pyramid(texture)
    level = min(max(np.log2(scale), 0), 4)
    k = min(int(level), 3)
    for row in range(3):
        for col in range(3):
            uv = np.array([[(col + 0.5) / 3 * n, (1 - (row + 0.5) / 3) * n]])
            low, high = (bilinear(levels[m], uv, "clamp")[0][0, :3] for m in (k, k + 1))
            expected = (k + 1 - level) * low + (level - k) * high
            np.testing.assert_allclose(got[row, col], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.1, np.pi / 2])
def test_level_does_not_depend_on_the_direction_of_the_stretch(angle):
    """Stretched 8 : 2 and turned by any angle on screen, the root mean square is the same: sqrt(34)."""
    texture = texture_of(64, 64)
    axes = np.diag([8.0, 2.0]) @ make.rotation_z(angle)[:2, :2] / 64  # uv a pixel
    got = shown(filled(texture, (1, 1), (np.array(FULL) - 0.5) @ axes.T + 0.5))
    expected, _ = trilinear(pyramid(texture), np.full((1, 2), 0.5), np.array([np.sqrt(34)]), "clamp")
    np.testing.assert_allclose(got[0, 0], expected[0], rtol=0, atol=1e-12)


def floor_scene(texture, size=(9, 7), **options) -> LookScene:
    """Return a floor in perspective that recedes to the horizon."""
    corners = np.array([[-3.1, -1, 3], [3, -1.1, 3], [9.2, -0.9, -30], [-9, -1, -30]])
    scene = filled(texture, size, np.multiply(FULL, [3, 5]), corners, wrap="repeat", **options)
    scene.world_to_clip = perspective((0.2, 0.5, 4), aspect=9 / 7)
    return scene


def test_oracle_footprint_is_what_finite_differences_give():
    """The definition: derivatives of the place in texels of level 0 by the ray's place, a pixel's size apart."""
    scene = floor_scene(texture_of(12, 20))
    mesh, step = scene.meshes[0], 1e-5
    for row, col, face in ((5, 4, 0), (4, 2, 1), (6, 6, 0)):
        clip = clip_at(scene, mesh, 0.0)[mesh.faces[face]][None]

        def texel(dx, dy, clip=clip, face=face, row=row, col=col):
            ndc = scene.pixel_ndc(row, col, (0.5 + dx, 0.5 + dy))
            return footprint(scene, mesh, face, clip, ndc)[0][0] * [20, 12]

        columns = [(texel(step, 0) - texel(-step, 0)) / (2 * step), (texel(0, step) - texel(0, -step)) / (2 * step)]
        _, rho = footprint(scene, mesh, face, clip, scene.pixel_ndc(row, col))
        assert rho[0] == pytest.approx(np.sqrt(np.square(columns).sum() / 2), rel=1e-8)


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
@pytest.mark.parametrize("channels", [3, 4])
def test_still_floor_in_perspective(wrap, channels):
    scene = floor_scene(texture_of(12, 20, channels))
    scene.meshes[0].wrap = wrap
    image = shown(scene)
    assert np.ptp(image[3:, :, 0]) > 0.1  # not all grey


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_wrap_applies_to_each_level(wrap):
    """Level 2 of 8 x 8 texels is 2 x 2: around the edges repeat mixes opposite sides and clamp does not."""
    texture = texture_of(8, 8)
    uv = 0.5 + (np.array(FULL) - 0.5) * 2.0  # 4 x 4 pixels over 2 repeats: 4 texels a pixel
    got = shown(filled(texture, (4, 4), uv, wrap=wrap))[..., :3]
    level = texture.reshape(2, 4, 2, 4, 3).mean((1, 3))
    for row in range(4):
        for col in range(4):
            place = np.array([[-0.5 + (col + 0.5) / 2, 1.5 - (row + 0.5) / 2]])
            x, y = place[0, 0] * 2 - 0.5, (1 - place[0, 1]) * 2 - 0.5
            assert x == int(x)  # at the centres of texels of level 2
            assert y == int(y)
            fold = (lambda k: int(k) % 2) if wrap == "repeat" else (lambda k: min(max(int(k), 0), 1))
            np.testing.assert_allclose(got[row, col], level[fold(y), fold(x)], rtol=0, atol=1e-12)


@pytest.mark.parametrize("n_rays", [4, 16])
def test_more_rays_take_finer_levels(n_rays):
    """The footprint is that of the ray's own share of the pixel: sqrt(rays) closer together."""
    scene = floor_scene(texture_of(32, 32), (3, 2))
    scene.rays_per_pixel = n_rays
    got = rendered(scene, rays_per_pixel=n_rays)
    for row, col in ((1, 0), (1, 2)):
        answers = [mean_over_exposure(scene, row, col, place=place).rgba for place in pixel_rays(n_rays)]
        np.testing.assert_allclose(got[row, col], np.mean(answers, 0), rtol=0, atol=1e-12)
    # of a plate that faces the viewer with 8 texels a pixel, 4 rays see level 2 and 16 see level 1
    texture = texture_of(64, 64)
    plate = filled(texture, (8, 8))
    plate.rays_per_pixel = n_rays
    n = 2 if n_rays == 16 else 4
    level = texture.reshape(64 // n, n, 64 // n, n, 3).mean((1, 3))
    for frame in (tb.render, tb.render_instant):
        got = frame(lit.to_torch(plate), rays_per_pixel=n_rays).rgba.numpy()[..., :3]
        for row, col in ((0, 0), (3, 5)):
            uv = np.array([[(col + x) / 8, 1 - (row + y) / 8] for x, y, *_ in pixel_rays(n_rays)])
            expected = bilinear(np.concatenate([level, level[..., :1]], 2), uv, "clamp")[0][:, :3].mean(0)
            np.testing.assert_allclose(got[row, col], expected, rtol=0, atol=1e-12)


def moving_away(mipmap=True, **options) -> LookScene:
    """Return a plate that recedes from 1 to 9 units away while it drifts, under a perspective camera."""
    corners = np.array([[-1.1, -1, 3], [1, -1.2, 3], [1.2, 1, 3], [-1, 1.1, 2.8]])
    moving = np.stack([corners, corners * 2.5 + np.array([0.4, -0.3, -11])])
    scene = filled(texture_of(24, 40, 4), (7, 5), FULL, moving, mipmap=mipmap, **options)
    scene.world_to_clip, scene.background = perspective((0, 0, 4)), np.array([0.1, 0.2, 0.3])
    return scene


@pytest.mark.parametrize("mipmap", [True, False])
@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_plate_that_moves_away_passes_levels(mipmap, wrap):
    check_mean(moving_away(mipmap, wrap=wrap), every=2)


def test_spinning_plate_and_moving_camera():
    corners = np.array([[-1.5, -1.4, 0], [1.4, -1.6, 0.2], [1.6, 1.5, 0], [-1.4, 1.7, -0.3]])
    scene = filled(texture_of(21, 13), (6, 5), np.multiply(FULL, 1.7), make.rotated(corners, 1.1, 3), wrap="repeat")
    scene.world_to_clip = np.stack([perspective((0, 0.3, z), (0, 0, 0), 40) for z in (3.5, 7.0, 5.0)])
    check_mean(scene)


def test_levels_agree_with_accumulation():
    for plain in (moving_away(), moving_away(wrap="repeat")):
        scene = lit.to_torch(plain)
        exact = tb.render(scene).rgba[..., :3]
        error = (tb.accumulate(scene, 4096).rgba[..., :3] - exact).square().mean()
        assert float(10 * torch.log10(exact.max() ** 2 / error)) >= 60


def test_a_fine_checker_far_away_is_grey_with_levels_only():
    checker = (np.indices((64, 64)).sum(0) % 2)[..., None] * np.ones(3)
    uv = np.multiply(FULL, 17.3)
    for moving in (False, True):
        images = {}
        for mipmap in (True, False):
            scene = filled(checker, (12, 12), uv, mipmap=mipmap, wrap="repeat")
            if moving:
                knots = np.stack([BIG, BIG * 1.01 + np.array([0.003, 0.002, 0])])
                scene.meshes[0] = dataclasses.replace(scene.meshes[0], vertices=knots)
            images[mipmap] = rendered(scene)[..., 0]
        np.testing.assert_allclose(images[True], 0.5, rtol=0, atol=1e-12)
        assert np.abs(images[False] - 0.5).max() > 0.15


def test_gradients_reach_the_texture_through_its_levels():
    """Through moving lookups between levels, clear texels included; none comes from the level itself."""
    plain = moving_away()
    plain.width, plain.height = 2, 1
    plain.meshes[0].texture = None
    scene = lit.to_torch(plain)
    uv = torch.tensor(square_uv(np.multiply(FULL, 4)))

    def image(texture):
        mesh = tb.Mesh(scene.meshes[0].vertices, scene.meshes[0].faces, tb.Material(texture=texture), uv=uv)
        return tb.render(tb.Scene([mesh], scene.camera, (0.1, 0.2, 0.3))).rgba

    texture = torch.tensor(texture_of(1, 5, 4)).mul(0.8).add(0.1).requires_grad_()
    assert torch.autograd.gradcheck(image, (texture,), eps=1e-6, atol=1e-6, rtol=1e-4)
    image(texture).sum().backward()
    assert float(texture.grad.abs().min()) > 0  # every texel is seen


def test_a_still_image_has_gradients_by_hand():
    texture = torch.zeros(4, 4, 3, dtype=torch.float64, requires_grad=True)
    mesh = tb.Mesh(
        torch.tensor(SQUARE), [[0, 1, 2], [0, 2, 3]], tb.Material((1.0, 1, 1), texture=texture, wrap="clamp"),
        uv=torch.tensor(square_uv(FULL)),
    )  # fmt: skip
    image = tb.render(tb.Scene([mesh], tb.Camera(torch.tensor(UPRIGHT), 2, 2))).rgba
    image[0, 0, 0].backward()
    expected = torch.zeros(4, 4, 3, dtype=torch.float64)
    expected[:2, :2, 0] = 0.25
    torch.testing.assert_close(texture.grad, expected, rtol=0, atol=1e-12)
