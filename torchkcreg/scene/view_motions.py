"""Motion of the limb in each view relative to the geometry: detectors sag, sources wander, patients move."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, rigid_matrix, rotation_about
from torchkcreg.optimization.parameters import ParameterBlock
from torchkcreg.precision import ExactModule

_BESIDE_IMAGES = 30.0  # times the loss of one standard deviation of the images


class ViewMotions(ExactModule):
    """A small rigid motion of the world for each view, before it is projected: `P_v T_v`.

    An offset of detector or source is, up to a little perspective, such a motion too. A motion common to all views
    belongs to the implants' pose; the prior keeps it there.

    Args:
        nodes: World positions (N, 3), mm; the motions rotate about their mean.
        num_views: Number of views V.
        likely_mm: Standard deviation of the translation along each axis, and of the rotation about each axis as root
            mean square displacement of the nodes.

    Attributes:
        values: Buffer (V, 6): rotations, as mm at the nodes' radius of gyration, and translations, mm; world axes.
        weight: Buffer: loss for a value of one standard deviation.
    """

    exact_buffers: ClassVar[tuple[str, ...]] = ("values", "weight", "center", "radius")
    values: Tensor
    weight: Tensor
    center: Tensor
    radius: Tensor

    def __init__(self, nodes: Tensor, num_views: int, likely_mm: float) -> None:
        super().__init__()
        nodes = nodes.double()
        self.likely_mm, self.num_views = likely_mm, num_views
        self.register_buffer("center", nodes.mean(0))
        self.register_buffer("radius", (nodes - self.center).square().sum(-1).mean().sqrt())
        self.register_buffer("values", nodes.new_zeros(num_views, 6))
        self.register_buffer("weight", nodes.new_tensor(1e-6))

    def kept(self) -> dict[str, Any]:
        """Copy of the state, as tensors and plain types, for `of_kept`."""
        return {"likely_mm": self.likely_mm, **{name: getattr(self, name).clone() for name in self.exact_buffers}}

    @classmethod
    def of_kept(cls, kept: dict[str, Any]) -> ViewMotions:
        """The motions that `kept` copied."""
        motions = cls(kept["center"][None], len(kept["values"]), kept["likely_mm"])
        for name in cls.exact_buffers:
            getattr(motions, name).copy_(kept[name])
        return motions

    def matrices(self, values: Tensor | None = None) -> Tensor:
        """Rigid motions (..., V, 4, 4) of values (..., V, 6); of the present values when None."""
        values = self.values if values is None else values
        turned, shifted = values[..., :3] / self.radius, values[..., 3:]
        return rigid_matrix(torch.zeros_like(shifted), shifted) @ rotation_about(self.center, turned)

    @property
    def rms_mm(self) -> float:
        """Displacement of the nodes, root mean square over the views."""
        return float(self.values.square().sum(-1).mean().sqrt())

    def corrected(self, geometry: ConeBeamGeometry) -> ConeBeamGeometry:
        """The geometry of the V views with the motions applied.

        Raises:
            ValueError: If the geometry has another number of views.
        """
        if geometry.num_views != self.num_views:
            raise ValueError(f"motions of {self.num_views} views do not fit a geometry of {geometry.num_views}")
        return geometry.moved(self.matrices())


class ViewMotionSteps(ParameterBlock):
    """Steps of the view motions from their present values, mm.

    Args:
        motions: The motions that the steps change.
    """

    def __init__(self, motions: ViewMotions) -> None:
        self.motions_of_views, self.start = motions, motions.values.clone()
        self.num_parameters = motions.values.numel()
        self._back = torch.linalg.inv(motions.matrices())

    @property
    def loss_of_deviation(self) -> float:  # type: ignore[override]
        """The prior's weight."""
        return float(self.motions_of_views.weight)

    def weigh(self, loss: float) -> None:
        """Set the prior's weight to a multiple of the images' loss per standard deviation.

        Motions by which views contradict each other show far more strongly than this prior. Motions common to all views
        show by magnification alone, which is wrong if the model's edges are off by a tenth of a pixel.
        """
        self.motions_of_views.weight.fill_(_BESIDE_IMAGES * loss)

    def values(self, steps: Tensor) -> Tensor:
        """Values (K, V, 6) after steps (K, D)."""
        return self.start + steps.unflatten(-1, (-1, 6))

    def motions(self, steps: Tensor) -> Tensor:
        """Motions (K, V, 4, 4) that steps (K, D) add, applied before the present ones."""
        return self._back @ self.motions_of_views.matrices(self.values(steps))

    def penalty(self, steps: Tensor) -> Tensor:
        """Weighted squared values (K,), in standard deviations."""
        deviations = self.values(steps) / self.motions_of_views.likely_mm
        return self.motions_of_views.weight * deviations.square().sum((-2, -1))

    @torch.no_grad()
    def accept(self, steps: Tensor) -> None:
        """Move the views by steps (D,)."""
        self.motions_of_views.values.copy_(self.values(steps[None])[0])
