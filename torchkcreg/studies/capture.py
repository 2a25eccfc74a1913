"""Capture range: the largest start error from which the rigid stages of a registration still find the implant."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import torch
from torch import Tensor

from torchkcreg.console import markdown_table
from torchkcreg.geometry import fit_rigid, rotation_about, transform_points
from torchkcreg.implant import ImplantPointCloud, Screw
from torchkcreg.registration import RegistrationConfig, RegistrationData, RegistrationResult, Stage, register
from torchkcreg.simulation import SimulatedCase, weight_bearing_case
from torchkcreg.simulation.bench import LoadRecipe

MISALIGNED = LoadRecipe.of({"rotation": "[0.4, -0.5, 0.6] deg", "translation": "[0.8, -0.7, 1.0] mm"})  # no bending
DEFAULT_OFFSETS = (2.0, 5.0, 10.0, 15.0)
CAPTURED_MM = 0.2
_FEW_NODES = 8  # coarsening factor of the point cloud: a rigid error needs few nodes


@dataclass(frozen=True)
class CaptureTrial:
    """One registration from a random start.

    Attributes:
        offset: Distance in mm and angle in degrees of the start pose from the truth.
        start_mm: RMS distance of the implant's nodes from their true positions at the start.
        error_mm: The same at the end.
        basin_mm: RMS distance from the result of a start at the truth. Above a few tenths it is another minimum.
        gc: Gradient correlation at the end, mean over the views.
        seconds: Duration of the registration.
    """

    offset: float
    start_mm: float
    error_mm: float
    basin_mm: float
    gc: float
    seconds: float


@dataclass(frozen=True)
class CaptureStudy:
    """Registrations from random starts at several offsets.

    Attributes:
        trials: All trials, ordered by offset.
        captured_mm: Rigid error (RMS over the implant's nodes) below which a start counts as captured.
    """

    trials: tuple[CaptureTrial, ...]
    captured_mm: float = CAPTURED_MM

    @property
    def offsets(self) -> tuple[float, ...]:
        """The offsets, in the order in which they were run."""
        return tuple(dict.fromkeys(trial.offset for trial in self.trials))

    def at(self, offset: float) -> list[CaptureTrial]:
        """The trials at one offset."""
        return [trial for trial in self.trials if trial.offset == offset]

    def captured_share(self, offset: float) -> float:
        """Share of the starts at an offset whose final error is below `captured_mm`."""
        return _share([trial.error_mm < self.captured_mm for trial in self.at(offset)])

    def basin_share(self, offset: float) -> float:
        """Share of the starts that end within `captured_mm` of the result of a start at the truth."""
        return _share([trial.basin_mm < self.captured_mm for trial in self.at(offset)])

    def table(self) -> str:
        """Markdown table with one row per offset.

        >>> trials = CaptureTrial(5.0, 7.1, 0.04, 0.01, 0.9, 2.0), CaptureTrial(5.0, 6.5, 3.0, 3.0, 0.2, 2.0)
        >>> print(CaptureStudy(trials).table())
        | start off by | starts | RMS (mm) | captured | right minimum | median error (mm) | largest (mm) | median s |
        | --- | --- | --- | --- | --- | --- | --- | --- |
        | 5 mm, 5 deg | 2 | 6.8 | 50 % | 50 % | 1.520 | 3.000 | 2.0 |
        """
        columns = ("start off by", "starts", "RMS (mm)", "captured", "right minimum", "median error (mm)")
        rows = []
        for offset in self.offsets:
            trials = self.at(offset)
            shares = (f"{100 * share:.0f} %" for share in (self.captured_share(offset), self.basin_share(offset)))
            errors = [trial.error_mm for trial in trials]
            rows.append(
                [
                    f"{offset:g} mm, {offset:g} deg",
                    str(len(trials)),
                    f"{fmean(trial.start_mm for trial in trials):.1f}",
                    *shares,
                    f"{median(errors):.3f}",
                    f"{max(errors):.3f}",
                    f"{median(trial.seconds for trial in trials):.1f}",
                ]
            )
        return markdown_table([*columns, "largest (mm)", "median s"], rows)


def capture_study(
    *,
    offsets: Sequence[float] = DEFAULT_OFFSETS,
    num_starts: int = 20,
    views: Sequence[int] = (47, 48, 49),
    config: RegistrationConfig | None = None,
    known: bool = True,
    seed: int = 0,
    binning: int = 1,
    captured_mm: float = CAPTURED_MM,
    on_trial: Callable[[CaptureTrial], None] = lambda trial: None,
) -> CaptureStudy:
    """Run the rigid stages of a registration from random starts at each offset.

    The simulated plate has moved but is not bent, so its true pose is rigid. (The rigid optimum of a bent plate would
    depend on the similarity measure.) Only the stages with one group run. The error is the RMS distance of the
    implant's nodes from their true positions.

    Args:
        offsets: Start errors: so many mm in a random direction together with so many degrees about a random axis
            through the implant's centre.
        num_starts: Number of starts at each offset.
        views: Views of the simulated scan, see `torchkcreg.simulation.weight_bearing_case`.
        config: Registration options, of which the rigid stages run; the defaults with the implant's material if None.
        known: Give the screws to the registration.
        seed: Seed of the noise, the starts and the optimiser.
        binning: Pixels along each side that are binned into one before anything else.
        captured_mm: Error below which a start counts as captured.
        on_trial: Called after each registration.

    Raises:
        ValueError: If there is no offset, an offset is negative, there is no start, or no stage has one group.
    """
    if not offsets or num_starts < 1 or not all(math.isfinite(offset) and offset >= 0 for offset in offsets):
        raise ValueError(f"offsets must be one or more, not negative, each with a start, got {offsets}, {num_starts}")
    case = weight_bearing_case(MISALIGNED, seed=seed, views=views, binning=binning)
    config = rigid_stages(config or RegistrationConfig(material=case.implant_material))
    data, implant, screws = registration_inputs(case, config.pitch_mm)
    nodes = implant.coarsened(_FEW_NODES).points.double()
    truth = case.deform(nodes)
    pose = fit_rigid(nodes, truth)

    def run(start: Tensor, number: int) -> RegistrationResult:
        return register(
            implant,
            data,
            config.model_copy(update={"seed": seed + number}),
            spectrum=case.spectrum if config.material else None,
            components=screws if known else (),
            implant_to_world=start,
        )

    best = run(pose, 0).warp(nodes)
    trials = []
    for offset in offsets:
        generator = torch.Generator().manual_seed(seed)  # the same directions at each offset
        for number in range(num_starts):
            start = random_pose(pose, offset, nodes.mean(0), generator)
            begin = time.perf_counter()
            result = run(start, number)
            end = result.warp(nodes)
            trial = CaptureTrial(
                offset=float(offset),
                start_mm=_rms(transform_points(start, nodes) - truth),
                error_mm=_rms(end - truth),
                basin_mm=_rms(end - best),
                gc=float(result.gc.mean()),
                seconds=time.perf_counter() - begin,
            )
            trials.append(trial)
            on_trial(trial)
    return CaptureStudy(tuple(trials), captured_mm)


def rigid_stages(config: RegistrationConfig) -> RegistrationConfig:
    """The configuration restricted to its rigid stages (one group).

    Raises:
        ValueError: If there is no rigid stage.
    """
    stages: tuple[Stage, ...] = tuple(stage for stage in config.schedule() if stage.level.is_rigid)
    if not stages:
        raise ValueError("the configuration has no rigid stage (groups: 1)")
    return config.model_copy(update={"stages": stages})


def registration_inputs(
    case: SimulatedCase, pitch_mm: float = 0.25
) -> tuple[RegistrationData, ImplantPointCloud, list[Screw]]:
    """Projections, implant and screws of a simulated case, as inputs of a registration."""
    return case.data(), case.cloud(pitch_mm), case.screws


def random_pose(pose: Tensor, offset: float, center: Tensor, generator: torch.Generator) -> Tensor:
    """Pose (4, 4) off by `offset` mm and `offset` degrees about `center` (3,) of the implant's frame."""
    turn, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1)
    motion = rotation_about(center, turn * math.radians(offset))
    motion[:3, 3] += offset * shift
    return pose @ motion


def _rms(vectors: Tensor) -> float:
    return float(vectors.square().sum(-1).mean().sqrt())


def _share(flags: list[bool]) -> float:
    return sum(flags) / len(flags)
