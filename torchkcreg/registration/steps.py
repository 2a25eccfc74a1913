"""What a stage does before and after its optimiser, as steps under names that a schedule calls them by."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchkcreg.scene import Assembly, Moves, ViewMotions

from .config import Stage
from .objective import Objective
from .screw_search import find_screws, of_best_metal, screws_by_metal
from .stage import StageRun, Step, coarse
from .verdict import Rival

_WEIGHINGS = 2
_LEAST_STRENGTH = 25.0  # in simulations up to 16 where the geometry was right, 70 and more where it was off by 0.3 mm
_STEP_MM = 2.0  # a coarse image's optimum is a few mm wide
_WORSE = 1.5  # times the least loss: what fits no better is no candidate
_MOST = 3
_SCREW_BIN = 8  # a screw is thinner than a coarser pixel
_FEWEST_VIEWS = 2  # one alone is at odds with none
_LOOKS = ("find_screws", "choose_screws")


class ViewEvidence(NamedTuple):
    """What motions of the views would explain of the images.

    Attributes:
        motion_mm: How far the likeliest of them move the nodes, root mean square over the views.
        strength: By how much the loss would fall, in losses of a deviation for each of their parameters that the images
            determine: about one where nothing moved.
    """

    motion_mm: float
    strength: float

    @property
    def is_strong(self) -> bool:
        """Whether the views have moved."""
        return self.strength > _LEAST_STRENGTH


def view_evidence(objective: Objective) -> ViewEvidence:
    """What motions of the views would explain beside all else that is free in an objective; their prior is weighed.

    A deviation is measured by what would be left of the residual images where the views had moved: what they are at
    odds about now may be all that is left.
    """
    rest = objective.at_rest[0]
    jacobian, residuals = objective.jacobian(rest)
    left = residuals
    for _ in range(_WEIGHINGS):
        objective.moves["views"].weigh(objective.uncertainty_from(jacobian, left, rest).loss_of_a_deviation)
        known = objective.uncertainty_from(jacobian, left, rest)  # with that weight
        slope = 0.5 / len(residuals) * (jacobian.flatten(1) @ residuals.flatten()).double()
        slope = slope + _slope(objective, rest)
        step, gain, number = _best(known.images + known.penalties, known.images, slope)
        left = residuals + torch.einsum("d,dvkij->vkij", step.to(jacobian), jacobian)
    views = objective.moves.places["views"]
    others = torch.ones_like(slope, dtype=torch.bool)
    others[views] = False
    images, whole = (m[others][:, others] for m in (known.images, known.images + known.penalties))
    _, less, fewer = _best(whole, images, slope[others])
    motion = step[views].unflatten(0, (-1, 6)).square().sum(-1).mean().sqrt()
    told = (number - fewer).clamp_min(1.0)
    return ViewEvidence(float(motion), float((gain - less) / (known.loss_of_a_deviation * told)))


def _slope(objective: Objective, at: Tensor) -> Tensor:
    """Gradient (D,) of what speaks against parameters (D,) but the images."""
    leaf = at.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(objective.penalty(leaf[None])[0], leaf)
    return slope


def _best(curvature: Tensor, images: Tensor, slope: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The step to the optimum, by how much the loss falls on it, and how many parameters the images determine."""
    same = torch.eye(len(curvature), dtype=curvature.dtype, device=curvature.device)
    inverse = torch.linalg.inv(curvature + 1e-9 * curvature.diagonal().mean() * same)
    step = -inverse @ slope
    return step, -0.5 * slope @ step, (inverse @ images).trace()


@torch.no_grad()
def places(objective: Objective, found: Tensor) -> list[Tensor]:
    """Parameters (D,) of a rigid stage from which the registration is worth trying, that found first.

    Others are where the loss has a minimum along an implant's long axis, up to half its length away, and the start,
    where the stage left it by more than a few steps: coarse pixels may prefer another place without seeing the holes.

    Args:
        objective: Of a rigid stage.
        found: Where the stage ended, shape (D,).
    """
    moves, others = objective.moves, []
    for number, assembly in enumerate(objective.scene):
        points = assembly.implant.points.double()
        steps = int(0.5 * float((points.amax(0) - points.amin(0)).norm()) / _STEP_MM)
        shifts = _STEP_MM * torch.arange(-steps, steps + 1, dtype=torch.float64, device=found.device)
        along = found + shifts[:, None] * moves.shift(number, assembly.implant.principal_axes()[1][2])
        losses = objective.losses(along)
        padded = torch.nn.functional.pad(losses[None], (1, 1), value=torch.inf)[0]
        minimum = (losses < padded[:-2]) & (losses <= padded[2:]) & (losses <= _WORSE * losses.min())
        minimum[steps - 1 : steps + 2] = False  # that is where it is
        order = losses.argsort()
        others += [along[i] for i in order.tolist() if minimum[i]][: _MOST - 1]
    start = torch.zeros_like(found)
    if _distance(moves, found, start) > 3 * _STEP_MM:
        others.append(start)
    return [found, *others]


