"""How a limb stood in each view against where the geometry has it: detectors sag, sources wander, patients move."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, rigid_matrix, rotation_about
from torchkcreg.optimization.parameters import ParameterBlock
from torchkcreg.precision import ExactModule

_BESIDE_IMAGES = 30.0  # of the loss that a standard deviation of the images is worth


class ViewMotions(ExactModule):
    """A small rigid motion of the world for each view, before it is projected: ``P_v T_v``.

    A detector's offset and a source's are, but for a trace of perspective, such motions too. What all views have in
    common is the implants' pose; the prior leaves it there.

    Args:
        nodes: World positions (N, 3) about whose middle the motions turn, mm.
        num_views: V.
        likely_mm: Standard deviation of a translation along each axis, and of a rotation about each as what it moves
            nodes by, root mean square.

    Attributes:
        values: Buffer (V, 6): rotations, as mm at the nodes' radius of gyration, and translations, mm; world axes.
        weight: Buffer: loss for a value that is a standard deviation.
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
        """A copy of what it is, as tensors and plain types, for :meth:`of_kept`."""
        return {"likely_mm": self.likely_mm, **{name: getattr(self, name).clone() for name in self.exact_buffers}}

    @classmethod
    def of_kept(cls, kept: dict[str, Any]) -> ViewMotions:
        """What :meth:`kept` gave."""
        motions = cls(kept["center"][None], len(kept["values"]), kept["likely_mm"])
        for name in cls.exact_buffers:
            getattr(motions, name).copy_(kept[name])
        return motions

    def matrices(self, values: Tensor | None = None) -> Tensor:
        """Rigid motions (..., V, 4, 4) of values (..., V, 6); the present ones when None."""
        values = self.values if values is None else values
        turned, shifted = values[..., :3] / self.radius, values[..., 3:]
        return rigid_matrix(torch.zeros_like(shifted), shifted) @ rotation_about(self.center, turned)

    @property
    def rms_mm(self) -> float:
        """How far the motions move nodes, root mean square over the views."""
        return float(self.values.square().sum(-1).mean().sqrt())

    def corrected(self, geometry: ConeBeamGeometry) -> ConeBeamGeometry:
        """The geometry of the V views as they really were.

        Raises:
            ValueError: If it has another number of views.
        """
        if geometry.num_views != self.num_views:
            raise ValueError(f"motions of {self.num_views} views do not fit a geometry of {geometry.num_views}")
        return geometry.moved(self.matrices())


class ViewMotionSteps(ParameterBlock):
    """Steps of the motions of views, mm, from where they are.

    Args:
        motions: Whose values change.
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
        """The prior counts more than the images do.

        Views that are at odds with each other tell of a motion by far more than that. Motions that they agree on are
        told by magnification alone, which a model whose edges are off by a tenth of a pixel has wrong.
        """
        self.motions_of_views.weight.fill_(_BESIDE_IMAGES * loss)

    def values(self, steps: Tensor) -> Tensor:
        """Values (K, V, 6) after steps (K, D)."""
        return self.start + steps.unflatten(-1, (-1, 6))

    def motions(self, steps: Tensor) -> Tensor:
        """Motions (K, V, 4, 4) that steps (K, D) add to the present ones, before these."""
        return self._back @ self.motions_of_views.matrices(self.values(steps))

    def penalty(self, steps: Tensor) -> Tensor:
        """Squared values (K,) in standard deviations, weighted."""
        deviations = self.values(steps) / self.motions_of_views.likely_mm
        return self.motions_of_views.weight * deviations.square().sum((-2, -1))

    @torch.no_grad()
    def accept(self, steps: Tensor) -> None:
        """Moves the views by steps (D,)."""
        self.motions_of_views.values.copy_(self.values(steps[None])[0])
