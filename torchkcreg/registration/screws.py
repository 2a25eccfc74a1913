"""Screws that nobody told of: cylinders along the implant's holes, found by what they add to gradient correlation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchkcreg.implant import Hole
from torchkcreg.similarity import GradientCorrelation

from .config import RegistrationConfig, Stage
from .data import RegistrationData
from .found_screw import FoundScrew
from .model import StageModel
from .scene import Scene

_FIRST_LENGTH_MM = 25.0  # a screw that is there is at least about as long, or it holds nothing
_FIRST_RADIUS = 0.8  # of the hole's
_LENGTHS_MM = (12.0, 18.0, 24.0, 30.0, 36.0, 42.0, 50.0, 60.0, 70.0)
_LENGTH_STEPS_MM = (4.0, 2.0, 1.0)
_RADIUS_STEPS = (0.2, 0.1, 0.05, 0.025)  # relative
_LEAST_SHARE = 0.01  # of the loss without screws that one more must take away


@torch.no_grad()
def find_screws(scene: Scene, data: RegistrationData, config: RegistrationConfig, *, bin: int = 4) -> list[FoundScrew]:
    """Screws of the implant's own material along some of its holes.

    Starting from none, the hole and side whose screw raises gradient correlation most gets one, until the next would
    take away less than a hundredth of the loss. Then they are refined. A screw along its hole is what locking screws
    are; one that is tilted is found as well as a cylinder along the hole fits it.

    Args:
        scene: Implant near its pose, with its holes; its components are ignored.
        data: Projections.
        config: Backend.
        bin: Detector pixels are averaged in squares of this side.
    """
    search = _Search(scene, data, config, bin)
    screws = search.grow([_along(hole, side) for hole in scene.holes for side in (-1.0, 1.0)])
    for index, screw in enumerate(screws):
        screws = search.best_of(screws, index, [screw.with_length(length) for length in _LENGTHS_MM])
    for step in _RADIUS_STEPS:
        screws = search.best_radius(screws, step)
    for step in _LENGTH_STEPS_MM:
        for index, screw in enumerate(screws):
            lengths = [screw.length + change for change in (-step, 0.0, step) if screw.length + change > step]
            screws = search.best_of(screws, index, [screw.with_length(length) for length in lengths])
    return screws


class _Search:
    """Losses of an implant with screws, whose path lengths are rendered once each."""

    def __init__(self, scene: Scene, data: RegistrationData, config: RegistrationConfig, bin: int) -> None:
        self.scene, self.config = scene.without_components(), config
        stage = Stage(groups=scene.num_groups, bin=bin, pitch_factor=2, margin_mm=None)
        self.model = StageModel(self.scene, data, stage, config)
        self.similarity = GradientCorrelation(self.model.data.line_integrals, self.model.data.mask)
        self.bare = self.model.path_lengths(self.model.at_rest)
        self.options = self.model.intensity_options(self.model.at_rest)
        self.rendered: dict[FoundScrew, Tensor] = {}

    def loss(self, screws: Sequence[FoundScrew]) -> float:
        paths = self.bare.clone()
        for screw in screws:
            paths[:, 0] += self._path(screw)
        lines = self.scene.intensity(paths, pooling=self.model.stage.oversampling, **self.options)
        return 1.0 - float(self.similarity(lines).mean())

    def grow(self, candidates: list[FoundScrew]) -> list[FoundScrew]:
        chosen: list[FoundScrew] = []
        without = best = self.loss([])
        while candidates:
            losses = [self.loss([*chosen, candidate]) for candidate in candidates]
            least = min(range(len(losses)), key=losses.__getitem__)
            if best - losses[least] < _LEAST_SHARE * without:
                break
            best, new = losses[least], candidates[least]
            chosen = [*chosen, new]
            candidates = [c for c in candidates if not c.overlaps(new)]
        return chosen

    def best_of(self, screws: list[FoundScrew], index: int, variants: list[FoundScrew]) -> list[FoundScrew]:
        return min([[*screws[:index], variant, *screws[index + 1 :]] for variant in variants], key=self.loss)

    def best_radius(self, screws: list[FoundScrew], step: float) -> list[FoundScrew]:
        trials = [[s.with_radius(s.radius * (1 + change)) for s in screws] for change in (-step, 0.0, step)]
        return min(trials, key=self.loss)

    def _path(self, screw: FoundScrew) -> Tensor:
        if screw not in self.rendered:
            self.rendered[screw] = self.model.screw_path(screw)
        return self.rendered[screw]


def _along(hole: Hole, side: float) -> FoundScrew:
    """A first guess of a screw along a hole, its tip on one of the hole's two sides."""
    axis = side * hole.axis
    start, end = hole.center - hole.depth / 2 * axis, hole.center + _FIRST_LENGTH_MM * axis
    return FoundScrew(tuple(start.tolist()), tuple(end.tolist()), _FIRST_RADIUS * hole.radius)
