"""Search for unknown screws: cylinders along the implant's holes that raise gradient correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchkcreg.implant import Hole, Screw
from torchkcreg.scene import Assembly, RegistrationData, Scene, ScrewPaths
from torchkcreg.similarity import GradientCorrelation

_FIRST_LENGTH_MM = 25.0  # a screw that is there is at least about as long, or it holds nothing
_FIRST_RADIUS = 0.8  # of the hole's
_LENGTHS_MM = (12.0, 18.0, 24.0, 30.0, 36.0, 42.0, 50.0, 60.0, 70.0)
_LENGTH_STEPS_MM = (4.0, 2.0, 1.0)
_RADIUS_STEPS = (0.2, 0.1, 0.05, 0.025)  # relative
_OTHER_METAL = 0.97  # of the loss with the implant's own metal is what another must reach: mixed, they corrode
_LEAST_SHARE = 0.01  # of the loss without screws that one more must take away


@torch.no_grad()
def find_screws(scene: Scene, assembly: Assembly, data: RegistrationData, *, bin: int = 4) -> list[Screw]:
    """Find screws of the metal that explains the images best, see `screws_by_metal`."""
    return of_best_metal(screws_by_metal(scene, assembly, data, bin=bin))


def of_best_metal(candidates: Sequence[tuple[list[Screw], float]]) -> list[Screw]:
    """The screws of least loss, favouring the first set, which is of the implant's metal."""
    losses = [loss * (1.0 if number else _OTHER_METAL) for number, (_, loss) in enumerate(candidates)]
    return candidates[losses.index(min(losses))][0]


@torch.no_grad()
def screws_by_metal(
    scene: Scene, assembly: Assembly, data: RegistrationData, *, bin: int = 4
) -> list[tuple[list[Screw], float]]:
    """Screws in an implant's holes and the loss with them, for each metal; the implant's metal comes first.

    Starting from none, the hole and side whose screw raises gradient correlation most gets one, until the next would
    take away less than a hundredth of the loss. Then they are refined. They are tried along their holes, as locking
    screws are, and where the scene has them already; in the implant's own metal and in the others that the scene names:
    screws are sold as a set, and those of another metal pull the implant along.

    Args:
        scene: Implants near their poses.
        assembly: Implant whose holes are searched, with the screws found so far; its other components are ignored.
        data: Projections.
        bin: Detector pixels are averaged in squares of this side.
    """
    search = _Search(scene, assembly, data, bin)
    screws = [search.found_of(metal) for metal in dict.fromkeys([assembly.material, *scene.metals])]
    return list(zip(screws, search.losses(screws), strict=True))


class _Search:
    """Losses of an implant with screws; each screw's path lengths are rendered once."""

    def __init__(self, scene: Scene, assembly: Assembly, data: RegistrationData, bin: int) -> None:
        self.scene, self.assembly = scene, assembly
        sides = [(hole, side) for hole in assembly.holes for side in (-1.0, 1.0)]
        self.places = [*assembly.found, *(_along(hole, side, assembly.material) for hole, side in sides)]
        bare = scene.without_components(assembly)
        self.view = bare.view(data, bin=bin, pitch_factor=2)
        state = bare.state(self.view)
        self.bare = bare.path_lengths(self.view, state)
        self.physics = bare.arguments(self.view, state)
        self.similarity = GradientCorrelation(self.view.images.line_integrals, self.view.images.mask)
        self.paths = ScrewPaths(assembly, self.view)
        self.rendered: dict[Screw, Tensor] = {}

    def found_of(self, metal: str) -> list[Screw]:
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

    def losses(self, sets: Sequence[Sequence[Screw]]) -> list[float]:
        """Losses of several sets of screws at once."""
        paths = self.bare.repeat(len(sets), *[1] * (self.bare.dim() - 1))
        for path, screws in zip(paths, sets, strict=True):
            for screw in screws:
                path[self.scene.materials.index(screw.material)] += self._path(screw)
        lines = self.scene.intensity(paths, pooling=self.view.oversampling, **self.physics)
        return (1.0 - self.similarity(lines).mean(-1)).tolist()

    def moved(self, screws: list[Screw], index: int) -> list[Screw]:
        """The screw and variants with the head in other parts of a combination hole, keeping tip or direction."""
        screw = screws[index]
        others = [*screws[:index], *screws[index + 1 :]]
        near = [place for place in self.places if place.overlaps(screw) and place.same_side(screw)]
        variants = [v for place in near for v in (replace(screw, start=place.start), _shifted(screw, place.start))]
        return [screw, *(v for v in variants if not any(v.overlaps(other) for other in others))]

    def grow(self, candidates: list[Screw]) -> list[Screw]:
        chosen: list[Screw] = []
        without, *first = self.losses([[], *([candidate] for candidate in candidates)])
        best, gains = without, {c: without - loss for c, loss in zip(candidates, first, strict=True)}
        while gains:
            # The gain of a screw hardly grows when others are added, so if the best one keeps its lead the rest need
            # not be tried again.
            tried: dict[Screw, float] = {}
            while (top := max(gains, key=gains.__getitem__)) not in tried:
                tried[top] = gains[top] = best - self.losses([[*chosen, top]])[0]
            if gains[top] < _LEAST_SHARE * without:
                break
            best, chosen = best - gains[top], [*chosen, top]
            gains = {c: gain for c, gain in gains.items() if not c.overlaps(top)}
        return chosen

    def best_of(self, screws: list[Screw], index: int, variants: list[Screw]) -> list[Screw]:
        return self._best([[*screws[:index], variant, *screws[index + 1 :]] for variant in variants])

    def best_radius(self, screws: list[Screw], step: float) -> list[Screw]:
        return self._best([[s.with_radius(s.radius * (1 + change)) for s in screws] for change in (-step, 0.0, step)])

    def _best(self, sets: list[list[Screw]]) -> list[Screw]:
        losses = self.losses(sets)
        return sets[losses.index(min(losses))]

    def _path(self, screw: Screw) -> Tensor:
        shape = replace(screw, material="", name="")
        if shape not in self.rendered:
            self.rendered[shape] = self.paths(shape)
        return self.rendered[shape]


def _along(hole: Hole, side: float, material: str) -> Screw:
    """A first guess of a screw along a hole, its tip on one of the hole's two sides."""
    axis = side * hole.axis
    start, end = hole.center - hole.depth / 2 * axis, hole.center + _FIRST_LENGTH_MM * axis
    return Screw(tuple(start.tolist()), tuple(end.tolist()), _FIRST_RADIUS * hole.radius, material)


def _shifted(screw: Screw, start: tuple[float, float, float]) -> Screw:
    """The screw, shifted to a new start point."""
    x, y, z = (end + there - here for end, there, here in zip(screw.end, start, screw.start, strict=True))
    return replace(screw, start=start, end=(x, y, z))