def _distance(moves: Moves, one: Tensor, other: Tensor) -> float:
    """Root mean square distance of the implants' nodes, mm."""
    moved = moves.displacements(torch.stack([one, other]))
    return float((moved[0] - moved[1]).norm())


def find(run: StageRun) -> None:
    """Looks for screws in the holes of implants to which none were given; they are their components from now on."""
    for assembly in _with_holes(run):
        assembly.place(find_screws(run.scene, assembly, run.data, bin=min(run.stage.bin, _SCREW_BIN)))
        run.renew()


def choose(run: StageRun) -> None:
    """Finds screws in every metal, runs the stage with each, and keeps what explains the images best.

    Coarse images without the stage's motion tell metals badly. Of several implants each chooses while the others keep
    what they have.
    """
    rest = list(run.remaining)
    for assembly in _with_holes(run):
        trials = []
        for screws, _ in screws_by_metal(run.scene, assembly, run.data, bin=min(run.stage.bin, _SCREW_BIN)):
            assembly.place(screws)
            trial = replace(run, remaining=list(rest), optimizer=None, reports=[], _objective=None)
            trial.prepare()
            trial.optimize()
            trials.append((screws, float(trial.objective.losses(trial.begin().best()[None])[0]), trial))
        best = of_best_metal([(screws, loss) for screws, loss, _ in trials])
        assembly.place(best)
        run.renew()
        if len(_with_holes(run)) == 1:  # with others to come it must run again
            chosen = next(trial for screws, _, trial in trials if screws == best)
            run.data, run.objective, run.remaining = chosen.data, chosen.objective, []
            run.optimizer, run.reports = chosen.optimizer, chosen.reports


def estimate_background(run: StageRun) -> None:
    """Estimates what the scene lacks (bone, water) as a smooth path length, which DRRs include."""
    run.with_background()


def reweight(run: StageRun) -> None:
    """Weights pixels by how well the scene explains them, see `residual_weights`."""
    run.objective = run.objective.reweighted()


def weigh(run: StageRun) -> None:
    """Tells priors without a weight of their own how much the images are worth, see `Uncertainty`."""
    objective = run.objective
    loss = objective.uncertainty(objective.at_rest[0]).loss_of_a_deviation
    for block in objective.moves.values():
        block.weigh(loss)


def align(run: StageRun) -> None:
    """Lets views move from now on, if they may and the images ask for it: that explains more than chance would."""
    config, scene = run.config, run.scene
    if config.view_motion == "off" or scene.view_motions is not None or run.data.num_views < _FEWEST_VIEWS:
        return
    nodes = torch.cat([assembly.nodes() for assembly in scene])
    scene.view_motions = ViewMotions(nodes, run.data.num_views, config.view_motion_mm)
    probe = coarse(run)
    probe.objective = probe.objective.reweighted()
    found = view_evidence(probe.objective)
    if config.view_motion == "auto" and not found.is_strong:
        scene.view_motions = None
        return
    probe.optimize()
    probe.accept(probe.begin().best())
    run.renew()


def slide(run: StageRun) -> None:
    """Tries the implants all along their long axes, and stays where the rigid stages explain the images best."""
    candidates = places(run.objective, run.begin().best())
    if len(candidates) == 1 or run.trial is None:
        return
    before, stages, ends = run.scene.kept(), rigid_stages((run.stage, *run.following)), []
    for candidate in candidates:
        run.scene.restore(before)
        run.accept(candidate)
        misfit = run.trial(stages)
        ends.append((misfit, torch.cat([assembly.nodes() for assembly in run.scene]), run.scene.kept()))
    (best, nodes, state), (second, elsewhere, _), *_ = sorted(ends, key=lambda end: end[0])
    run.scene.restore(state)
    distance = float((nodes - elsewhere).square().sum(-1).mean().sqrt())
    run.rival = Rival(distance_mm=distance, misfit=second, best_misfit=best)


def rigid_stages(stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """Those at the beginning that keep the implants rigid; one look for screws, in the second, and none for places."""
    rigid = itertools.takewhile(lambda stage: stage.level.is_rigid, stages)
    return tuple(_bare(stage, looks=number == 1) for number, stage in enumerate(rigid))


def _bare(stage: Stage, *, looks: bool) -> Stage:
    changes: dict[str, Any] = {"after": ()}
    if not looks:
        changes["before"] = tuple(name for name in stage.before if name not in _LOOKS)
        changes["estimate"] = tuple(name for name in stage.estimate if name != "screws")
    return stage.model_copy(update=changes)


def _with_holes(run: StageRun) -> list[Assembly]:
    return [assembly for assembly in run.scene if assembly.holes]


BEFORE: dict[str, Step] = {
    "find_screws": find,
    "choose_screws": choose,
    "align": align,
    "background": estimate_background,
    "reweight": reweight,
    "weigh": weigh,
}
AFTER: dict[str, Step] = {"slide": slide}
CHANGE_SCENE = (*_LOOKS, "align")  # of the steps before an optimiser: a checkpoint within a stage has what they did
