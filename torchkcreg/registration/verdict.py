"""Verdict on a registration: diagnostics, thresholds and reasons in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

Status = Literal["ok", "doubtful", "failed"]

# Each threshold best separates good from bad cases of a simulated population, see docs/verdict.md.
_UNRELATED, _WEAK = 0.3, 0.6  # gradient correlation
_NOTHING, _UNEXPLAINED = 0.2, 0.08  # misfit
_DEVIATION_MM, _ANYWHERE_MM = 0.11, 0.5
_USELESS_MM = 2.0  # no measurement of motion or bending is of use beyond it
_DEVIATION_FOUND_MM = 0.085  # with found screws: their metal and shape may be wrong
_SEEN, _HARDLY_SEEN = 0.05, 0.3  # of the implant's volume
_YIELD = 0.0035  # root mean square strain
_SURPRISING = 4.0  # mean square of loads in standard deviations; of plates on screws it is one, and up to 2.7
_ALIKE = 1.2  # largest ratio of the misfits of two places that the images do not tell apart


@dataclass(frozen=True)
class Rival:
    """Second best of the places tried.

    Attributes:
        distance_mm: Root mean square distance of the implants' nodes there from where they fit best.
        misfit: Unexplained share of the images there.
        best_misfit: Unexplained share at the best place.
        pose: Pose (4, 4) there, from the implant's frame to the world, for `--init`; None if it is near the start.
    """

    APART_MM: ClassVar[float] = 2.0  # nearer places are the same

    distance_mm: float
    misfit: float
    best_misfit: float
    pose: list[list[float]] | None = None

    @property
    def ratio(self) -> float:
        """Misfit there over that at the best place; infinite if there is none."""
        return self.misfit / self.best_misfit if self.best_misfit > 0 else math.inf


@dataclass(frozen=True)
class Diagnostics:
    """Measures that distinguish good registrations from bad ones.

    Attributes:
        gc: Gradient correlation of each view.
        misfit: Unexplained share of the images' contrast in the last stage.
        node_std_mm: Expected root mean square error of the implant's nodes.
        seen: Share of the implant's volume that each view shows.
        strain: Root mean square strain of the implant.
        folds: True if the deformation folds over somewhere in the implant.
        converged: True if the last stage ended before its last iteration.
        at_bounds: Parameters of the intensity model that ended at a bound.
        undone: Number of each stage that was undone, from 1 on, and why.
        rival: Second best place of the implant, if several were tried.
        screws_found: Number of screws that were found, not given.
        surprise: Mean square of the loads in the prior's standard deviations.
        effective_parameters: Number of parameters determined by the images.
        blocks: Number of pixel blocks that contribute to the error estimate.
        view_motion_mm: Estimated motion of the views, root mean square at the nodes; None if not estimated or not
            significant.
    """

    gc: list[float]
    misfit: float
    node_std_mm: float
    seen: list[float]
    strain: float
    folds: bool = False
    converged: bool = True
    at_bounds: list[str] = field(default_factory=list)
    undone: dict[str, str] = field(default_factory=dict)
    rival: Rival | None = None
    screws_found: int = 0
    surprise: float = 0.0
    effective_parameters: float = 0.0
    blocks: int = 0
    view_motion_mm: float | None = None


def judge(diagnostics: Diagnostics) -> tuple[Status, list[str]]:
    """The verdict on a registration, and its reasons in words."""
    failures, doubts = _failures(diagnostics), _doubts(diagnostics)
    status: Status = "failed" if failures else "doubtful" if doubts else "ok"
    return status, [*failures, *doubts]


def _failures(diagnostics: Diagnostics) -> list[str]:
    reasons = [f"{name} is not a number" for name in _not_numbers(diagnostics, ("gc", "misfit"))]
    weakest = min(diagnostics.gc)
    if not weakest >= _UNRELATED:
        reasons.append(
            f"the implant is not where the images show metal: gradient correlation is {weakest:.2f} in view "
            f"{diagnostics.gc.index(weakest)}, no more than with images of something else (up to {_UNRELATED:g})"
        )
    if weakest < -_UNRELATED:
        reasons.append("the images are brighter behind metal where they should be darker: they may be inverted")
    if not diagnostics.misfit <= _NOTHING and not diagnostics.node_std_mm <= _ANYWHERE_MM:
        reasons.append(
            f"{100 * diagnostics.misfit:.0f} % of the images' contrast is left unexplained and the nodes are expected "
            f"to be off by {diagnostics.node_std_mm:.1f} mm (RMS), as with images of something else"
        )
    if len(diagnostics.gc) > 1 and diagnostics.node_std_mm > _USELESS_MM:  # one view alone leaves depth open
        reasons.append(
            f"the implant's nodes are expected to be off by {diagnostics.node_std_mm:.1f} mm (RMS), more than "
            f"{_USELESS_MM:g} mm: the images do not tell where the implant is"
        )
    if max(diagnostics.seen) < _SEEN:
        reasons.append(f"no view shows more than {100 * max(diagnostics.seen):.0f} % of the implant")
    if diagnostics.folds:
        reasons.append("the deformation folds over inside the implant")
    return reasons


def _not_numbers(diagnostics: Diagnostics, names: tuple[str, ...]) -> list[str]:
    """Those of the named figures that are NaN or infinite, to which no threshold applies."""
    values = {name: getattr(diagnostics, name) for name in names}
    listed = {name: value if isinstance(value, list) else [value] for name, value in values.items()}
    return [name for name, row in listed.items() if not all(x is None or math.isfinite(x) for x in row)]


def _doubts(diagnostics: Diagnostics) -> list[str]:
    figures = ("seen", "strain", "surprise", "view_motion_mm")
    reasons = [f"{name} is not a number" for name in _not_numbers(diagnostics, figures)]
    if _UNRELATED <= min(diagnostics.gc) < _WEAK:
        reasons.append(
            f"the images agree weakly: gradient correlation is {min(diagnostics.gc):.2f}, less than {_WEAK:g}"
        )
    if diagnostics.misfit > _UNEXPLAINED:
        reasons.append(f"{100 * diagnostics.misfit:.0f} % of the images' contrast is left unexplained")
    limit, screws, hint = _DEVIATION_MM, "", "views from other sides would help"
    if diagnostics.screws_found:
        limit, hint = _DEVIATION_FOUND_MM, "their list, or views from other sides would help"
        screws = f" with {diagnostics.screws_found} screws that were found, not given"
    if diagnostics.view_motion_mm is not None:
        hint = f"the views are off the geometry by {diagnostics.view_motion_mm:.2f} mm, a better geometry would help"
    if not diagnostics.node_std_mm <= limit:
        reasons.append(
            f"the implant's nodes are expected to be off by {diagnostics.node_std_mm:.3f} mm (RMS), more than "
            f"{limit:g} mm{screws}: {hint}"
        )
    hardly = [str(view) for view, share in enumerate(diagnostics.seen) if share < _HARDLY_SEEN]
    if hardly and max(diagnostics.seen) >= _SEEN:
        reasons.append(f"less than {100 * _HARDLY_SEEN:.0f} % of the implant is seen in view {', '.join(hardly)}")
    if diagnostics.strain > _YIELD:
        reasons.append(f"the implant is strained by {100 * diagnostics.strain:.2f} % (RMS), more than metal bears")
    if diagnostics.surprise > _SURPRISING:
        reasons.append(
            f"it takes loads {diagnostics.surprise**0.5:.1f} times as strong as expected to bend the implant so: it is "
            "held or shaped otherwise than its finite elements have it; --deformation modes asks for no loads"
        )
    if not diagnostics.converged:
        reasons.append("the last stage did not converge: it needs more iterations")
    reasons += [f"{name} ended at its bound" for name in diagnostics.at_bounds]
    rival = diagnostics.rival
    if rival and rival.distance_mm > Rival.APART_MM and rival.misfit < _ALIKE * rival.best_misfit:
        reasons.append(f"the implant fits nearly as well {rival.distance_mm:.1f} mm away")
    # That the first stage, on coarse pixels, does not improve on a good start says nothing.
    reasons += [f"stage {stage} was undone: {why}" for stage, why in diagnostics.undone.items() if stage != "1"]
    return reasons
