"""Decomposition into water and calcium from scans at several tube voltages, with known metal (KC-MBMD)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import Spectrum, Veil, calcium_attenuation, calcium_of, material
from torchkcreg.progress import progress_bar

from .corrections import floored_line_integrals, scatter_image
from .inpainting import filled_transmission
from .kcrec import component_shares, known_materials, unknown_share, without_components
from .preparation import statistical_weights
from .pwls import PWLSConfig, ordered_subsets, pwls
from .spectral import BeamModel, mineral_part
from .system import BLOCK_VIEWS, System, VoxelRoughness, VoxelSystem, projected

CALCIUM_UNIT = 100.0  # mg/mL, unit of calcium in the solver: its line integrals are then of similar size to water's
LEAST_TRANSMISSION = 2e-3  # below it scatter dominates a pixel
NUM_BINS = 8


@dataclass(frozen=True)
class SpectralViews:
    """Views of one spectrum, with the metal's transmission and the two materials' attenuation at each energy."""

    views: list[int]
    beam: BeamModel
    shares: Tensor  # (K, v, rows, cols) or (K, 1, 1, 1)
    basis: Tensor  # (2, K), attenuation of water and of CALCIUM_UNIT, 1/mm


class TwoMaterials:
    """The solver behind `decompose`.

    Args:
        system: Projector.
        lines: Measured line integrals without scatter, (V, rows, cols).
        weights: Statistical weights of the line integrals.
        sources: All views, grouped by spectrum.
        unknown: Share of each voxel that no metal fills, (D, H, W); 1 if None.
        config: Iterations, subsets, momentum and roughness.
        spacing: Voxel spacing (x, y, z), mm.
        start: Initial water and calcium, (2, D, H, W).
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
        """Line integrals (v, rows, cols) and their derivatives by the two materials' paths (2, v, rows, cols)."""
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
        """Curvatures of the surrogate parabolas in each voxel, (3, D, H, W): water, mixed, calcium."""
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
        """Run one pass through the subsets; returns the root mean square misfit of the points it stepped from."""
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
    """Minimum (2, ...) of parabolas in water and calcium, with water not negative.

    Where water is clamped to 0, calcium is minimised with water at 0; clamping the joint step alone would leave calcium
    at a wrong value. Calcium may be negative, because clamping noise at zero would bias its mean.
    """
    (w, c), (along_w, along_c), (ww, wc, cc) = point, gradient, curvature
    determinant = (ww * cc - wc * wc).clamp_min(1e-12 * ww * cc)
    water = w - (cc * along_w - wc * along_c) / determinant
    calcium = c - (ww * along_c - wc * along_w) / determinant
    without_water = c - (along_c - wc * w) / cc
    return torch.stack([water.clamp_min(0), torch.where(water < 0, without_water, calcium)])


@dataclass(frozen=True)
class Decomposition:
    """Maps of water and calcium.

    Attributes:
        water: Density of water or soft tissue relative to water, (D, H, W); smooth inside metal.
        calcium_mg_ml: Calcium density, (D, H, W), mg/mL.
        single_mg_ml: Calcium from a single-attenuation reconstruction of the same data with known components, taking
            every voxel as water of normal density plus calcium, mg/mL.
        mask: Share of each voxel that no component fills; None without components.
        history: Root mean square of the weighted misfit, one per iteration.
    """

    water: Tensor
    calcium_mg_ml: Tensor
    single_mg_ml: Tensor
    mask: Tensor | None
    history: list[float] = field(default_factory=list)


