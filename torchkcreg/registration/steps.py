"""What a stage does before and after its optimiser, as steps under names that a schedule calls them by."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from torchkcreg.scene import Assembly, ViewMotions

from .align import view_evidence
from .basins import places
from .config import Stage
from .screws import find_screws, of_best_metal, screws_by_metal
from .stage_run import StageRun, Step, coarse
from .verdict import Rival

_SCREW_BIN = 8  # a screw is thinner than a coarser pixel
_FEWEST_VIEWS = 2  # one alone is at odds with none
_LOOKS = ("find_screws", "choose_screws")


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
