"""Clips as they are drawn, lit ones above all, against brute force: rays through exact motions, imports nothing of
torchblur's renderer.

At each of N instants every pixel's centre sends one ray to all triangles, and every hit one to each lamp. What differs
from the mean is the instants' own error (a pixel that an edge crosses is off by up to its contrast / N) and the chord
tolerance of the knots.
"""

import functools
import math

import numpy as np
import pytest
import torch

import torchblur as tb
from datagen.clips import freeze
from datagen.samples import frame_times, render_sample
from datagen.scenes import Plan, build_clip
from datagen.spec import parse_spec

WIDTH, HEIGHT, INSTANTS = 14, 11, 16
LIFT = 1e-7  # of the way to a lamp; what lies closer to a point than that is the point's own face


def plan(**fields):
    base = {"width": WIDTH, "height": HEIGHT, "rays_per_pixel": 1, "seed": 11, "lighting": "lamps", "exposure": 1.0}
    return Plan(parse_spec(base | fields), (), "")


def crossings(origins, ways, corners):
    """The (R, F) share of each way (R, 3) at which it meets each triangle (F, 3, 3); inf: never."""
    first, across, along = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(across, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        down = -(ways @ normals.T)  # (R, F) determinant
        offset = origins[:, None] - first
        reach = (offset * normals).sum(-1) / down
        turn = np.cross(offset, ways[:, None])
        u, v = (along * turn).sum(-1) / down, -(across * turn).sum(-1) / down
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (down != 0), reach, np.inf)


def traced(clip, time_s, width=WIDTH, height=HEIGHT):
    """The (H, W, 3) image of an instant, and the (H, W, 2) light due to it and light that arrives."""
    now = torch.tensor([time_s], dtype=torch.float64)
    scene = freeze(clip, width, height, time_s)
    matrix = clip.camera.matrices(now, width, height)[0].numpy()
    x = (2 * (np.arange(width) + 0.5) / width - 1)[None].repeat(height, 0).ravel()
    y = (1 - 2 * (np.arange(height) + 0.5) / height)[:, None].repeat(width, 1).ravel()
    near, far = ((np.stack([x, y, z * np.ones_like(x), np.ones_like(x)], 1) @ np.linalg.inv(matrix).T) for z in (-1, 1))
    start, end = near[:, :3] / near[:, 3:], far[:, :3] / far[:, 3:]
    corners, colours, opacities, is_lit = [], [], [], []
    for actor in clip.actors:
        n = len(actor.faces)
        corners.append(actor.motion.at(now)[0].to(torch.float32).double().numpy()[actor.faces.numpy()])
        colours.append(np.broadcast_to(actor.color.double().numpy(), (n, 3)))
        opacities.append(np.broadcast_to(np.asarray(actor.opacity, dtype=float), (n,)))
        is_lit.append(np.full(n, actor.is_lit))
    corners, colours, opacities, is_lit = map(np.concatenate, (corners, colours, opacities, is_lit))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    reach = crossings(start, end - start, corners)
    reach[(reach <= 0) | (reach > 1)] = np.inf
    background = np.asarray(scene.background, dtype=float)
    image = np.zeros((width * height, 3))
    light = np.zeros((width * height, 2))
    left = np.ones(width * height)
    for layer in np.argsort(reach, axis=1).T:
        pixels = np.flatnonzero((left > 1e-9) & np.isfinite(reach[np.arange(len(left)), layer]))
        if not len(pixels):
            break
        faces = layer[pixels]
        places = start[pixels] + reach[pixels, faces][:, None] * (end - start)[pixels]
        facing = normals[faces] * -np.sign((normals[faces] * (end - start)[pixels]).sum(1))[:, None]
        share = left[pixels] * opacities[faces]
        seen = np.where(is_lit[faces][:, None], np.array(clip.ambient), 1.0)
        for lamp in clip.lamps:
            where, aim = lamp.position.at(now)[0].numpy(), lamp.target.at(now)[0].numpy()
            axis = (aim - where) / max(np.linalg.norm(aim - where), 1e-30)
            if lamp.kind == "directional":
                ways, strength = np.broadcast_to(-axis * 1e3, places.shape), np.ones(len(places))
            else:
                ways = where - places
                strength = 1 / (ways**2).sum(1)
            toward = ways / np.linalg.norm(ways, axis=1, keepdims=True)
            if lamp.kind == "spot":
                outer, inner = (math.cos(math.radians(a)) for a in (lamp.outer_angle_deg, lamp.inner_angle_deg))
                edge = np.clip((-(toward @ axis) - outer) / (inner - outer), 0, 1)
                strength = strength * edge**2  # as glTF has it
            strength = strength * np.maximum((toward * facing).sum(1), 0) / math.pi * is_lit[faces]
            blockers = crossings(places, ways, corners)
            blocks = (blockers > LIFT) & (blockers < 1)
            blocks[np.arange(len(faces)), faces] = False
            arrives = np.prod(np.where(blocks, 1 - opacities, 1.0), axis=1)
            seen = seen + (strength * arrives)[:, None] * np.array(lamp.power)
            due = share * strength * sum(lamp.power)
            light[pixels] += np.stack([due, due * arrives], 1)
        image[pixels] += share[:, None] * colours[faces] * seen
        left[pixels] -= share
    image += left[:, None] * np.broadcast_to(background.reshape(-1, 3), image.shape)
    return image.reshape(height, width, 3), light.reshape(height, width, 2)


