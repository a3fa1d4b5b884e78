"""When lookups in textures bend: as the place crosses a line of texels, or the level a whole number.

Before: paths.py.  After: nodes.py.
Symbols: K paths of textured layers; place in (u, v) = P / S; in texels of level l, x = (w_l P_u - S / 2) / S.
Source: Ronnow et al. 2022, eq. 1 (the quadratics); bends: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import bernstein, edges, packed
from torchblur.certificate import Lookup
from torchblur.paths import Paths
from torchblur.prisms import Prisms
from torchblur.stopwatch import spent_on
from torchblur.texture import to_texels

NOISE = 1e-14  # of the largest coefficient: rounding of products of degree 8


@dataclass(frozen=True)
class TexturePaths:
    """The places of textured layers on their textures over spans."""

    paths: Paths  # K of them
    uv: Tensor  # (2, 3 corners, K) texture coordinates
    slope: Tensor  # (5, 4, M) S^2 times the entries of the footprint's matrix in texels of level 0, of `mipped`
    mipped: Tensor  # (M,) which of the K may be looked up at levels above 0
    level: Tensor  # (2, K) float64 least and greatest level, whole numbers

    @classmethod
    @spent_on("texture")
    def of(cls, prisms: Prisms, paths: Paths) -> TexturePaths:
        """Return the places of the textured among `paths`."""
        uv = prisms.corner_uv(paths.prism)
        atlas, mesh = prisms.surfaces.atlas, prisms.surfaces.mesh_of[paths.face]
        level = torch.zeros(2, len(mesh), dtype=torch.float64, device=mesh.device)
        mipped = (atlas.n_levels[mesh] > 1).nonzero().flatten()
        slope = _footprints(paths.choose(mipped), uv[..., mipped], atlas.size[0][:, mesh[mipped]])
        if len(mipped):
            level[:, mipped] = _level_range(slope, paths.scale[:, mipped], atlas.n_levels[mesh[mipped]] - 1)
            small = (level[1, mipped] > 0).nonzero().flatten()
            mipped, slope = mipped[small], slope[..., small]
        return cls(paths, uv, slope, mipped, level)

    def lines(self, prisms: Prisms) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Return, axis by axis and level by level, paths (n,), Bernstein coefficients of their places in texels times S
        (3, n), and the first and last lines that they may cross (n,).
        """
        surfaces = prisms.surfaces
        found = []
        for level in range(int(self.level[1].max()) + 1 if len(self.paths.span) else 0):
            which = ((self.level[0] <= level) & (self.level[1] >= level)).nonzero().flatten()
            mesh = surfaces.mesh_of[self.paths.face[which]]
            size = surfaces.atlas.size[level][:, mesh].to(torch.float64)
            texel = to_texels(self.uv[..., which], size.unsqueeze(1))
            e, scale = self.paths.e[..., which], self.paths.scale[:, which]
            for axis in (0, 1):
                place = (e * texel[axis]).sum(1)
                low, high = texel[axis].amin(0), texel[axis].amax(0)  # the place is a mean of the corners'
                repeats = surfaces.atlas.repeats[mesh]
                low = torch.where(repeats, low, low.clamp(min=0))
                high = torch.where(repeats, high, torch.minimum(high, size[axis] - 1))
                ratio_low, ratio_high = bernstein.ratio_range(place, scale)
                low, high = torch.maximum(low, ratio_low).ceil(), torch.minimum(high, ratio_high).floor()
                found.append((which, place, low, high))
        return found

    def finest_lookup(self, prisms: Prisms) -> Lookup:
        """Return the places in texels of the least level at which each path may be looked up."""
        surfaces = prisms.surfaces
        size = surfaces.atlas.size[self.level[0].long(), :, surfaces.mesh_of[self.paths.face]].T.to(torch.float64)
        texel = to_texels(self.uv, size.unsqueeze(1))
        place = torch.stack([(self.paths.e * axis).sum(1) for axis in texel], dim=1)
        multiplies = surfaces.has_varying_opacity[self.paths.face]
        return Lookup(self.paths.span, place, self.paths.scale, multiplies)

    def count_lines(self, prisms: Prisms) -> Tensor:
        """Return about how many lines (K,) each path crosses."""
        total = torch.zeros(len(self.paths.span), dtype=torch.float64, device=self.uv.device)
        for which, _, low, high in self.lines(prisms):
            total = total.index_add(0, which, (high - low + 1).clamp(min=0))
        return total

    @spent_on("texture")
    def bends(self, prisms: Prisms) -> tuple[Tensor, Tensor]:
        """Return the paths (B,) and times tau (B,), in [0, 1] or not, at which a lookup may bend."""
        paths, taus = [], []
        for which, place, low, high in self.lines(prisms):
            line, of = packed.expand(low.long(), (high - low + 1).clamp(min=0).long())
            c = place[:, of] - line * self.paths.scale[:, which[of]]
            for tau in _quadratic_roots(c):
                paths.append(which[of])
                taus.append(tau)
        if len(self.mipped):
            numerator, denominator = self._square()
            low, high = self.level[:, self.mipped]
            level, of = packed.expand(low.long(), (high - low + 1).clamp(min=0).long())
            c = numerator[:, of] - 4.0**level * denominator[:, of]
            which, tau = bernstein.roots(c, NOISE * c.abs().amax(0))
            paths.append(self.mipped[of[which]])
            taus.append(tau)
        if not paths:
            return self.mipped[:0], self.level[0, :0]
        return torch.cat(paths), torch.cat(taus)

    def _square(self) -> tuple[Tensor, Tensor]:
        """Return (9, M) coefficients of S^4 times the square of the footprint's size, and of S^4."""
        return _square_of(self.slope), _fourth_power(self.paths.scale[:, self.mipped])


