"""Catalogue of the studies: the jobs of each, the function that runs a job, and the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from torchkcreg.registration import RegistrationConfig, build_scene, view_information
from torchkcreg.simulation import draw_case

from .capture import registration_inputs
from .reports import of_coverage, of_geometry, of_loads, of_population, of_views
from .simulated import ERRORS, made_case, registered, simulated
from .sweeps import Job, Row, sweep
from .tibial_loads import load_jobs, registered_load

_RANDOM_SETS = 10
_VIEWS = 3


@dataclass(frozen=True)
class StudyOptions:
    """Settings of a study.

    Attributes:
        cases: Number of simulated cases; None: the study's default.
        first: Seed of the first case.
        views: "neighbours", "around", "both" or "spread". The studies of coverage and views choose their own views.
        known: Give screws and spectrum to the registration. The studies of geometry and views always do.
        elastic: Plates bend elastically under known loads.
        images: "own" for the case's images, or wrong ones: those of another case, "mirrored", "turned".
        options: Options of the registration.
        cache: Folder in which simulated images are cached.
    """

    cases: int | None = None
    first: int = 0
    views: str = "neighbours"
    known: bool = False
    elastic: bool = False
    images: str = "own"
    options: dict[str, Any] = field(default_factory=dict)
    cache: str = ""

    def seeds(self, usual: int) -> range:
        """Seeds of the cases."""
        return range(self.first, self.first + (usual if self.cases is None else self.cases))

    def job(self, seed: int, **changes: Any) -> Job:
        """A job for `simulated`."""
        names = ("views", "known", "elastic", "images", "options", "cache")
        return {"seed": seed, "geometry": "none", **{name: getattr(self, name) for name in names}, **changes}


@dataclass(frozen=True)
class Study:
    """Definition of a study.

    Attributes:
        text: Question of the study, one line.
        jobs: Function that lists the jobs for given options.
        function: Function that runs one job and returns its row.
        report: Function that summarises all rows in words and writes table and figures to a folder.
        fixed: Names of options that the study sets itself or does not use.
    """

    text: str
    jobs: Callable[[StudyOptions], list[Job]]
    function: Callable[[Job], Row]
    report: Callable[[Sequence[Row], Path], str]
    fixed: tuple[str, ...] = ()

    def check(self, name: str, options: StudyOptions) -> None:
        """Raise ValueError if `options` set an option that is fixed in the study called `name`."""
        usual = StudyOptions()
        if asked := [option for option in self.fixed if getattr(options, option) != getattr(usual, option)]:
            raise ValueError(f"the study {name} has its own {' and '.join(asked)}: none can be chosen")


def run_study(
    name: str, options: StudyOptions, out: Path, *, workers: int = 2, cluster: str | None = None
) -> tuple[list[Row], str]:
    """Run a study and return its rows and a summary in words.

    The folder then holds `jobs.jsonl`, a table and figures. Finished jobs are kept: a study that is started again
    continues where it stopped.

    Args:
        name: A key of `STUDIES`.
        options: Settings of the study.
        out: Output folder, created if missing.
        workers: See `sweep`.
        cluster: See `sweep`.

    Raises:
        ValueError: If there is no such study, there are no cases, an option is fixed in the study, or all jobs failed.
    """
    if name not in STUDIES:
        raise ValueError(f"there is no study {name!r}: there are {', '.join(STUDIES)}")
    study = STUDIES[name]
    study.check(name, options)
    jobs = study.jobs(options)
    if not jobs:
        raise ValueError(f"a study needs a case or more, got {options.cases}")
    rows = sweep(study.function, jobs, out / "jobs.jsonl", workers=workers, cluster=cluster)
    errors = [row["error"] for row in rows if "error" in row]
    if len(errors) == len(rows):
        raise ValueError(f"all {len(rows)} jobs failed, the first with {errors[0]}")
    summary = study.report(rows, out)
    return rows, f"{summary}\n{len(errors)} jobs failed, the first with {errors[0]}" if errors else summary


def _population(options: StudyOptions) -> list[Job]:
    return [options.job(seed) for seed in options.seeds(40)]


def _coverage(options: StudyOptions) -> list[Job]:
    cases = {"neighbours": options.seeds(50), "around": options.seeds(50)}
    return [options.job(seed, views=views) for views, seeds in cases.items() for seed in seeds]


def covered(job: Job) -> Row:
    """Row of a simulated case with its set of views."""
    return {**simulated(job), "views": job["views"]}


def _geometry(options: StudyOptions) -> list[Job]:
    option_sets = [{**options.options, "view_motion": way} for way in ("off", "auto")]
    return [
        options.job(seed, geometry=error, known=True, options=way)
        for seed in options.seeds(12)
        for error in ("none", *ERRORS, "all")
        for way in option_sets
    ]


def corrected(job: Job) -> Row:
    """Row of a case with the error of its geometry and whether the registration moved views."""
    row = simulated(job)
    moved = row["view_motion_mm"] is not None
    return {**row, "geometry": job["geometry"], "view_motion": job["options"]["view_motion"], "views_moved": moved}


def _views(options: StudyOptions) -> list[Job]:
    sets = [None, *range(_RANDOM_SETS)]
    return [options.job(seed, views="many", known=True, random=number) for seed in options.seeds(4) for number in sets]


def planned(job: Job) -> Row:
    """Row of a case registered to three of many views: the planned set, or a random set given by its number."""
    draw = draw_case(job["seed"])
    case = made_case(draw, job["views"], job["elastic"], job["cache"])
    config = RegistrationConfig(material=case.implant_material, **job["options"])
    _, cloud, screws = registration_inputs(case, config.pitch_mm)
    scene = build_scene(cloud, config, spectrum=case.spectrum, components=screws)
    information = view_information(scene, case.geometry, config)
    if job["random"] is None:
        chosen = list(information.best(_VIEWS)[0].views)
    else:
        generator = torch.Generator().manual_seed(1000 * job["seed"] + job["random"])
        chosen = torch.randperm(case.geometry.num_views, generator=generator)[:_VIEWS].tolist()
    expected = float(information.expected(torch.tensor([chosen]))[0])
    row = registered(job, draw, case, chosen=chosen)
    return {**row, "chosen": chosen, "expected_mm": round(expected, 4), "planned": job["random"] is None}


def _loads(options: StudyOptions) -> list[Job]:
    return load_jobs(options.seeds(2), known=options.known, options=options.options)


STUDIES = {
    "population": Study("errors and verdicts of randomly drawn cases", _population, simulated, of_population),
    "coverage": Study("how often error bars contain the truth", _coverage, covered, of_coverage, ("views",)),
    "geometry": Study(
        "errors from a wrong geometry, and how much moving the views recovers", _geometry, corrected, of_geometry
    ),
    "loads": Study(
        "errors for loads in newton, sets of views and noise levels, on the tibial plate",
        _loads,
        registered_load,
        of_loads,
        ("views", "elastic", "images", "cache"),
    ),
    "views": Study("planned views against random ones", _views, planned, of_views, ("views",)),
}