@functools.cache
def exact(number):
    """What rays see of a clip's first frame: sharp, as the shutter opens and closes, the mean of its instants, and
    their light due and arriving."""
    here = plan()
    clip, times = build_clip(here, number), frame_times(here, 0)
    still = [traced(clip, time_s)[0] for time_s in (times.sharp_s, times.open_s, times.close_s)]
    shares = (np.arange(INSTANTS) + 0.5) / INSTANTS
    found = [traced(clip, times.open_s + s * (times.close_s - times.open_s)) for s in shares]
    return still, *(np.mean(part, axis=0) for part in zip(*found, strict=True))


def errors(number):
    """How far a clip's first frame is from what rays see, in the terms of LIMITS."""
    here = plan()
    clip, times = build_clip(here, number), frame_times(here, 0)
    still, image, light = exact(number)
    frozen = [freeze(clip, WIDTH, HEIGHT, time_s) for time_s in (times.sharp_s, times.open_s, times.close_s)]
    frozen_off = [off(tb.render_instant(scene).rgba, seen).max() for scene, seen in zip(frozen, still, strict=True)]
    sample = render_sample(clip, here, number, 0)
    contrast = max(1.0, float(image.max()))
    sharp_off, blur_off = off(sample.sharp, still[0]), off(sample.blurred, image) / contrast
    due, arrives = light[..., 0], light[..., 1]  # where next to nothing is due the share of it means nothing
    share = 1.0 if sample.shadow is None else sample.shadow.numpy()
    return {
        "frozen": max(frozen_off),
        "sharp shades": (sharp_off > 2e-3).mean(),
        "sharp edges": (sharp_off > 0.02).mean(),
        "blurred mean": blur_off.mean(),
        "blurred worst": blur_off.max(),
        "shadow": np.abs(share * due - arrives).mean() / due.mean(),
    }


def off(image, seen):
    """The (H, W) greatest difference of an image's colours from what rays see."""
    return np.abs(image[..., :3].numpy() - seen).max(-1)


LIMITS = {  # tests/test_faults_clips.py plants what exceeds them
    "frozen": 1e-6,  # an instant's scene has no chords: rounding alone
    "sharp shades": 0.1,  # shares of the pixels; in an exposure things follow chords, up to 0.1 px off
    "sharp edges": 0.03,
    "blurred mean": 0.01,
    "blurred worst": 3 / INSTANTS,  # one instant more or less for each edge that crosses a pixel
    "shadow": 0.01,
}


def check_clip(number):
    """Raise unless a clip is what rays see, and say in what it is not."""
    found = errors(number)
    assert not {name: value for name, value in found.items() if not value < LIMITS[name]}


@pytest.mark.parametrize("number", range(4))
def test_lit_clips_are_what_rays_through_their_exact_motions_see(number):
    check_clip(number)


@pytest.mark.parametrize("lighting", ["painted", "lamps"])
@pytest.mark.parametrize("size", [(8, 8), (6, 16), (4, 32)])
def test_the_eye_stays_inside_of_rooms(lighting, size):
    here = plan(width=size[0], height=size[1], lighting=lighting)
    times, rooms = torch.linspace(0, 4, 97, dtype=torch.float64), 0
    for number in range(60):
        clip = build_clip(here, number)
        walls = [actor for actor in clip.actors if actor.name == "room"]
        if walls:
            rooms += 1
            corners, eye = walls[0].motion.at(times[:1])[0], clip.camera.eye.at(times)
            assert bool((eye > corners.amin(0) + 0.1).all() and (eye < corners.amax(0) - 0.1).all()), number
    assert rooms >= 5
