"""A running stage: the scene, the data and the objective that its steps work on."""

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
    """The user's similarity, penalties and optimiser, which replace or extend the stages'.

    Attributes:
        similarity: Replaces that of all stages.
        penalties: Penalties besides the priors.
        optimizer: Replaces that of all stages.
    """

    similarity: SimilarityFactory | None = None
    penalties: Sequence[Penalty] = ()
    optimizer: OptimizerFactory | None = None


Step = Callable[["StageRun"], None]

_CURVATURE_BIN, _CURVATURE_MM = 2, 2.0  # pixels on which curvatures are taken: coarser by this, up to this width
_COARSE_BIN = 2  # an expected error needs no finer pixels


@dataclass
class StageRun:
    """State of a running stage, which its steps may change.

    Attributes:
        scene: In its present state.
        data: Measured data at full resolution.
        stage: Options of the stage.
        config: Options of the registration.
        terms: The user's terms.
        seed: Seed of the stage's random numbers.
        remaining: Steps before the optimiser that have not been taken yet; a step may take them itself.
        optimizer: Optimiser of the objective, once started.
        reports: Its progress so far.
        following: The stages after this one.
        trial: Runs stages on the present scene and returns the misfit.
        rival: Second best place of the implants, if several were tried.
        accepted: True if the scene has been moved to the stage's result.
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
        """Objective of the scene and data at first access; steps that change them discard it."""
        if self._objective is None:
            self._objective = self._made()
        return self._objective

    @objective.setter
    def objective(self, objective: Objective) -> None:
        self._objective, self.optimizer, self.reports = objective, None, []

    def renew(self) -> None:
        """Discard objective, optimiser and reports after scene or data have changed."""
        self._objective, self.optimizer, self.reports = None, None, []

    def prepare(self) -> None:
        """Run the remaining steps."""
        while self.remaining:
            self.remaining.pop(0)(self)

    def begin(self) -> Optimizer:
        """The stage's optimiser, created at the first call."""
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
        """Run the optimiser to its end, or until it is stopped."""
        optimizer = self.begin()
        while not optimizer.done and not stop():
            iterate(optimizer)
            self.reports.append(optimizer.progress)
            report(optimizer.progress)

    def accept(self, parameters: Tensor) -> None:
        """Move the scene to parameters (D,) of the objective."""
        self.objective.accept(parameters)
        self.accepted = True

    def with_background(self) -> None:
        """Estimate the background, if the intensity model has one."""
        if self.scene.intensity.has_background:
            bin = self.stage.binning(self.data.geometry.pixel_spacing[1])
            self.data = data_with_background(self.scene, self.data, self.config, bin)
            self.renew()

    def view(self, coarser: int = 1) -> View:
        """View of the stage; with coarser pixels and fewer nodes if `coarser` > 1."""
        stage = self.stage
        return self.scene.view(
            self.data,
            bin=coarser * stage.binning(self.data.geometry.pixel_spacing[1]),
            oversampling=stage.oversampling,
            pitch_factor=coarser * stage.pitch_factor,
            margin_mm=stage.margin_mm,
        )

    def similarity(self) -> SimilarityFactory:
        """Factory of the stage's data term."""
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
    """Similarity (V,) of the present scene with the images of a stage."""
    view = run.view()
    return (make or run.similarity())(view.images.line_integrals, view.images.mask, None)(run.scene(view))


def changed(run: StageRun, **options: object) -> StageRun:
    """A run of the same scene and data with changed options of the stage."""
    stage = run.stage.model_copy(update=options)
    return replace(run, stage=stage, optimizer=None, reports=[], _objective=None)


def coarse(run: StageRun) -> StageRun:
    """A run of the same stage for expected errors: on coarse pixels, by a similarity that is a sum of squares."""
    probe = changed(run, bin=max(run.stage.bin, _COARSE_BIN))
    if run.terms.similarity is not None:
        probe = replace(probe, terms=replace(run.terms, similarity=GradientDifference))
    probe.with_background()
    return probe
