"""Random scenes with every degenerate triangle there is, from recipes that hypothesis can draw and shrink.

A recipe holds what decides the shape of a scene; numbers come from seeded generators, one for each triangle, so that a
triangle taken away leaves the others as they were. All numbers are float32 ones where the scene is to be float32.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scene_makers as make
from hypothesis import strategies as st
from lit_scenes import MIRRORED, UPRIGHT
from oracle_linear import PlainShutter
from oracle_looks import LookMesh, LookScene, PlainLight

KINDS = (
    "plain",
    "still",
    "point",  # all vertices in one place
    "pair",  # two vertices in one place
    "line",
    "edge_on",
    "turning",  # shows its other side later
    "touching",  # a vertex on the near plane
    "behind",  # partly behind the near plane or the camera
    "tiny",
    "huge",
    "on_centres",  # at rest, its vertices in the centres of pixels
    "duplicate",  # of the triangle before it
    "coplanar",  # with the triangle before it
)
EYE_Z, NEAR = 3.0, 1.0  # of the perspective camera; its near plane is z = 2, the orthographic one's z = 1
OFTEN = KINDS + ("plain",) * 6 + ("still", "turning", "behind", "touching", "huge")
FACING = np.array([0, 0, 1.2])  # about which vertex normals scatter
SHUTTERS = ("box", "part", "trapezoid", "pieces", "rolling")


@dataclass(frozen=True)
class MeshRecipe:
    """What decides the shape of a mesh."""

    kinds: tuple[str, ...]
    n_segments: int
    texture: tuple[int, int, int] | None  # height, width, channels
    wrap: str
    mipmap: bool
    shading: str
    smooth: bool
    double_sided: bool
    opacity: str


@dataclass(frozen=True)
class Recipe:
    """What decides the shape of a scene and how it is rendered."""

    seed: int
    camera: str
    camera_segments: int
    meshes: tuple[MeshRecipe, ...]
    lights: tuple[str, ...]
    size: tuple[int, int]
    n_rays: int
    shutter: str
    method: str
    is_double: bool


@st.composite
def recipes(draw) -> Recipe:
    """Draw a recipe of 1 to 40 triangles in 1 to 3 meshes."""
    n_meshes = draw(st.integers(1, 3))
    most = (40, 20, 13)[n_meshes - 1]
    mesh = st.builds(
        MeshRecipe,
        kinds=st.sampled_from((1, 2, 3, 4, 6, most)).flatmap(lambda n: st.tuples(*[st.sampled_from(OFTEN)] * n)),
        n_segments=st.integers(0, 3),
        texture=st.none() | st.tuples(st.integers(1, 7), st.integers(1, 9), st.sampled_from((3, 4))),
        wrap=st.sampled_from(("repeat", "clamp")),
        mipmap=st.booleans(),
        shading=st.sampled_from(("unlit", "lambert")),
        smooth=st.booleans(),
        double_sided=st.booleans(),
        opacity=st.sampled_from(("mixed", "half", "opaque", "mixed", "half", "clear")),
    )
    method = draw(st.sampled_from(("exact", "exact", "linear", "adaptive")))
    meshes = tuple(draw(mesh) for _ in range(n_meshes))
    if method == "adaptive" and draw(st.booleans()):
        meshes = tuple(replace(m, texture=None, shading="unlit") for m in meshes)
    return Recipe(
        seed=draw(st.integers(0, 2**32 - 1)),
        camera=draw(st.sampled_from(("perspective", "orthographic", "mirrored"))),
        camera_segments=draw(st.integers(0, 3)),
        meshes=meshes,
        lights=tuple(draw(st.lists(st.sampled_from(("point", "spot", "directional")), max_size=3))),
        size=(draw(st.integers(1, 6)), draw(st.integers(1, 5))),
        n_rays=draw(st.integers(1, 2)),
        shutter=draw(st.sampled_from(SHUTTERS)),
        method=method,
        is_double=draw(st.booleans()),
    )


def rng_of(recipe: Recipe, *key: int) -> np.random.Generator:
    """Return the generator of one part of a scene."""
    return np.random.default_rng([recipe.seed, *key])


def build(recipe: Recipe) -> LookScene:
    """Return the scene of a recipe."""

    def rounded(value):
        value = np.asarray(value, dtype=np.float64)
        return value if recipe.is_double else value.astype(np.float32).astype(np.float64)

    rng = rng_of(recipe, 100)
    lights = [_light(kind, rng_of(recipe, 101, k), rounded) for k, kind in enumerate(recipe.lights)]
    background = rng.uniform(0, 1, 3) if rng.random() < 0.7 else rng.uniform(0, 1, (*recipe.size[::-1], 3))
    return LookScene(
        [_mesh(recipe, k, rounded) for k in range(len(recipe.meshes))],
        _camera(recipe),
        *recipe.size,
        rounded(background),
        lights=lights,
        ambient=rounded(rng.uniform(0, 0.4, 3)),
        rays_per_pixel=recipe.n_rays,
    )


def build_shutter(recipe: Recipe) -> PlainShutter:
    """Return the shutter of a recipe."""
    rng = rng_of(recipe, 102)
    a, b, c, d = np.sort(rng.uniform(0, 1, 4)).tolist()
    if recipe.shutter == "part":
        return PlainShutter((a, d), (1.0, 1.0))
    if recipe.shutter == "trapezoid":
        return PlainShutter((a, b, c, d), (0.0, 1.0, 1.0, 0.0))
    if recipe.shutter == "pieces":
        return PlainShutter((0.0, b, c, d), (*rng.choice([0.0, 1.0, 2.0], 3).tolist(), 1.0))
    if recipe.shutter == "rolling":
        direction = str(rng.choice(["down", "up", "right", "left"]))
        n_lines = recipe.size[1] if direction in ("down", "up") else recipe.size[0]
        return PlainShutter((0.0, 0.4), (1.0, 1.0), 0.6 / max(1, n_lines), direction)
    return PlainShutter()


def _camera(recipe: Recipe) -> np.ndarray:
    """Return a matrix or its knots, jittered around the view along -z."""
    rng, knots = rng_of(recipe, 103), []
    for _ in range(recipe.camera_segments + 1):
        if recipe.camera == "perspective":
            eye, target = rng.uniform(-0.3, 0.3, 3) + np.array([0, 0, EYE_Z]), rng.uniform(-0.3, 0.3, 3)
            if recipe.camera_segments == 0:
                eye, target = (0.0, 0.0, EYE_Z), (0.0, 0.0, 0.0)
            knots.append(make.perspective(eye, target, 45.0, recipe.size[0] / recipe.size[1], NEAR, 8.0))
        else:
            matrix = (UPRIGHT if recipe.camera == "orthographic" else MIRRORED).copy()
            if recipe.camera_segments:
                matrix[:2, :3] += rng.uniform(-0.15, 0.15, (2, 3))
                matrix[:2, 3] = rng.uniform(-0.3, 0.3, 2)
            knots.append(matrix)
    return np.stack(knots) if recipe.camera_segments else knots[0]


def _light(kind: str, rng: np.random.Generator, rounded) -> PlainLight:
    """Return a light that rests or moves along knots of its own."""

    def place(low, high):
        n = int(rng.integers(0, 4))
        return rounded(rng.uniform(low, high, (n + 1, 3) if n else 3))

    power = rounded(rng.uniform(0.2, 4, 3) if rng.random() < 0.5 else rng.uniform(0.2, 4))
    outer = float(rng.uniform(10, 90))
    inner = outer if rng.random() < 0.3 else float(rng.uniform(0, outer))
    return PlainLight(
        kind,
        power,
        position=place((-1.5, -1.5, 0.8), (1.5, 1.5, 3)),
        target=place((-0.8, -0.8, -1), (0.8, 0.8, 0.3)),
        direction=place((-1, -1, -1), (1, 1, 0.2)),
        inner_deg=inner,
        outer_deg=outer,
    )


def _mesh(recipe: Recipe, k: int, rounded) -> LookMesh:
    """Return mesh `k` of a recipe."""
    own = recipe.meshes[k]
    rng, n = rng_of(recipe, k, 1000), len(own.kinds)
    knots, looks = [], []
    for i, kind in enumerate(own.kinds):
        one = rng_of(recipe, k, i)
        look = one.uniform(0, 1, 3), _opacity(own.opacity, one), one.uniform(-0.5, 1.5, (3, 2)) * one.choice([1, 3])
        before = knots[-1] if knots else None
        knots.append(_triangle(recipe, kind, own.n_segments, one, before))
        looks.append(looks[-1] if kind == "duplicate" and looks else look)
    color, opacity, uv = (np.stack(part) for part in zip(*looks, strict=True))
    if rng.random() < 0.2:
        color, opacity = color[0], opacity[0]
    vertices = np.stack(knots, 1).reshape(own.n_segments + 1, 3 * n, 3)
    n_knots = own.n_segments + 1 if rng.random() < 0.7 else 1
    normals = [rng_of(recipe, k, i, 1).normal(0, 0.4, (n_knots, 3, 3)) + FACING for i in range(n)]
    normals = np.stack(normals, 1).reshape(n_knots, 3 * n, 3)
    faces = np.arange(3 * n).reshape(n, 3)
    faces[[kind == "pair" for kind in own.kinds], 1] -= 1
    return LookMesh(
        rounded(vertices if own.n_segments else vertices[0]),
        faces,
        color=rounded(color),
        opacity=rounded(opacity),
        double_sided=own.double_sided,
        uv=rounded(uv),
        texture=None if own.texture is None else rounded(_texture(own.texture, rng)),
        wrap=own.wrap,
        mipmap=own.mipmap,
        shading=own.shading,
        normals=rounded(normals if n_knots > 1 else normals[0]) if own.smooth else None,
    )


def _opacity(kind: str, rng: np.random.Generator) -> float:
    """Return the opacity of a face."""
    return {"opaque": 1.0, "clear": 0.0, "half": 0.5}.get(kind, float(rng.choice([0.0, 1.0, rng.random()])))


def _texture(shape: tuple[int, int, int], rng: np.random.Generator) -> np.ndarray:
    """Return random texels, of which some are clear and some opaque."""
    texture = rng.uniform(0, 1, shape)
    if shape[2] == 4:
        pick = rng.random(shape[:2])
        texture[..., 3] = np.where(pick < 0.2, 0.0, np.where(pick < 0.4, 1.0, texture[..., 3]))
    return texture


def _triangle(recipe: Recipe, kind: str, n_segments: int, rng: np.random.Generator, before) -> np.ndarray:
    """Return the knots (K + 1, 3, 3) of one triangle; `before` those of the one before it, if any."""
    plane_z = EYE_Z - NEAR if recipe.camera == "perspective" else -1.0 if recipe.camera == "mirrored" else 1.0
    shape = rng.uniform(-1, 1, (3, 3)) * [1.0, 1.0, 0.6]
    shape -= 0.7 * shape.mean(0)
    centre = rng.uniform(-0.7, 0.7, 3) * [1, 1, 0.8]
    shift = np.cumsum(rng.uniform(-0.6, 0.6, (n_segments + 1, 1, 3)) * [1, 1, 0.5], 0)
    bend = rng.uniform(-0.3, 0.3, (n_segments + 1, 3, 3))
    share = rng.uniform(0, 1, (3, 3))
    knots = centre + shape + shift + bend
    if kind in ("duplicate", "coplanar") and before is not None:
        weights = share / share.sum(1, keepdims=True) * 1.6 - 0.2
        return before.copy() if kind == "duplicate" else np.einsum("ij,kjc->kic", weights, before)
    if kind == "still":
        knots = np.broadcast_to(centre + shape, knots.shape).copy()
    elif kind == "point":
        knots[:] = knots[:, :1]
    elif kind == "pair":
        knots[:, 1] = knots[:, 0]
    elif kind == "line":
        knots[:, 2] = knots[:, 0] + 2 * (knots[:, 1] - knots[:, 0])
    elif kind == "edge_on":
        far = EYE_Z - knots[..., 2] if recipe.camera == "perspective" else 1.0
        knots[..., 0] = 0.3 * centre[0] * far
    elif kind == "turning":
        knots[n_segments // 2 + 1 :, 1:] = knots[n_segments // 2 + 1 :, :0:-1]
    elif kind == "touching":
        knots[:, 0, 2] = plane_z
    elif kind == "behind":
        knots[rng.integers(0, n_segments + 1) :, : rng.integers(1, 4), 2] += 2 * plane_z
    elif kind in ("tiny", "on_centres"):
        pixels = np.stack([rng.integers(0, recipe.size[0], 3) + 0.5, rng.integers(0, recipe.size[1], 3) + 0.5], 1)
        places = np.concatenate([2 * pixels / recipe.size - 1, np.zeros((3, 1))], 1)
        size = 10 ** -rng.uniform(1, 6)
        knots = np.broadcast_to(places, knots.shape) if kind == "on_centres" else places[0] + size * (knots - centre)
    elif kind == "huge":
        knots = centre + shift + (shape + bend) * 10 ** rng.uniform(1, 4) * [1, 1, 0.01]
    return np.array(knots)
