"""Known components in a reconstruction (KC-Rec): the registered implant as mask and as path lengths."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, TwoLevelGrid, VolumeGrid
from torchkcreg.implant import KnownComponent
from torchkcreg.projector import project_points

from .spectral import BeamModel, background_line_integrals, behind_metal

BLOCK_VIEWS = 8
COVERED = 0.999  # a voxel filled with metal to more than this share counts as metal only


def known_materials(components: Sequence[KnownComponent]) -> list[str]:
    """Names of the components' materials, in the order of the path lengths."""
    return list(dict.fromkeys(component.material for component in components))


def unknown_share(components: Sequence[KnownComponent], grid: VolumeGrid | TwoLevelGrid) -> Tensor:
    """Mask s, (D, H, W) or (N,) on two levels: the fraction of each voxel that is not filled by a component.

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
    """Path lengths (M, V, rows, cols) in mm, one image per material and view, on pixels `oversampling` times finer."""
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
    """Blocks of views, each with the energies' shares (K, v, rows, cols) of the signal behind the components.

    Without components the shares are the beam's weights (K, 1, 1, 1).

    Args:
        components: The metal; may be empty.
        geometry: The views.
        beam: Beam with one attenuation for each of `known_materials`.
        oversampling: Sub-pixels along each side of a pixel, because transmissions, not path lengths, are averaged.
        blur_sigma_px: The system's blur, detector pixels.
        backend: Projector backend.

    Raises:
        ValueError: If the beam lacks the attenuation of a material.
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
    """Line integrals b of the background, and the derivative of the measured ones by them, both (V, rows, cols).

    Solves `y = -ln sum_k T_k exp(-r_k b)` for b (`background_line_integrals`): the known components attenuate and
    harden the beam according to their material and path length. With a `BeamModel.monoenergetic` this is
    `b = y - sum_m mu_m L_m` up to the averaging over pixels, the model of Cao et al. 2020. Without components it is
    a beam hardening correction of the background.

    Args:
        line_integrals: Measured y without scatter, (V, rows, cols).
        shares: From `component_shares`, or blocks of views with `behind_metal` of your own path lengths.
        beam: Energies and the background's relative attenuation.
        mineral: Line integrals of the background's mineral part, (V, rows, cols); see `mineral_part`.
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
    """`s * mu + mu_implant` (D, H, W): the background with the metal inserted.

    Args:
        volume: Background, (D, H, W).
        components: The metal.
        grid: The voxels.
        values: Attenuation of each of `known_materials`, 1/mm.
    """
    total = volume * unknown_share(components, grid).to(volume)
    for name, value in zip(known_materials(components), values, strict=True):
        for component in components:
            if component.material == name:
                total = total + value * component.fraction(grid).to(volume)
    return total
