"""Known components in a reconstruction: the registered implant as mask and as path lengths (KC-Rec)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, TwoLevelGrid, VolumeGrid
from torchkcreg.implant import KnownComponent
from torchkcreg.projector import project_points

from .spectral import BeamModel, background_line_integrals, behind_metal

BLOCK_VIEWS = 8
COVERED = 0.999  # a voxel as full as this of metal shows nothing of the background


def known_materials(components: Sequence[KnownComponent]) -> list[str]:
    """Names of the components' materials, in the order of the path lengths."""
    return list(dict.fromkeys(component.material for component in components))


def unknown_share(components: Sequence[KnownComponent], grid: VolumeGrid | TwoLevelGrid) -> Tensor:
    """The mask s, (D, H, W) or (N,) on two levels: the share of each voxel that no component fills.

    >>> import trimesh
    >>> ball = KnownComponent.from_mesh(trimesh.creation.icosphere(2, 3.0), "steel", pitch=0.5)
    >>> unknown_share([ball], VolumeGrid.centered((3, 3, 3), 1.0))[1, 1, 1].item()
    0.0
    """
    if isinstance(grid, TwoLevelGrid):
        return grid.join(unknown_share(components, grid.coarse), unknown_share(components, grid.fine))
    filled = sum((component.fraction(grid) for component in components), torch.zeros(grid.shape))
    share = (1 - filled).clamp(0, 1)
    return torch.where(filled > COVERED, torch.zeros_like(share), share)


def component_path_lengths(
    components: Sequence[KnownComponent], geometry: ConeBeamGeometry, *, oversampling: int = 1, backend: str = "auto"
) -> Tensor:
    """Path lengths in mm (M, V, rows, cols), one image a material and view, on pixels `oversampling` times finer."""
    fine = geometry.refined(oversampling) if oversampling > 1 else geometry
    images = []
    for name in known_materials(components):
        clouds = [component.cloud for component in components if component.material == name]
        total = torch.zeros(fine.num_views, *fine.det_shape)
        for cloud in clouds:
            total += project_points(
                cloud.points.float(),
                cloud.volumes.float(),
                fine.projection_matrices.float(),
                fine.det_shape,
                cell=cloud.cell.float(),
                backend=backend,
            )
        images.append(total)
    return torch.stack(images) if images else torch.zeros(0, fine.num_views, *fine.det_shape)


def component_shares(
    components: Sequence[KnownComponent],
    geometry: ConeBeamGeometry,
    beam: BeamModel,
    *,
    oversampling: int = 4,
    blur_sigma_px: float = 0.0,
    backend: str = "auto",
) -> Iterator[tuple[slice, Tensor]]:
    """Blocks of views, and the share (K, v, rows, cols) of each energy that the components let through in them.

    Without components the shares are the beam's own (K, 1, 1, 1).

    Args:
        components: the metal; may be empty.
        geometry: the views.
        beam: with one attenuation for each of `known_materials`.
        oversampling: sub-pixels along each side of a pixel: the mean of exponentials is not that of the mean.
        blur_sigma_px: the system's blur, detector pixels.
        backend: of the projection.

    Raises:
        ValueError: the beam lacks the attenuation of a material.
    """
    if len(beam.attenuation) != len(known_materials(components)):
        names = ", ".join(known_materials(components)) or "none"
        raise ValueError(f"beam must have the attenuation of each material ({names}), got {len(beam.attenuation)}")
    for start in range(0, geometry.num_views, BLOCK_VIEWS):
        block = slice(start, start + BLOCK_VIEWS)
        if not components:
            yield block, beam.weights[:, None, None, None]
            continue
        paths = component_path_lengths(components, geometry.select(block), oversampling=oversampling, backend=backend)
        yield block, behind_metal(paths, beam, pooling=oversampling, blur_sigma_px=blur_sigma_px)


def without_components(
    line_integrals: Tensor,
    shares: Iterable[tuple[slice, Tensor]],
    beam: BeamModel,
    *,
    mineral: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Line integrals b of what is not known, and the derivative of the measured ones to them, both (V, rows, cols).

    ``y = -ln sum_k T_k exp(-r_k b)``: known components attenuate and harden the beam as their material and path length
    say, and the rest is solved for (`background_line_integrals`). With a `BeamModel.monoenergetic` that is
    ``b = y - sum_m mu_m L_m`` up to the averaging over pixels, the model of Cao et al. 2020. Without components it is
    the correction of the background's own beam hardening.

    Args:
        line_integrals: y, without scatter, (V, rows, cols).
        shares: from `component_shares`, or blocks of views with `behind_metal` of path lengths of the user's own.
        beam: energies.
        mineral: line integrals of the part of the background that is mineral, (V, rows, cols); see `mineral_part`.
    """
    unknown, slope = torch.empty_like(line_integrals), torch.empty_like(line_integrals)
    for block, share in shares:
        part = None if mineral is None else mineral[block]
        unknown[block], slope[block] = background_line_integrals(
            line_integrals[block], share.to(line_integrals), beam, mineral=part
        )
    return unknown, slope


def with_components(
    volume: Tensor, components: Sequence[KnownComponent], grid: VolumeGrid, values: Sequence[float]
) -> Tensor:
    """``s * mu + mu_implant`` (D, H, W): the background with the metal in its place.

    Args:
        volume: background, (D, H, W).
        components: the metal.
        grid: the voxels.
        values: attenuation of each of `known_materials`, 1/mm.
    """
    total = volume * unknown_share(components, grid).to(volume)
    for name, value in zip(known_materials(components), values, strict=True):
        for component in components:
            if component.material == name:
                total = total + value * component.fraction(grid).to(volume)
    return total
