"""Screws that nobody told of: cylinders along the implant's holes, found by what they add to gradient correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
_OTHER_METAL = 0.97  # of the loss with the implant's own metal is what another must reach: mixed, they corrode
_LEAST_SHARE = 0.01  # of the loss without screws that one more must take away


@torch.no_grad()
def find_screws(scene: Scene, data: RegistrationData, config: RegistrationConfig, *, bin: int = 4) -> list[FoundScrew]:
    """Screws of the metal that explains the images best, see :func:`screws_by_metal`."""
    return of_best_metal(screws_by_metal(scene, data, config, bin=bin))


def of_best_metal(found: Sequence[tuple[list[FoundScrew], float]]) -> list[FoundScrew]:
    """The screws of least loss; the first ones, of the implant's own metal, have an advantage."""
    losses = [loss * (1.0 if number else _OTHER_METAL) for number, (_, loss) in enumerate(found)]
    return found[losses.index(min(losses))][0]


@torch.no_grad()
def screws_by_metal(
    scene: Scene, data: RegistrationData, config: RegistrationConfig, *, bin: int = 4
) -> list[tuple[list[FoundScrew], float]]:
    """Screws in some of an implant's holes, and the loss with them, for each metal; the implant's own comes first.

    Starting from none, the hole and side whose screw raises gradient correlation most gets one, until the next would
    take away less than a hundredth of the loss. Then they are refined. They are tried along their holes, as locking
    screws are, and where the scene has them already; in the implant's own metal and in the others that the scene names:
    screws are sold as a set, and those of another metal pull the implant along.

    Args:
        scene: Implant near its pose, with its holes and the screws found so far; other components are ignored.
        data: Projections.
        config: Backend.
        bin: Detector pixels are averaged in squares of this side.
    """
    search = _Search(scene, data, config, bin)
    found = [search.found_of(metal) for metal in dict.fromkeys([scene.material, *scene.metals])]
    return [(screws, search.loss(screws)) for screws in found]


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
        sides = [(hole, side) for hole in scene.holes for side in (-1.0, 1.0)]
        self.places = [*scene.found, *(_along(hole, side, scene.material) for hole, side in sides)]

    def found_of(self, metal: str) -> list[FoundScrew]:
        screws = self.grow([replace(place, material=metal) for place in self.places])
        for index, screw in enumerate(screws):
            screws = self.best_of(screws, index, [screw, *(screw.with_length(length) for length in _LENGTHS_MM)])
        for step in _RADIUS_STEPS:
            screws = self.best_radius(screws, step)
        for index in range(len(screws)):
            screws = self.best_of(screws, index, self.moved(screws, index))
        for step in _LENGTH_STEPS_MM:
            for index, screw in enumerate(screws):
                lengths = [screw.length + change for change in (-step, 0.0, step) if screw.length + change > step]
                screws = self.best_of(screws, index, [screw.with_length(length) for length in lengths])
        return screws

    def loss(self, screws: Sequence[FoundScrew]) -> float:
        paths = self.bare.clone()
        for screw in screws:
            paths[:, self.scene.materials.index(screw.material)] += self._path(screw)
        lines = self.scene.intensity(paths, pooling=self.model.stage.oversampling, **self.options)
        return 1.0 - float(self.similarity(lines).mean())

    def moved(self, screws: list[FoundScrew], index: int) -> list[FoundScrew]:
        """A screw where it is and with its head in the other parts of a combination hole, tip and direction kept."""
        screw = screws[index]
        others = [*screws[:index], *screws[index + 1 :]]
        near = [place for place in self.places if place.overlaps(screw) and place.same_side(screw)]
        variants = [v for place in near for v in (replace(screw, start=place.start), screw.shifted_to(place.start))]
        return [screw, *(v for v in variants if not any(v.overlaps(other) for other in others))]

    def grow(self, candidates: list[FoundScrew]) -> list[FoundScrew]:
        chosen: list[FoundScrew] = []
        without = best = self.loss([])
        gains = {candidate: torch.inf for candidate in candidates}
        while gains:
            # What a screw gains hardly grows with the others: as long as the one that gained most before still does,
            # the rest need not be tried again.
            tried: dict[FoundScrew, float] = {}
            while (top := max(gains, key=gains.__getitem__)) not in tried:
                tried[top] = gains[top] = best - self.loss([*chosen, top])
            if gains[top] < _LEAST_SHARE * without:
                break
            best, chosen = best - gains[top], [*chosen, top]
            gains = {c: gain for c, gain in gains.items() if not c.overlaps(top)}
        return chosen

    def best_of(self, screws: list[FoundScrew], index: int, variants: list[FoundScrew]) -> list[FoundScrew]:
        return min([[*screws[:index], variant, *screws[index + 1 :]] for variant in variants], key=self.loss)

    def best_radius(self, screws: list[FoundScrew], step: float) -> list[FoundScrew]:
        trials = [[s.with_radius(s.radius * (1 + change)) for s in screws] for change in (-step, 0.0, step)]
        return min(trials, key=self.loss)

    def _path(self, screw: FoundScrew) -> Tensor:
        shape = replace(screw, material=self.scene.material)
        if shape not in self.rendered:
            self.rendered[shape] = self.model.screw_path(shape)
        return self.rendered[shape]


def _along(hole: Hole, side: float, material: str) -> FoundScrew:
    """A first guess of a screw along a hole, its tip on one of the hole's two sides."""
    axis = side * hole.axis
    start, end = hole.center - hole.depth / 2 * axis, hole.center + _FIRST_LENGTH_MM * axis
    return FoundScrew(tuple(start.tolist()), tuple(end.tolist()), _FIRST_RADIUS * hole.radius, material)
