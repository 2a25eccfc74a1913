"""Iterative reconstruction from measured transmissions in passes: each knows more of scatter and hardening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchkcreg.callbacks import Callback
from torchkcreg.geometry import ConeBeamGeometry, TwoLevelGrid, VolumeGrid
from torchkcreg.physics import Beam, Veil
from torchkcreg.scene import KnownComponent

from .corrections import refined_scatter, scatter_image
from .known_component import component_shares, unknown_share
from .preparation import PreparedData, prepare
from .pwls import PWLS
from .pwls_config import PWLSConfig
from .roughness import VoxelRoughness
from .sharding import ViewShard
from .spectral import BeamModel, mineral_part, transmitted_behind
from .system import VoxelSystem, projected
from .two_levels import TwoLevelRoughness, TwoLevelSystem


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
    transmission: Tensor,
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
) -> IterativeResult:
    """PWLS of transmissions, with known components KC-Rec: ``mu_total = s mu + mu_implant``.

    The first pass takes the background for water as far as beam hardening goes. Each later one knows from the last
    volume what of a ray is mineral and, behind known metal, how much of the signal must be scatter.

    Args:
        transmission: measured intensity over the open beam's, (V, rows, cols).
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
    """
    if passes < 1:
        raise ValueError(f"passes must be at least 1, got {passes}")
    beam = BeamModel.behind(beam) if isinstance(beam, Beam) else beam
    coarse = grid.coarse if isinstance(grid, TwoLevelGrid) else grid
    system = VoxelSystem(geometry, coarse, backend=backend)
    unknown = unknown_share(components, coarse).to(transmission) if components else None
    first = scatter = scatter_image(transmission, scatter, geometry.pixel_spacing)
    shares = list(
        component_shares(components, geometry, beam, blur_sigma_px=blur_sigma_px, backend=backend)
    )  # the same in all passes
    volume, start, done = initial, 0, None
    if state is not None:
        start, volume = int(state["pass"]), state["volume"]
    for index in range(start, passes):
        mineral = None
        if index > 0 and volume is not None:
            mineral = projected(system, mineral_part(volume, beam, mask=unknown))
            if components:
                visible = volume if unknown is None else volume * unknown
                seen = projected(system, visible)
                scatter = _refined(transmission, first, seen, mineral, shares, beam, geometry.pixel_spacing)
        data = prepare(transmission, geometry, beam, shares=shares, scatter=scatter, mask=mask, mineral=mineral)
        level = grid if index == passes - 1 else coarse
        solver = _solver(system, data, level, config, components, unknown, volume, shard)
        if state is not None and index == start and state.get("solver") is not None:
            solver.load_state_dict(state["solver"])
        volume = solver.run(callbacks=callbacks, number=index, progress=progress).volume
        done = IterativeResult(volume, solver.mask if components else None, data, scatter, solver.history)
    if done is None:
        raise ValueError(f"the state is of pass {start}, but there are only {passes}")
    return done


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
    return PWLS(
        TwoLevelSystem(system.geometry, grid, backend=system.backend),
        *inputs,
        mask=mask,
        initial=None if initial is None else grid.divide(initial),
        roughness=TwoLevelRoughness(grid),
        shard=shard,
    )


def _refined(
    transmission: Tensor,
    scatter: Tensor,
    background: Tensor,
    mineral: Tensor,
    shares: Sequence[tuple[slice, Tensor]],
    beam: BeamModel,
    pixel_spacing: Sequence[float],
) -> Tensor:
    refined = scatter.clone()
    for block, share in shares:
        share = share.to(transmission)
        line_integrals, _ = transmitted_behind(background[block], share, beam, mineral=mineral[block])
        primary = torch.exp(-line_integrals)
        refined[block] = refined_scatter(transmission[block], scatter[block], primary, share.sum(0), pixel_spacing)
    return refined
