"""Which views to take: expected errors of a registration before there are any images."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.scene import RegistrationData, Scene

from .config import RegistrationConfig
from .estimated_background import facing_data
from .stage import StageRun
from .uncertainty import likeness

_BIN = 8  # expected errors need no finer pixels
_AT_ONCE = 50  # views
_LOSS = 1.5e-5  # that one view has, typically, where a parameter is a standard deviation off what it says
_MOST_SETS = 6000
_SETS_AT_ONCE = 1000


@dataclass(frozen=True)
class PlannedSet:
    """A set of views and its expected error.

    Attributes:
        views: Numbers of the views.
        node_std_mm: Expected error of the implant's nodes (RMS).
    """

    views: tuple[int, ...]
    node_std_mm: float


@dataclass(frozen=True, eq=False)
class ViewInformation:
    """Information that each view of a scan would give about a scene in its present state.

    Attributes:
        views: Numbers of the V views.
        curvature: Curvature of 1 minus each view's similarity, (V, D, D).
        penalties: Curvature of penalties and priors, (D, D).
        nodes: Mean square displacement of the nodes as a quadratic form of the parameters, (D, D), mm^2.
        alike: Similarity of direction of each pair of views, (V, V).
    """

    views: tuple[int, ...]
    curvature: Tensor
    penalties: Tensor
    nodes: Tensor
    alike: Tensor

    @torch.no_grad()
    def expected(self, sets: Tensor) -> Tensor:
        """Expected errors (S,) of the nodes, mm, for sets (S, n) of places among the views.

        The sandwich of `Uncertainty.covariance`, with a typical disagreement between a view's
        pixel blocks.
        """
        errors = []
        for batch in sets.split(_SETS_AT_ONCE):
            number = batch.shape[1]
            images = self.curvature[batch].mean(1)
            shared = self.alike[batch[:, :, None], batch[:, None, :]].sum((1, 2)) / number
            whole = images + self.penalties
            size = whole.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
            bread = torch.linalg.inv(
                whole + 1e-9 * size * torch.eye(len(self.nodes), dtype=whole.dtype, device=whole.device)
            )
            meat = 2 * _LOSS / number * shared[:, None, None] * images
            errors.append(torch.einsum("sde,sef,sfd->s", bread, meat, bread @ self.nodes).clamp_min(0).sqrt())
        return torch.cat(errors)

    def best(self, number: int, *, among: Sequence[int] | None = None, kept: int = 10) -> list[PlannedSet]:
        """The best sets of `number` views, best first.

        All sets among evenly spaced views are ranked, of as many views as is affordable. The best set is then
        improved by exchanging single views and comes first.

        Args:
            number: Number of views in a set.
            among: Numbers of the views that may be taken; all when None.
            kept: Number of sets returned.
        """
        allowed = [i for i, view in enumerate(self.views) if among is None or view in set(among)]
        if len(allowed) < number:
            raise ValueError(f"there are {len(allowed)} views, fewer than the {number} that are to be planned")
        spaced = allowed
        while math.comb(len(spaced), number) > _MOST_SETS and len(spaced) > number:
            keep = max(number, int(len(spaced) * 0.9))
            spaced = [spaced[round(i * (len(spaced) - 1) / max(keep - 1, 1))] for i in range(keep)]
        sets = torch.tensor(list(itertools.combinations(spaced, number)), device=self.curvature.device)
        errors = self.expected(sets)
        order = errors.argsort()[:kept].tolist()
        first = self._exchanged(sets[order[0]], float(errors[order[0]]), allowed)
        ranked = [first, *((sets[place], float(errors[place])) for place in order)]
        unique = {tuple(sorted(self.views[i] for i in places.tolist())): error for places, error in ranked}
        return [PlannedSet(views, error) for views, error in unique.items()][:kept]

    def _exchanged(self, views: Tensor, error: float, allowed: Sequence[int]) -> tuple[Tensor, float]:
        while True:
            trials = []
            for place in range(len(views)):
                for other in allowed:
                    if other not in views.tolist():
                        trial = views.clone()
                        trial[place] = other
                        trials.append(trial)
            if not trials:
                return views, error
            errors = self.expected(torch.stack(trials))
            best = int(errors.argmin())
            if float(errors[best]) >= error * (1 - 1e-4):
                return views, error
            views, error = trials[best], float(errors[best])


@torch.no_grad()
def view_information(
    scene: Scene, geometry: ConeBeamGeometry, config: RegistrationConfig, views: Sequence[int] | None = None
) -> ViewInformation:
    """Information that views of a scan would give about a scene; no images are needed.

    Images are rendered. A view's information is the curvature of its residuals in all parameters of the last stage.
    Bone is unknown and not modelled.

    Args:
        scene: The implant and its screws about where they will be.
        geometry: All views that could be taken.
        config: Options of the planned registration.
        views: Numbers of the views to consider; all when None.
    """
    numbers = list(range(geometry.num_views)) if views is None else list(views)
    stage = config.schedule()[-1]
    stage = stage.model_copy(update={"bin": _BIN, "before": (), "after": ()})
    curvature, objective = [], None
    for start in range(0, len(numbers), _AT_ONCE):
        batch = geometry.select(numbers[start : start + _AT_ONCE])
        lines = scene(batch)
        data = RegistrationData(batch, lines, torch.ones_like(lines, dtype=torch.bool))
        run = StageRun(scene, facing_data(scene, data, config), stage, config)
        objective = run.objective
        jacobian, _ = objective.jacobian(objective.at_rest[0])
        flat = jacobian.transpose(0, 1).flatten(2).double()
        curvature.append(0.5 * flat @ flat.mT)
    if objective is None:
        raise ValueError("there are no views to plan with")
    moves, rest = objective.moves, objective.at_rest[0]
    penalties = torch.autograd.functional.hessian(lambda p: moves.penalty(p[None])[0], rest)
    nodes = torch.zeros_like(penalties)
    for number, assembly in enumerate(scene):
        place = moves.places[f"motion of {assembly.name}"]
        points, slopes = moves.slopes(number)
        nodes[place, place] = torch.einsum("dni,eni->de", slopes, slopes) / len(points) / len(scene.assemblies)
    placed = scene.assemblies[0].nodes()
    sources = geometry.select(numbers).source_positions.to(placed)
    seen = torch.cat(curvature).nan_to_num()  # a view that does not see the implant tells nothing
    return ViewInformation(tuple(numbers), seen, penalties, nodes, likeness(sources, placed))
