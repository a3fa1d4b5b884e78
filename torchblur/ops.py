"""Rendering as operators that torch knows: `torch.compile` traces through them, autograd goes by the plain path.

Before: render.py.  After: nothing.
Symbols: M meshes, F faces of one, V vertices, H, W image size.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from torchblur import check
from torchblur.camera import Camera
from torchblur.material import Material
from torchblur.render import render
from torchblur.scene import Mesh, Scene

PARTS = 4  # tensors of a mesh
GIVEN = "Tensor[] meshes, Tensor[] view, int[] size_px, int rays_per_pixel"
SCHEMA = f"({GIVEN}) -> (Tensor, Tensor)"
BACKWARD = f"({GIVEN}, Tensor to_rgba, Tensor to_coverage) -> Tensor[]"


def render_meshes(
    meshes: Sequence[Tensor], view: Sequence[Tensor], size_px: Sequence[int], rays_per_pixel: int = 1
) -> tuple[Tensor, Tensor]:
    """Return what `render` does of meshes of constant colours over the whole exposure, as one operator of a graph.

    Args:
        meshes: four tensors a mesh, mesh by mesh: vertices (V, 3) or (K+1, V, 3), faces (F, 3) int64, straight linear
            colour (3,) or (F, 3), opacity () or (F,); all seen from both sides.
        view: the camera's `world_to_clip`, (4, 4) or (K+1, 4, 4), and the background's colour (3,).
        size_px: width and height.
        rays_per_pixel: as of `render`.

    Returns:
        rgba (H, W, 4) and coverage (H, W, M), of the type of the vertices. Forward they take the compiled path where it
        can be, backward the plain one.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Example:
        >>> triangle = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.5, 0.0]])
        >>> mesh = [triangle, torch.tensor([[0, 1, 2]]), torch.ones(3), torch.tensor(1.0)]
        >>> rgba, _ = render_meshes(mesh, [torch.eye(4), torch.zeros(3)], (8, 8))
        >>> rgba.shape
        torch.Size([8, 8, 4])

    Source: ours.
    """
    if len(meshes) % PARTS:
        raise check.fail("meshes", f"{PARTS} tensors a mesh", f"{len(meshes)} tensors")
    if len(view) != 2:
        raise check.fail("view", "world_to_clip and background", f"{len(view)} tensors")
    if len(size_px) != 2:
        raise check.fail("size_px", "width and height", f"{len(size_px)} numbers")
    return _forward(list(meshes), list(view), list(size_px), rays_per_pixel)


def _scene(meshes: Sequence[Tensor], view: Sequence[Tensor], size_px: Sequence[int]) -> Scene:
    solids = []
    for k in range(0, len(meshes), PARTS):
        vertices, faces, color, opacity = meshes[k : k + PARTS]
        solids.append(Mesh(vertices, faces, Material(color, opacity), name=f"mesh {k // PARTS}"))
    return Scene(solids, Camera(view[0], *size_px), view[1])


@torch.library.custom_op("torchblur::render_meshes", mutates_args=(), schema=SCHEMA)
def _forward(meshes, view, size_px, rays_per_pixel):
    frame = render(_scene(meshes, view, size_px), rays_per_pixel=rays_per_pixel)
    return frame.rgba, frame.coverage


@_forward.register_fake
def _(meshes, view, size_px, rays_per_pixel):
    width, height = size_px
    dtype = torch.float32
    for vertices in meshes[::PARTS]:
        dtype = torch.promote_types(dtype, vertices.dtype)
    empty = view[0].new_empty
    return empty((height, width, 4), dtype=dtype), empty((height, width, len(meshes) // PARTS), dtype=dtype)


@torch.library.custom_op("torchblur::render_meshes_backward", mutates_args=(), schema=BACKWARD)
def _backward(meshes, view, size_px, rays_per_pixel, to_rgba, to_coverage):
    # inside an operator torch records nothing, whatever `enable_grad` says; a thread of its own starts afresh
    with ThreadPoolExecutor(max_workers=1) as thread:
        return thread.submit(_pull_back, (meshes, view, size_px, rays_per_pixel), (to_rgba, to_coverage)).result()


def _pull_back(given: tuple[Any, ...], to: tuple[Tensor, Tensor]) -> list[Tensor]:
    meshes, view, size_px, rays_per_pixel = given
    leaves = [t.detach().requires_grad_() if t.is_floating_point() else t for t in [*meshes, *view]]
    scene = _scene(leaves[: len(meshes)], leaves[len(meshes) :], size_px)
    frame = render(scene, rays_per_pixel=rays_per_pixel, backend="torch")
    wanted = [t for t in leaves if t.requires_grad]
    found = torch.autograd.grad([frame.rgba, frame.coverage], wanted, to, allow_unused=True, materialize_grads=True)
    slopes = iter(found)
    return [next(slopes).clone() if t.requires_grad else torch.zeros_like(t) for t in leaves]


@_backward.register_fake
def _(meshes, view, size_px, rays_per_pixel, to_rgba, to_coverage):
    return [torch.empty_like(t) for t in [*meshes, *view]]


def _keep(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    meshes, view, ctx.size_px, ctx.rays_per_pixel = inputs
    ctx.n, ctx.needs = len(meshes), [t.requires_grad for t in [*meshes, *view]]
    ctx.save_for_backward(*meshes, *view)


def _slopes(ctx: Any, to_rgba: Tensor, to_coverage: Tensor) -> tuple[Any, ...]:
    saved = list(ctx.saved_tensors)
    to = (to_rgba.contiguous(), to_coverage.contiguous())
    found = _backward(saved[: ctx.n], saved[ctx.n :], ctx.size_px, ctx.rays_per_pixel, *to)
    found = [slope if needs else None for slope, needs in zip(found, ctx.needs, strict=True)]
    return found[: ctx.n], found[ctx.n :], None, None


_forward.register_autograd(_slopes, setup_context=_keep)
