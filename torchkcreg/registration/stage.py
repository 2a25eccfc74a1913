"""A stage in the making: the scene, the data and the objective that its steps work on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchkcreg.optimization import OPTIMIZERS, Optimizer, OptimizerFactory, Progress, iterate
from torchkcreg.scene import Moves, RegistrationData, Scene, View
from torchkcreg.similarity import GradientCorrelation, GradientDifference

from .config import RegistrationConfig, Stage
from .estimated_background import data_with_background
from .objective import Objective, Penalty, SimilarityFactory
from .verdict import Rival


@dataclass(frozen=True)
class Terms:
    """What a user has put in place of, or beside, what the stages say.

    Attributes:
        similarity: Of all stages, in place of theirs.
        penalties: Beside the priors.
        optimizer: Of all stages, in place of theirs.
    """

    similarity: SimilarityFactory | None = None
    penalties: Sequence[Penalty] = ()
    optimizer: OptimizerFactory | None = None


Step = Callable[["StageRun"], None]

_CURVATURE_BIN, _CURVATURE_MM = 2, 2.0  # pixels on which curvatures are taken: coarser by this, up to this width
_COARSE_BIN = 2  # an expected error needs no finer pixels


@dataclass
class StageRun:
    """What a stage works on, and what its steps change.

    Attributes:
        scene: In its present state.
        data: What it is compared with, at full resolution.
        stage: Options of the stage.
        config: Options of the registration.
        terms: The user's.
        seed: Of the stage's random numbers.
        remaining: Steps before the optimiser that have not been taken yet; a step may take them itself.
        optimizer: Of the objective, once it has begun.
        reports: Its progress so far.
        following: The stages that will come.
        trial: Runs stages on the scene as it is; what of the images they leave unexplained.
        rival: Where the implants fitted second best, where several places were tried.
        accepted: Whether the scene has moved to where the stage ended.
    """

    scene: Scene
    data: RegistrationData
    stage: Stage
    config: RegistrationConfig
    terms: Terms = field(default_factory=Terms)
    seed: int = 0
    remaining: list[Step] = field(default_factory=list)
    optimizer: Optimizer | None = None
    reports: list[Progress] = field(default_factory=list)
    following: tuple[Stage, ...] = ()
    trial: Callable[[tuple[Stage, ...]], float] | None = None
    rival: Rival | None = None
    accepted: bool = False
    _objective: Objective | None = None

    @property
    def objective(self) -> Objective:
        """Of the scene and the data as they are when it is first asked for; steps that change them drop it."""
        if self._objective is None:
            self._objective = self._made()
        return self._objective

    @objective.setter
    def objective(self, objective: Objective) -> None:
        self._objective, self.optimizer, self.reports = objective, None, []

    def renew(self) -> None:
        """Drops the objective and what was found with it: scene or data have changed."""
        self._objective, self.optimizer, self.reports = None, None, []

    def prepare(self) -> None:
        """Takes the steps that remain."""
        while self.remaining:
            self.remaining.pop(0)(self)

    def begin(self) -> Optimizer:
        """The stage's optimiser, a new one if it has not begun."""
        if self.optimizer is None:
            make = self.terms.optimizer or OPTIMIZERS[self.stage.optimizer]
            self.optimizer = make(self.objective, self.stage, self.seed)
        return self.optimizer

    def optimize(
        self,
        report: Callable[[Progress], None] = lambda progress: None,
        *,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Runs the optimiser to its end, or until it is stopped."""
        optimizer = self.begin()
        while not optimizer.done and not stop():
            iterate(optimizer)
            self.reports.append(optimizer.progress)
            report(optimizer.progress)

    def accept(self, parameters: Tensor) -> None:
        """Moves the scene to parameters (D,) of the objective."""
        self.objective.accept(parameters)
        self.accepted = True

    def with_background(self) -> None:
        """Estimates what the scene lacks, if its intensity model knows a background."""
        if self.scene.intensity.has_background:
            bin = self.stage.binning(self.data.geometry.pixel_spacing[1])
            self.data = data_with_background(self.scene, self.data, self.config, bin)
            self.renew()

    def view(self, coarser: int = 1) -> View:
        """What the stage sees; on coarser pixels, of fewer nodes, where asked."""
        stage = self.stage
        return self.scene.view(
            self.data,
            bin=coarser * stage.binning(self.data.geometry.pixel_spacing[1]),
            oversampling=stage.oversampling,
            pitch_factor=coarser * stage.pitch_factor,
            margin_mm=stage.margin_mm,
        )

    def similarity(self) -> SimilarityFactory:
        """What makes the stage's data term."""
        if self.terms.similarity is not None:
            return self.terms.similarity
        sees_contrast = self.stage.similarity == "gradient-difference" and self.scene.intensity.has_background
        return GradientDifference if sees_contrast else GradientCorrelation

    def _made(self) -> Objective:
        stage, view = self.stage, self.view()
        moves = Moves(
            self.scene,
            view,
            stage.level,
            estimate=stage.estimate,
            screws="screws" in stage.estimate,
            tilts="tilts" in stage.estimate,
            views="views" in stage.estimate,
            prior_weight=self.config.prior_weight,
        )
        make, penalties = self.similarity(), self.terms.penalties
        coarse = None
        if (stage.bin * _CURVATURE_BIN) * self.data.geometry.pixel_spacing[1] <= _CURVATURE_MM:
            seen = self.view(coarser=_CURVATURE_BIN)
            coarse = Objective(self.scene, seen, moves.seen_in(seen), make, penalties=penalties)
        return Objective(self.scene, view, moves, make, penalties=penalties, coarse=coarse)


@torch.no_grad()
def similarities(run: StageRun, make: SimilarityFactory | None = None) -> Tensor:
    """Similarity (V,) of the scene as it is with the images that a stage compares it with."""
    view = run.view()
    return (make or run.similarity())(view.images.line_integrals, view.images.mask, None)(run.scene(view))


def changed(run: StageRun, **options: object) -> StageRun:
    """A run of the same scene and data with another stage's options."""
    stage = run.stage.model_copy(update=options)
    return replace(run, stage=stage, optimizer=None, reports=[], _objective=None)


def coarse(run: StageRun) -> StageRun:
    """A run of the same stage for expected errors: on coarse pixels, by a similarity that is a sum of squares."""
    probe = changed(run, bin=max(run.stage.bin, _COARSE_BIN))
    if run.terms.similarity is not None:
        probe = replace(probe, terms=replace(run.terms, similarity=GradientDifference))
    probe.with_background()
    return probe