def _footprints(paths: Paths, uv: Tensor, size: Tensor) -> Tensor:
    """Return (5, 4, K) coefficients of S^2 d(texel) / d(ray), the entries of two axes by two."""
    x, y, w = paths.corners.x, paths.corners.y, paths.corners.w
    scale, rows = paths.scale, []
    for along, spacing in zip(((y, w), (w, x)), paths.spacing_ndc, strict=True):
        e = edges.edge_coefficients(edges.Corners(*along, w))
        for axis in (0, 1):
            wide = uv[axis] * (size[axis] * spacing)
            rows.append(
                bernstein.product(scale, (e * wide).sum(1)) - bernstein.product((paths.e * wide).sum(1), e.sum(1))
            )
    return torch.stack(rows, dim=1)


def _square_of(slope: Tensor) -> Tensor:
    """Return (9, K) coefficients of the mean square of the axes of (5, 4, K) matrices."""
    return 0.5 * bernstein.product(slope, slope).sum(1)


def _fourth_power(scale: Tensor) -> Tensor:
    square = bernstein.product(scale, scale)
    return bernstein.product(square, square)


def _level_range(slope: Tensor, scale: Tensor, last: Tensor) -> Tensor:
    """Return the least and greatest level (2, K), whole numbers, of footprints."""
    low, high = bernstein.ratio_range(_square_of(slope), _fourth_power(scale))
    low, high = (0.5 * torch.log2(b.clamp(min=1.0)) for b in (low, high))
    return torch.minimum(torch.stack([low.floor(), high.ceil()]), last)


def _quadratic_roots(c: Tensor) -> tuple[Tensor, Tensor]:
    """Return both roots (n,) of quadratics with Bernstein coefficients (3, n); NaN or infinite where there is none."""
    h, c2 = c[1] - c[0], c[0] - 2 * c[1] + c[2]
    q = -(h + torch.copysign(torch.sqrt(h * h - c2 * c[0]), h))
    return q / c2, c[0] / q
