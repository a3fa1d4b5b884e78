"""Filters by name: the image of each that a data set may hold beside the exact one.

Before: directional.py, mcguire2012.py, guertin2014.py, guertin2015.py.  After: samples.py.
All of them see the same sharp image, and depth and motion of the centres of its pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

import torchblur as tb
from datagen.baselines.directional import directional
from datagen.baselines.guertin2014 import guertin2014
from datagen.baselines.guertin2015 import guertin2015
from datagen.baselines.mcguire2012 import mcguire2012
from datagen.baselines.views import Paths, View, find_paths, find_view

# name -> what it does with a view and its paths, and with what settings
FILTERS: dict[str, tuple[Callable[..., Tensor], dict[str, Any]]] = {
    "directional": (lambda view, paths, **how: directional(view.color, view.motion_px, **how), {"samples": 32}),
    "mcguire2012": (
        lambda view, paths, **how: mcguire2012(view, **how),
        {"samples": 15, "tile_px": 20, "soft_depth": 0.1, "seed": 0},
    ),
    "guertin2014": (
        lambda view, paths, **how: guertin2014(view, **how),
        {"samples": 35, "tile_px": 40, "seed": 0},
    ),
    "guertin2015": (
        lambda view, paths, **how: guertin2015(view.color, paths, **how),
        {"curve": "bezier", "weighting": "published"},
    ),
}
NEEDING_PATHS = {"guertin2015"}


def apply_filter(name: str, view: View, paths: Paths | None) -> Tensor:
    """Return the images (B, C, H, W) blurred by a filter at its settings.

    Args:
        name: one of FILTERS.
        view, paths: of the same images; each filter takes what it uses: paths, those in NEEDING_PATHS.

    Raises:
        KeyError: no such filter.

    Source: ours.
    """
    function, settings = FILTERS[name]
    return function(view, paths, **settings)


def filter_instant(scene: tb.Scene, now: tb.Instant, names: Sequence[str]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the filters' images of a scene, and what is to be known of them.

    Args:
        scene: that is blurred.
        now: its sharp image, `render_instant(scene, t=0.5)`.
        names: some of FILTERS.

    Returns:
        {name: (H, W, 3) linear RGB} and {name: settings}, JSON values; `unknown_motion_pixels` counts the pixels that
        were left still because their point is behind the camera at the opening or the closing.

    Raises:
        ValueError: an orthographic camera, and a filter that needs paths.

    Source: ours.
    """
    if not names:
        return {}, {}
    view, unknown = find_view(scene, now)
    paths = find_paths(scene, now) if NEEDING_PATHS & set(names) else None
    images = {name: apply_filter(name, view, paths)[0].permute(1, 2, 0) for name in names}
    return images, {name: FILTERS[name][1] | {"unknown_motion_pixels": unknown} for name in names}
