"""Material: what a mesh is made of.

Before: nothing.  After: scene.py, surfaces.py.
Symbols: F faces.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from torchblur import check

WRAPS = ("repeat", "clamp")
SHADINGS = ("unlit", "lambert")


@dataclass(frozen=True, eq=False)
class Material:
    """What a mesh is made of: straight (not premultiplied) linear colour and opacity, constant or per face.

    Args:
        color: (3,) or (F, 3) linear RGB, at least 0; above 1 is light that outshines white.
        opacity: a number or (F,), in [0, 1].
        texture: (h, w, 3) linear RGB that multiplies the colour, or (h, w, 4) with an opacity that multiplies the
            opacity; row 0 is the top, v = 0 the bottom edge; texel centres at (k + 0.5) / size; bilinear.
        wrap: "repeat" or "clamp": what uv outside [0, 1] mean.
        mipmap: where a pixel's footprint holds several texels, look up a smaller copy of the texture, so that it does
            not alias; otherwise the texels at the ray alone are seen.
        shading: "unlit" shows the colour as it is; "lambert" multiplies it by the light that the scene's lights and
            ambient light send, see `Scene`.
        double_sided: show back faces too; otherwise only faces whose vertices turn counter-clockwise on screen,
            decided exactly in time.

    Raises:
        TypeError, ValueError: wrong shape or type, NaN, inf, or out of range.
    """

    color: Any = (0.8, 0.8, 0.8)
    opacity: Any = 1.0
    double_sided: bool = field(default=True, kw_only=True)
    texture: Any = field(default=None, kw_only=True)
    wrap: str = field(default="repeat", kw_only=True)
    mipmap: bool = field(default=True, kw_only=True)
    shading: str = field(default="unlit", kw_only=True)

    def __post_init__(self) -> None:
        color = check.floats("color", self.color, (3,), ("F", 3))
        if (color.detach() < 0).any():
            raise check.fail("color", "values of at least 0", f"{float(color.detach().min())}")
        opacity = check.unit_range("opacity", check.floats("opacity", self.opacity, (), ("F",)))
        for name in ("double_sided", "mipmap"):
            check.flag(name, getattr(self, name))
        for name, known in (("wrap", WRAPS), ("shading", SHADINGS)):
            if getattr(self, name) not in known:
                raise check.fail(name, " or ".join(known), getattr(self, name))
        object.__setattr__(self, "color", color)
        object.__setattr__(self, "opacity", opacity)
        object.__setattr__(self, "texture", None if self.texture is None else _checked_texture(self.texture))


def _checked_texture(texture: Any) -> Tensor:
    """Return the texture as (h, w, 3 or 4) finite floats, colours at least 0 and opacities in [0, 1]."""
    image = check.floats("texture", texture, ("h", "w", 3), ("h", "w", 4))
    if 0 in image.shape:
        raise check.fail("texture", "at least one texel", image)
    if (image.detach() < 0).any():
        raise check.fail("texture", "values of at least 0", f"{float(image.detach().min())}")
    if image.shape[2] == 4:
        check.unit_range("texture's opacity", image[..., 3])
    return image
