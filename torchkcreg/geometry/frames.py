"""Views as vectors in the world: focal spot, detector centre, steps of its pixels; to and from other packages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry.circular import matrices_from_frames
from torchkcreg.geometry.cone_beam import ConeBeamGeometry

ALIKE = 1e-4  # how much pixel steps may differ from view to view, as a share


@dataclass(frozen=True)
class DetectorFrames:
    """Where source and detector of each view are, in world mm; all (V, 3), float64.

    Attributes:
        sources: focal spots.
        centers: middles of the detectors, of pixel ``((cols - 1)/2, (rows - 1)/2)``.
        col_steps: from a pixel's centre to that of the next column.
        row_steps: from a pixel's centre to that of the next row.
    """

    sources: Tensor
    centers: Tensor
    col_steps: Tensor
    row_steps: Tensor

    @classmethod
    def of(cls, geometry: ConeBeamGeometry) -> DetectorFrames:
        """Of a geometry; its pixel spacing says where along the rays the detector is.

        Raises:
            ValueError: the spacing does not fit the matrices.

        >>> from torchkcreg.geometry import circular_geometry
        >>> views = circular_geometry([0.0], sad=400, sdd=600, det_shape=(5, 5), pixel_spacing=(2.0, 1.0))
        >>> frames = DetectorFrames.of(views)
        >>> [[round(float(x)) for x in vectors[0]] for vectors in (frames.centers, frames.row_steps)]
        [[-200, 0, 0], [0, 0, 2]]
        """
        distances = geometry.detector_distances.detach()[:, None]
        inverse = torch.linalg.inv(geometry.projection_matrices.detach()[:, :, :3])
        rows, cols = geometry.det_shape
        middle = inverse.new_tensor([(cols - 1) / 2, (rows - 1) / 2, 1.0])
        sources = geometry.source_positions.detach()
        across, down = (distances * inverse[:, :, column] for column in (0, 1))
        return cls(sources, sources + distances * (inverse @ middle), across, down)

    def geometry(
        self,
        det_shape: Sequence[int],
        *,
        sources: Sequence[str] | None = None,
        angles_deg: Sequence[float] | None = None,
    ) -> ConeBeamGeometry:
        """The geometry of detectors of (rows, cols) pixels.

        Raises:
            ValueError: numbers that are not finite, or pixel steps that differ from view to view.
        """
        across, down = self.col_steps.double(), self.row_steps.double()
        for name, vectors in vars(self).items():
            if vectors.dim() != 2 or vectors.shape[1] != 3 or not bool(vectors.isfinite().all()):
                raise ValueError(f"{name} must be finite numbers of shape (V, 3), got {tuple(vectors.shape)}")
        lengths = torch.stack([down.norm(dim=-1), across.norm(dim=-1)], dim=-1)
        mean = lengths.mean(0)
        if not bool((lengths > 0).all()) or bool(((lengths / mean - 1).abs() > ALIKE).any()):
            raise ValueError(
                f"pixels must have one size in all views, got steps of {lengths.amin(0).tolist()} to "
                f"{lengths.amax(0).tolist()} mm"
            )
        spacing = (float(mean[0]), float(mean[1]))
        matrices = matrices_from_frames(
            self.sources,
            self.centers,
            across / lengths[:, 1:],
            down / lengths[:, :1],
            det_shape=det_shape,
            pixel_spacing=spacing,
        )
        return ConeBeamGeometry(matrices, det_shape, spacing, sources=sources, angles_deg=angles_deg)


def from_astra(vectors: Tensor, det_shape: Sequence[int]) -> ConeBeamGeometry:
    """The geometry of ASTRA's `cone_vec`: rows (V, 12) of source, detector centre, column step and row step, in mm.

    ASTRA's lengths are in units of its voxels: bring them to mm first. Its sinograms are (rows, V, cols), so views are
    ``sinogram.swapaxes(0, 1)``.

    Args:
        vectors: (V, 12).
        det_shape: (rows, cols).
    """
    vectors = torch.as_tensor(vectors).double()
    if vectors.dim() != 2 or vectors.shape[1] != 12:
        raise ValueError(f"cone_vec must have shape (V, 12), got {tuple(vectors.shape)}")
    return DetectorFrames(*vectors.split(3, dim=1)).geometry(det_shape)


def to_astra(geometry: ConeBeamGeometry) -> Tensor:
    """ASTRA's `cone_vec` (V, 12) of a geometry, lengths in mm; see `from_astra`.

    >>> from torchkcreg.geometry import circular_geometry
    >>> views = circular_geometry([0.0], sad=400, sdd=600, det_shape=(5, 5), pixel_spacing=(2.0, 1.0))
    >>> bool(torch.allclose(from_astra(to_astra(views), (5, 5)).projection_matrices, views.projection_matrices))
    True
    """
    frames = DetectorFrames.of(geometry)
    return torch.cat([frames.sources, frames.centers, frames.col_steps, frames.row_steps], dim=1)


def from_leap(
    source_positions: Tensor,
    module_centers: Tensor,
    row_vectors: Tensor,
    col_vectors: Tensor,
    *,
    det_shape: Sequence[int],
    pixel_spacing: Sequence[float],
) -> ConeBeamGeometry:
    """The geometry of LEAP's modular beam, all (V, 3) in mm, as `set_modularbeam` takes it.

    Args:
        source_positions: focal spots.
        module_centers: middles of the detectors.
        row_vectors: unit vectors along which the row index grows.
        col_vectors: unit vectors along which the column index grows.
        det_shape: (numRows, numCols).
        pixel_spacing: (pixelHeight, pixelWidth), mm.
    """
    positions, centers, down, across = (
        torch.as_tensor(x).double() for x in (source_positions, module_centers, row_vectors, col_vectors)
    )
    return DetectorFrames(positions, centers, pixel_spacing[1] * across, pixel_spacing[0] * down).geometry(det_shape)


def to_leap(geometry: ConeBeamGeometry) -> dict[str, Tensor]:
    """Vectors (V, 3) of LEAP's modular beam: what `from_leap` takes, by its names."""
    frames = DetectorFrames.of(geometry)
    return {
        "source_positions": frames.sources,
        "module_centers": frames.centers,
        "row_vectors": torch.nn.functional.normalize(frames.row_steps, dim=-1),
        "col_vectors": torch.nn.functional.normalize(frames.col_steps, dim=-1),
    }


def gantry_about_z(axis: str) -> Tensor:
    """The turn (4, 4) of a world whose gantry turns about an axis into one where it turns about z, handedness kept.

    RTK's gantry turns about y: its (x, y, z) become (z, x, y), so that the source of gantry angle b is at
    ``(sad cos b, sad sin b, 0)``, as in `circular_geometry`. Points of the old world are turned by it, and a geometry
    by ``geometry.moved(gantry_about_z(axis).inverse())``.

    Args:
        axis: "x", "y" or "z" of the old world.

    >>> (gantry_about_z("y")[:3, :3] @ torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)).tolist()
    [3.0, 1.0, 2.0]
    """
    turns = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}
    if axis not in turns:
        raise ValueError(f"axis must be x, y or z, got {axis!r}")
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    for row, column in enumerate((*turns[axis], 3)):
        matrix[row, column] = 1.0
    return matrix
