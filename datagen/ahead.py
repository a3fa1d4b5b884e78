"""Compile what workers need before they start, once, rather than in each of them.

Before: nothing.  After: runs.py.
Source: ours.
"""

from __future__ import annotations

import torch

import torchblur as tb


def compile_ahead() -> None:
    """Render a few pixels here in all the ways of a data set, a moment where all is compiled already. Source: ours."""
    corners = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.5, 0.1]])
    faces, uv = torch.tensor([[0, 1, 2]]), torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]]])
    motion = torch.stack([corners, corners + 0.1])
    image = torch.ones(2, 2, 3)
    for look in (tb.Material(), tb.Material(texture=image), tb.Material(texture=image, shading="lambert")):
        mesh = tb.Mesh(motion, faces, look, uv=uv)
        scene = tb.Scene([mesh], tb.Camera(torch.eye(4), 4, 4), lights=[tb.DirectionalLight((0.0, 0.0, -1.0), 1.0)])
        tb.render(scene, backend="auto")
        tb.render_instant(scene)
