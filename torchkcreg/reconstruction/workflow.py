"""Iterative reconstruction from measured transmissions in passes: each knows more of scatter and hardening."""

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
    """A reconstruction from transmissions.

    Attributes:
        volume: attenuation of the background (D, H, W) at the beam's reference energy, 1/mm; smooth inside metal. On a
            `TwoLevelGrid` an image (N,), see `TwoLevelGrid.volumes`.
        mask: share of each voxel that is background, of the volume's shape; None without components.
        data: line integrals and weights of the last pass.
        scatter: in units of the open beam, (V, rows, cols).
        history: records of the last pass.
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
    """PWLS of transmissions, with known components KC-Rec: ``mu_total = s mu + mu_implant``.

    The first pass takes the background for water as far as beam hardening goes. Each later one knows from the last
    volume what of a ray is mineral and, behind known metal, how much of the signal must be scatter.

    Args:
        transmission: measured intensity over the open beam's, (V, rows, cols). For scans that are larger than memory a
            function: called with a list of views, it gives their transmission and mask, (v, rows, cols) each.
        geometry: the views.
        grid: the voxels; of two levels, only the last pass is made on both, the others on the coarse one.
        beam: energies, and the attenuation of the components' materials, such as a registration's own.
        config: of each pass.
        components: metal in its registered place; none: plain PWLS.
        scatter: see `prepare`.
        mask: 0 where a pixel holds no measurement.
        passes: how many; 1 keeps the first estimates.
        initial: start volume (D, H, W) of the first pass.
        blur_sigma_px: the system's blur, detector pixels.
        shard: the share of the views that this process works on.
        backend: of the projectors.
        callbacks: called at the start and end of each pass and after each iteration; the run is the solver.
        state: where an earlier run stopped: "pass", "solver" (its state dict) and "volume", that of the pass before.
        progress: see `PWLS.run`.
        folder: for line integrals, weights and scatter of scans that are larger than memory; memory if None.
    """
    if passes < 1:
        raise ValueError(f"passes must be at least 1, got {passes}")
    beam = BeamModel.behind(beam) if isinstance(beam, Beam) else beam
    coarse = grid.coarse if isinstance(grid, TwoLevelGrid) else grid
    system = VoxelSystem(geometry, coarse, backend=backend)
    shape = (geometry.num_views, *geometry.det_shape)
    read, kept = views_reader(transmission, mask, shape), isinstance(transmission, Tensor)
    views = _Views(system, read, beam, components, scatter, blur_sigma_px, keep_shares=kept)
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
        raise ValueError(f"the state is of pass {start}, but there are only {passes}")
    return done


class _Views:
    """A scan's views, some at a time, on their way to line integrals and weights."""

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
        """Blocks of views, and what metal lets through in them; kept from pass to pass where there is the memory."""
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
        """Line integrals and weights of all views, and their scatter, with what a volume (D, H, W) tells of them."""
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
            own, share = self.scatter, share.to(transmission)
            first = scatter_image(transmission, own[views] if isinstance(own, Tensor) else own, geometry.pixel_spacing)
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
        """The scatter that must be in the metal's shadow for what is measured there to be what the volume shows."""
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
    """Of a pass on one level or two, from a coarse volume."""
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
    solver.initial = initial  # the coarse volume, from which a resumed run prepares its data anew
    return solver
