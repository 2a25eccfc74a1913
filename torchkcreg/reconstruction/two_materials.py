"""Weighted least squares of two materials in each voxel, by parabolas that are separable in voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .pwls_config import PWLSConfig
from .roughness import VoxelRoughness
from .spectral import BeamModel
from .subsets import ordered_subsets
from .system import BLOCK_VIEWS, System


@dataclass(frozen=True)
class SpectralViews:
    """Views of one spectrum: what metal lets through of each energy, and the two materials' attenuation there."""

    views: list[int]
    beam: BeamModel
    shares: Tensor  # (K, v, rows, cols) or (K, 1, 1, 1)
    basis: Tensor  # (2, K), 1/mm, of water and of CALCIUM_UNIT


class TwoMaterials:
    """The solver behind `decompose`.

    Args:
        system: Projector.
        lines: Line integrals as measured, without scatter, (V, rows, cols).
        weights: How much each counts.
        sources: All views, by spectrum.
        unknown: Share of each voxel that no metal fills, (D, H, W); 1 if None.
        config: Iterations, subsets, momentum and roughness.
        spacing: Of the voxels (x, y, z), mm.
        start: Water and calcium, (2, D, H, W).
    """

    def __init__(
        self,
        system: System,
        lines: Tensor,
        weights: Tensor,
        sources: Sequence[SpectralViews],
        unknown: Tensor | None,
        config: PWLSConfig,
        spacing: Sequence[float],
        start: Tensor,
    ) -> None:
        self.system, self.lines, self.weights, self.unknown = system, lines, weights, unknown
        self.config, self.roughness = config, VoxelRoughness(spacing)
        self.place = {view: (source, n) for source in sources for n, view in enumerate(source.views)}
        self.x, self.ahead, self.pace, self.iteration = start, start.clone(), 1.0, 0
        typical = torch.stack([source.basis.mean(1) for source in sources]).mean(0)
        self.beta = config.beta * typical.square()
        self.curvature = self._curvature()

    def _masked(self, volume: Tensor) -> Tensor:
        return volume if self.unknown is None else volume * self.unknown

    def _modelled(self, paths: Tensor, views: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Line integrals (v, rows, cols) of two materials' (2, v, rows, cols), and their derivatives to these."""
        lines, slopes = torch.empty_like(paths[0]), torch.empty_like(paths)
        for row, view in enumerate(views):
            source, n = self.place[view]
            share = source.shares[:, n if source.shares.shape[1] > 1 else 0]
            exponents = share.clamp_min(1e-30).log() - torch.einsum("mk,mrc->krc", source.basis, paths[:, row])
            lines[row] = -torch.logsumexp(exponents, 0)
            slopes[:, row] = torch.einsum("krc,mk->mrc", torch.softmax(exponents, 0), source.basis)
        return lines, slopes

    def _paths(self, x: Tensor, views: Sequence[int]) -> Tensor:
        return torch.stack([self.system.project(self._masked(part), views) for part in x])

    def _curvature(self) -> Tensor:
        """Of the parabolas in each voxel: water's, between the two, calcium's, (3, D, H, W)."""
        ones = self._masked(torch.ones_like(self.x[0]))
        total = self.x.new_zeros(3, *ones.shape)
        for start in range(0, self.system.num_views, BLOCK_VIEWS):
            views = list(range(start, min(start + BLOCK_VIEWS, self.system.num_views)))
            lengths = self.system.project(ones, views) * self.weights[views]
            _, slopes = self._modelled(self._paths(self.x, views), views)
            for row, product in enumerate((slopes[0] ** 2, slopes[0] * slopes[1], slopes[1] ** 2)):
                total[row] += self._masked(self.system.backproject(lengths * product, views))
        rough = self.roughness.curvature(ones)
        for row, beta in ((0, self.beta[0]), (2, self.beta[1])):
            total[row] += beta * rough + 1e-6 * total[row].max()
        return total

    def iterate(self) -> float:
        """One pass through the subsets; the misfit's root mean square before."""
        stage = self.config.stage(self.iteration)
        if self.iteration and stage.subsets != self.config.stage(self.iteration - 1).subsets:
            self.ahead, self.pace = self.x.clone(), 1.0
        misfit = 0.0
        for views in ordered_subsets(self.system.num_views, stage.subsets, sources=self.system.sources):
            point = self.ahead if stage.momentum else self.x
            modelled, slopes = self._modelled(self._paths(point, views), views)
            weighted = self.weights[views] * (modelled - self.lines[views])
            misfit += float((weighted * (modelled - self.lines[views])).sum())
            scale = self.system.num_views / len(views)
            gradient = torch.stack(
                [
                    scale * self._masked(self.system.backproject(weighted * slope, views))
                    + beta * self.roughness.gradient(part)
                    for slope, part, beta in zip(slopes, point, self.beta.tolist())
                ]
            )
            stepped = _least(point, gradient, self.curvature)
            pace = (1 + (1 + 4 * self.pace**2) ** 0.5) / 2
            self.ahead = torch.lerp(self.x, stepped, 1 + (self.pace - 1) / pace)
            self.x, self.pace = stepped, pace
        self.iteration += 1
        return (misfit / float(self.weights.sum())) ** 0.5


def _least(point: Tensor, gradient: Tensor, curvature: Tensor) -> Tensor:
    """Where parabolas in water and calcium (2, ...) are least with water not negative.

    Where water is cut off, calcium is the least beside none: clamping the step would leave it where it went together
    with the water. Calcium may be negative: noise cut off at zero would be calcium on average.
    """
    (w, c), (along_w, along_c), (ww, wc, cc) = point, gradient, curvature
    determinant = (ww * cc - wc * wc).clamp_min(1e-12 * ww * cc)
    water = w - (cc * along_w - wc * along_c) / determinant
    calcium = c - (ww * along_c - wc * along_w) / determinant
    beside_none = c - (along_c - wc * w) / cc
    return torch.stack([water.clamp_min(0), torch.where(water < 0, beside_none, calcium)])
