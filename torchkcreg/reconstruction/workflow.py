"""Iterative reconstruction from measured transmissions in passes that refine the scatter and hardening corrections."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.callbacks import Callback
from torchkcreg.geometry import ConeBeamGeometry, TwoLevelGrid, VolumeGrid
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import Beam, Veil
from torchkcreg.progress import progress_bar

from .corrections import refined_scatter, scatter_image
from .kcrec import component_shares, unknown_share
from .preparation import PreparedData, prepare
from .pwls import PWLS, PWLSConfig
from .scan_views import ReadViews, ViewShard, Workspace, views_reader
from .spectral import BeamModel, mineral_part, transmitted_behind
from .system import VoxelRoughness, VoxelSystem
from .two_levels import TwoLevelRoughness, TwoLevelSystem

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class IterativeResult:
    """Result of an iterative reconstruction from transmissions.

    Attributes:
        volume: Attenuation of the background (D, H, W) at the beam's reference energy, 1/mm; smooth inside metal. On a
            `TwoLevelGrid` an image (N,), see `TwoLevelGrid.volumes`.
        mask: Share of each voxel that is background, of the volume's shape; None without components.
        data: Line integrals and weights of the last pass.
        scatter: Scatter image in units of the open beam, (V, rows, cols).
        history: Records of the last pass, one per iteration.
    """

    volume: Tensor
    mask: Tensor | None
    data: PreparedData
    scatter: Tensor
    history: list[dict[str, Any]] = field(default_factory=list)


def reconstruct(
    transmission: Tensor | ReadViews,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid | TwoLevelGrid,
    beam: BeamModel | Beam,
    *,
    config: PWLSConfig | None = None,
    components: Sequence[KnownComponent] = (),
    scatter: Veil | Tensor | None = None,
    mask: Tensor | None = None,
    passes: int = 2,
    initial: Tensor | None = None,
    blur_sigma_px: float = 0.0,
    shard: ViewShard | None = None,
    backend: str = "auto",
    callbacks: Sequence[Callback] = (),
    state: dict[str, Any] | None = None,
    progress: bool | None = False,
    folder: Path | None = None,
) -> IterativeResult:
    """Reconstruct transmissions by PWLS; with known components this is KC-Rec: `mu_total = s mu + mu_implant`.

    The first pass corrects beam hardening as if the background were water. Each later pass uses the previous volume:
    its mineral part refines the hardening correction, and behind known metal its projection refines the scatter.

    Args:
        transmission: Measured intensity over the open beam's, (V, rows, cols). For scans larger than memory, a function
            that returns transmission and mask, (v, rows, cols) each, of a list of views.
        geometry: The views.
        grid: The voxels. With a `TwoLevelGrid` only the last pass uses both levels; earlier ones use the coarse level.
        beam: Energies and the attenuation of the components' materials, for example from a registration.
        config: PWLS options of each pass.
        components: Registered metal components; plain PWLS if empty.
        scatter: See `prepare`.
        mask: 0 where a pixel holds no measurement.
        passes: Number of passes; with 1 the initial corrections are not refined.
        initial: Initial volume (D, H, W) of the first pass.
        blur_sigma_px: The system's blur, detector pixels.
        shard: Views that this process works on, see `ViewShard`.
        backend: Projector backend.
        callbacks: Called at the start and end of each pass and after each iteration, with the solver as the run.
        state: State of an interrupted run: "pass", "solver" (its state dict) and "volume" of the previous pass.
        progress: See `PWLS.run`.
        folder: Folder for line integrals, weights and scatter of scans larger than memory; memory if None.
    """
    if passes < 1:
        raise ValueError(f"passes must be at least 1, got {passes}")
    beam = BeamModel.behind(beam) if isinstance(beam, Beam) else beam
    coarse = grid.coarse if isinstance(grid, TwoLevelGrid) else grid
    system = VoxelSystem(geometry, coarse, backend=backend)
    shape = (geometry.num_views, *geometry.det_shape)
    read, in_memory = views_reader(transmission, mask, shape), isinstance(transmission, Tensor)
    views = _Views(system, read, beam, components, scatter, blur_sigma_px, keep_shares=in_memory)
    space, volume, start, done = Workspace(folder), initial, 0, None
    if state is not None:
        start, volume = int(state["pass"]), state["volume"]
    for index in range(start, passes):
        log.info("pass %d of %d: %d views, %s voxels", index + 1, passes, geometry.num_views, coarse.shape)
        data, scattered = views.prepared(volume if index > 0 else None, space, progress=progress)
        level = grid if index == passes - 1 else coarse
        solver = _solver(system, data, level, config, components, views.unknown, volume, shard)
        if state is not None and index == start and state.get("solver") is not None:
            solver.load_state_dict(state["solver"])
        volume = solver.run(callbacks=callbacks, number=index, progress=progress).volume
        done = IterativeResult(volume, solver.mask if components else None, data, scattered, solver.history)
    if done is None:
        raise ValueError(f"the state is from pass {start}, but there are only {passes} passes")
    return done


class _Views:
    """Prepares a scan's line integrals and weights, block by block."""

    def __init__(
        self,
        system: VoxelSystem,
        read: ReadViews,
        beam: BeamModel,
        components: Sequence[KnownComponent],
        scatter: Veil | Tensor | None,
        blur_sigma_px: float,
        *,
        keep_shares: bool,
    ) -> None:
        self.system, self.read, self.beam, self.components = system, read, beam, components
        self.scatter, self.blur_sigma_px = scatter, blur_sigma_px
        self.like = read([0])[0]
        self.unknown = unknown_share(components, system.grid).to(self.like) if components else None
        self.keep_shares = keep_shares
        self.kept: list[tuple[slice, Tensor]] | None = None

    def shares(self) -> Iterable[tuple[slice, Tensor]]:
        """Blocks of views with their shares behind metal; cached between passes if the scan is in memory."""
        if self.kept is not None:
            return self.kept
        backend, blur = self.system.backend, self.blur_sigma_px
        shares = component_shares(self.components, self.system.geometry, self.beam, blur_sigma_px=blur, backend=backend)
        if not self.keep_shares:
            return shares
        self.kept = list(shares)
        return self.kept

    def prepared(
        self, volume: Tensor | None, space: Workspace, *, progress: bool | None
    ) -> tuple[PreparedData, Tensor]:
        """Line integrals and weights of all views, and their scatter, refined with a volume (D, H, W) if given."""
        geometry = self.system.geometry
        lines, weights, scattered = (
            space.empty((geometry.num_views, *geometry.det_shape), self.like) for _ in range(3)
        )
        seen = mineral = None
        if volume is not None:
            mineral = mineral_part(volume, self.beam, mask=self.unknown)
            seen = None if self.unknown is None else volume * self.unknown
        bar = progress_bar(total=geometry.num_views, desc="views", shown=progress)
        for block, share in self.shares():
            views = list(range(geometry.num_views))[block]
            transmission, mask = self.read(views)
            veil, share = self.scatter, share.to(transmission)
            first = scatter_image(
                transmission, veil[views] if isinstance(veil, Tensor) else veil, geometry.pixel_spacing
            )
            hard = None if mineral is None else self.system.project(mineral, views)
            if seen is not None and hard is not None:
                first = self._refined(transmission, first, self.system.project(seen, views), hard, share)
            blocks = [(slice(None), share)]
            part = prepare(
                transmission, geometry.select(views), self.beam, shares=blocks, scatter=first, mask=mask, mineral=hard
            )
            lines[block], weights[block], scattered[block] = part.line_integrals, part.weights, first
            bar.update(len(views))
        bar.close()
        return PreparedData(lines, weights), scattered

    def _refined(self, transmission: Tensor, scatter: Tensor, seen: Tensor, mineral: Tensor, share: Tensor) -> Tensor:
        """Scatter refined in the metal's shadow so that the measurement agrees with the volume's projection."""
        lines, _ = transmitted_behind(seen, share, self.beam, mineral=mineral)
        spacing = self.system.geometry.pixel_spacing
        return refined_scatter(transmission, scatter, torch.exp(-lines), share.sum(0), spacing)


def _solver(
    system: VoxelSystem,
    data: PreparedData,
    grid: VolumeGrid | TwoLevelGrid,
    config: PWLSConfig | None,
    components: Sequence[KnownComponent],
    unknown: Tensor | None,
    initial: Tensor | None,
    shard: ViewShard | None,
) -> PWLS:
    """Solver of one pass on one or two levels, starting from a coarse volume."""
    inputs = data.line_integrals, data.weights, config
    if not isinstance(grid, TwoLevelGrid):
        rough = VoxelRoughness(grid.spacing)
        return PWLS(system, *inputs, mask=unknown, initial=initial, roughness=rough, shard=shard)
    mask = (unknown_share(components, grid) if components else grid.active).to(data.weights)
    solver = PWLS(
        TwoLevelSystem(system.geometry, grid, backend=system.backend),
        *inputs,
        mask=mask,
        initial=None if initial is None else grid.divide(initial),
        roughness=TwoLevelRoughness(grid),
        shard=shard,
    )
    solver.initial = initial  # the coarse volume, needed by a resumed run to prepare its data again
    return solver
