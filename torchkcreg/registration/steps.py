"""Named steps that a stage runs before and after its optimiser."""

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
_MOST_RIGID = 3  # stages that tell places apart: finer pixels only cost time
_SCREW_BIN = 8  # a screw is thinner than a coarser pixel
_FEWEST_VIEWS = 2  # one alone is at odds with none
_LOOKS = ("find_screws", "choose_screws")


class ViewEvidence(NamedTuple):
    """Evidence in the images for motions of the views.

    Attributes:
        motion_mm: Displacement of the nodes by the likeliest motions, root mean square over the views.
        strength: Decrease of the loss per parameter determined by the images, in units of the loss of one standard
            deviation: about one if nothing moved.
    """

    motion_mm: float
    strength: float

    @property
    def is_strong(self) -> bool:
        """True if the views have moved."""
        return self.strength > _LEAST_STRENGTH


def view_evidence(objective: Objective) -> ViewEvidence:
    """Evidence for motions of the views beyond all other free parameters; sets the weight of their prior.

    The loss of one standard deviation is taken from the residual images that remain after the best motion, since the
    present residuals may be caused by the motion itself.
    """
    rest = objective.at_rest[0]
    jacobian, residuals = objective.jacobian(rest)
    remaining = residuals
    for _ in range(_WEIGHINGS):
        objective.moves["views"].weigh(objective.uncertainty_from(jacobian, remaining, rest).loss_of_a_deviation)
        known = objective.uncertainty_from(jacobian, remaining, rest)  # with that weight
        slope = 0.5 / len(residuals) * (jacobian.flatten(1) @ residuals.flatten()).double()
        slope = slope + _slope(objective, rest)
        step, gain, number = _best(known.images + known.penalties, known.images, slope)
        remaining = residuals + torch.einsum("d,dvkij->vkij", step.to(jacobian), jacobian)
    views = objective.moves.places["views"]
    others = torch.ones_like(slope, dtype=torch.bool)
    others[views] = False
    images, whole = (m[others][:, others] for m in (known.images, known.images + known.penalties))
    _, less, fewer = _best(whole, images, slope[others])
    motion = step[views].unflatten(0, (-1, 6)).square().sum(-1).mean().sqrt()
    determined = (number - fewer).clamp_min(1.0)
    return ViewEvidence(float(motion), float((gain - less) / (known.loss_of_a_deviation * determined)))


def _slope(objective: Objective, at: Tensor) -> Tensor:
    """Gradient (D,) of penalties and priors at parameters (D,)."""
    leaf = at.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(objective.penalty(leaf[None])[0], leaf)
    return slope


def _best(curvature: Tensor, images: Tensor, slope: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Step to the optimum, decrease of the loss, and number of parameters determined by the images."""
    same = torch.eye(len(curvature), dtype=curvature.dtype, device=curvature.device)
    inverse = torch.linalg.inv(curvature + 1e-9 * curvature.diagonal().mean() * same)
    step = -inverse @ slope
    return step, -0.5 * slope @ step, (inverse @ images).trace()


@torch.no_grad()
def places(objective: Objective, found: Tensor) -> list[Tensor]:
    """Candidate parameters (D,) of a rigid stage to continue from, the stage's result first.

    Others are minima of the loss along an implant's long axis, up to half its length away, and the start, if the stage
    moved away by more than a few steps: on coarse pixels holes are invisible and a wrong place may fit better.

    Args:
        objective: Of a rigid stage.
        found: Result of the stage, shape (D,).
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
    """Find screws in the holes of implants without given components; they become the components."""
    for assembly in _with_holes(run):
        assembly.place(find_screws(run.scene, assembly, run.data, bin=min(run.stage.bin, _SCREW_BIN)))
        run.renew()


def choose(run: StageRun) -> None:
    """Find screws of every metal, run the stage with each, and keep those that explain the images best.

    Coarse images without the stage's motion distinguish metals poorly. Several implants choose in turn.
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
    """Estimate the background (bone, water) as a smooth path length, which DRRs include."""
    run.with_background()


def reweight(run: StageRun) -> None:
    """Weight pixels by how well the scene explains them, see `residual_weights`."""
    run.objective = run.objective.reweighted()


def weigh(run: StageRun) -> None:
    """Set the weight of priors that have no fixed weight from the image uncertainty, see `Uncertainty`."""
    objective = run.objective
    loss = objective.uncertainty(objective.at_rest[0]).loss_of_a_deviation
    for block in objective.moves.values():
        block.weigh(loss)


def align(run: StageRun) -> None:
    """Enable motions of the views if allowed and, for "auto", if the evidence for them is strong."""
    config, scene = run.config, run.scene
    if config.view_motion == "off" or scene.view_motions is not None or run.data.num_views < _FEWEST_VIEWS:
        return
    nodes = torch.cat([assembly.nodes() for assembly in scene])
    scene.view_motions = ViewMotions(nodes, run.data.num_views, config.view_motion_mm)
    probe = coarse(run)
    probe.objective = probe.objective.reweighted()
    evidence = view_evidence(probe.objective)
    if config.view_motion == "auto" and not evidence.is_strong:
        scene.view_motions = None
        return
    probe.optimize()
    probe.accept(probe.begin().best())
    run.renew()


def slide(run: StageRun) -> None:
    """Try places along the implants' long axes and keep the one at which the rigid stages fit best."""
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
    """Up to three leading rigid stages, with a screw search only in the second and no steps after the optimiser."""
    rigid = itertools.islice(itertools.takewhile(lambda stage: stage.level.is_rigid, stages), _MOST_RIGID)
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
CHANGE_SCENE = (*_LOOKS, "align")  # steps not repeated when resuming within a stage: the checkpoint has their effect
