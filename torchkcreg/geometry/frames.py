"""Views as world vectors (focal spot, detector centre, pixel steps), and the change of a gantry's axis to z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .circular import matrices_from_frames
from .cone_beam import ConeBeamGeometry

ALIKE = 1e-4  # relative tolerance of pixel steps between views


@dataclass(frozen=True)
class DetectorFrames:
    """Source and detector position of each view in world mm; all (V, 3), float64.

    Attributes:
        sources: Focal spots.
        centers: Detector centres, at pixel `((cols - 1)/2, (rows - 1)/2)`.
        col_steps: Vectors from one pixel centre to that in the next column.
        row_steps: Vectors from one pixel centre to that in the next row.
    """

    sources: Tensor
    centers: Tensor
    col_steps: Tensor
    row_steps: Tensor

    @classmethod
    def of(cls, geometry: ConeBeamGeometry) -> DetectorFrames:
        """Frames of a geometry. Its pixel spacing determines the distance of the detector from the source.

        Raises:
            ValueError: The spacing does not fit the matrices.

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
        """The geometry of these frames with detectors of (rows, cols) pixels.

        Raises:
            ValueError: Numbers are not finite, or pixel steps differ between views.
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


def gantry_about_z(axis: str) -> Tensor:
    """Rotation (4, 4) from a world whose gantry rotates about `axis` to one where it rotates about z.

    RTK's gantry rotates about y: (x, y, z) becomes (z, x, y), so that the source at gantry angle b is at
    `(sad cos b, sad sin b, 0)`, as in `circular_geometry`. Handedness is preserved. Transform points of the old world
    by this matrix, and a geometry by `geometry.moved(gantry_about_z(axis).inverse())`.

    Args:
        axis: Rotation axis in the old world, "x", "y" or "z".

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