def decompose(
    transmission: Tensor,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    spectra: Mapping[str, Spectrum],
    *,
    components: Sequence[KnownComponent] = (),
    config: PWLSConfig | None = None,
    scatter: Veil | Tensor | None = None,
    mask: Tensor | None = None,
    backend: str = "auto",
    progress: bool | None = False,
) -> Decomposition:
    """Water and calcium in each voxel, from views at two tube voltages or more, with the metal known.

    Proposed as an outlook by Cao et al. 2020; see also Tilley et al. 2018 (model-based material decomposition). With
    voxels w of water and c of calcium, the signal of view i at energy k is `T_ik exp(-mu_k A w - kappa_k A c)`, where T
    is the spectrum behind the known metal. The measured line integrals are fitted by weighted least squares with
    quadratic roughness. Views at different voltages need not share the same rays. Steps are separable in voxels, with a
    2 x 2 curvature of the two materials in each voxel, ordered subsets and Nesterov's momentum as in `pwls`. The start
    is a reconstruction of a single attenuation per voxel.

    Args:
        transmission: Measured intensity over the open beam's, (V, rows, cols).
        geometry: The views, whose `sources` name their spectra.
        grid: Voxels that contain everything in the beam.
        spectra: Detected spectra, keyed by source name.
        components: Registered metal components.
        config: Iterations, subsets and roughness weight, for the single attenuation and for both materials.
        scatter: See `prepare`.
        mask: 0 where a pixel holds no measurement.
        backend: Projector backend.
        progress: Show a tqdm bar; None: on a terminal only.

    Raises:
        ValueError: If the views have no sources, a source has no spectrum, or all spectra are alike.
    """
    config = config or PWLSConfig(iterations=30, subsets=10, beta=1.0)
    _check(geometry, spectra)
    if mask is not None:
        transmission = filled_transmission(transmission, mask)
    veil = scatter_image(transmission, scatter, geometry.pixel_spacing)
    primary = transmission - veil
    lines = floored_line_integrals(primary)
    weights = statistical_weights(primary, scatter=veil, mask=mask) * (primary > LEAST_TRANSMISSION)
    reference = sum(spectrum.mean_energy for spectrum in spectra.values()) / len(spectra)
    sources = [
        _source(name, spectrum, geometry, components, reference, backend, transmission)
        for name, spectrum in spectra.items()
    ]
    unknown = unknown_share(components, grid).to(transmission) if components else None
    system = VoxelSystem(geometry, grid, backend=backend)
    start = _one_attenuation(system, lines, weights, sources, unknown, config, grid)
    water, calcium = _split(start, sources[0].beam, unknown)
    solver = TwoMaterials(system, lines, weights, sources, unknown, config, grid.spacing, torch.stack([water, calcium]))
    steps = progress_bar(range(config.iterations), desc="water and calcium", shown=progress)
    history = [solver.iterate() for _ in steps]
    return Decomposition(solver.x[0], solver.x[1] * CALCIUM_UNIT, calcium_of(start, reference), unknown, history)


def _check(geometry: ConeBeamGeometry, spectra: Mapping[str, Spectrum]) -> None:
    if geometry.sources is None:
        raise ValueError("views need sources that name their spectra: the geometry has none")
    if missing := sorted(set(geometry.sources) - set(spectra)):
        raise ValueError(f"spectra must have one for each source, got none for {', '.join(missing)}")
    used = [spectra[name] for name in sorted(set(geometry.sources))]
    if max(s.mean_energy for s in used) - min(s.mean_energy for s in used) < 1.0:
        raise ValueError("two materials need two spectra: all mean energies are within 1 keV")


def _source(
    name: str,
    spectrum: Spectrum,
    geometry: ConeBeamGeometry,
    components: Sequence[KnownComponent],
    reference_kev: float,
    backend: str,
    like: Tensor,
) -> SpectralViews:
    views = [view for view, source in enumerate(geometry.sources or ()) if source == name]
    metals = [material(metal) for metal in known_materials(components)]
    beam = BeamModel.polyenergetic(metals, spectrum, reference_kev=reference_kev, num_bins=NUM_BINS)
    blocks = [share for _, share in component_shares(components, geometry.select(views), beam, backend=backend)]
    shares = torch.cat([block.to(like) for block in blocks], dim=1) if components else blocks[0].to(like)
    energies = beam.beam.energies_kev.tolist()
    basis = torch.stack([material("water").attenuation(energies), CALCIUM_UNIT * calcium_attenuation(energies)]).to(
        like
    )
    return SpectralViews(views, beam, shares, basis)


def _one_attenuation(
    system: VoxelSystem,
    lines: Tensor,
    weights: Tensor,
    sources: Sequence[SpectralViews],
    unknown: Tensor | None,
    config: PWLSConfig,
    grid: VolumeGrid,
) -> Tensor:
    """PWLS of all views, corrected to one reference energy; run twice, the second time with known mineral."""
    volume = torch.zeros(system.volume_shape).to(lines)
    for number in range(2):
        corrected, counted, mineral = torch.empty_like(lines), torch.empty_like(lines), None
        if number:
            mineral = projected(system, mineral_part(volume, sources[0].beam, mask=unknown))
        for source in sources:
            views = source.views
            part: Tensor | None = None if mineral is None else mineral[views]
            b, slope = without_components(lines[views], [(slice(None), source.shares)], source.beam, mineral=part)
            corrected[views], counted[views] = b, weights[views] * slope**2
        volume = pwls(
            system, corrected, counted, config, mask=unknown, initial=volume, roughness=VoxelRoughness(grid.spacing)
        ).volume
    return volume


def _split(volume: Tensor, beam: BeamModel, unknown: Tensor | None) -> tuple[Tensor, Tensor]:
    """Water, and calcium in CALCIUM_UNIT, from a single attenuation: the excess over water is taken as calcium."""
    excess = mineral_part(volume, beam, mask=None)
    return (volume - excess) / beam.water, excess / (
        CALCIUM_UNIT * float(calcium_attenuation((float(beam.reference_kev or 0),))[0])
    )
