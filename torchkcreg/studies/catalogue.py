"""The studies by their names: which jobs each has, what runs them, what their rows say."""

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
    """What a study is run on.

    Attributes:
        cases: How many cases of the population; None: as many as the study usually has.
        first: Seed of the first one.
        views: "neighbours", "around", "both" or "spread"; studies of coverage and views have their own.
        known: Screws and spectrum are told; in studies of geometry and views they always are.
        elastic: Plates bend under known loads.
        images: "own", or those of another case, "mirrored", "turned".
        options: Of the registration.
        cache: Folder that keeps images.
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
        """Of the cases."""
        return range(self.first, self.first + (usual if self.cases is None else self.cases))

    def job(self, seed: int, **changes: Any) -> Job:
        """A job of :func:`simulated`."""
        names = ("views", "known", "elastic", "images", "options", "cache")
        return {"seed": seed, "geometry": "none", **{name: getattr(self, name) for name in names}, **changes}


@dataclass(frozen=True)
class Study:
    """A study.

    Attributes:
        text: What it asks.
        jobs: Of options.
        function: Runs one.
        report: What all rows say; writes table and figures to a folder.
        fixed: Names of options that the study sets itself, or has no use for.
    """

    text: str
    jobs: Callable[[StudyOptions], list[Job]]
    function: Callable[[Job], Row]
    report: Callable[[Sequence[Row], Path], str]
    fixed: tuple[str, ...] = ()

    def check(self, name: str, options: StudyOptions) -> None:
        """Raises ValueError if options ask for what the study, of this name, would not do."""
        usual = StudyOptions()
        if asked := [option for option in self.fixed if getattr(options, option) != getattr(usual, option)]:
            raise ValueError(f"the study {name} has its own {' and '.join(asked)}: none can be chosen")


def run_study(
    name: str, options: StudyOptions, out: Path, *, workers: int = 2, cluster: str | None = None
) -> tuple[list[Row], str]:
    """Rows of a study and what they say; the folder then holds `jobs.jsonl`, a table and figures.

    Finished jobs are kept: started again, the study goes on where it was broken off.

    Args:
        name: Of one of :data:`STUDIES`.
        options: What it is run on.
        out: Folder; it is made.
        workers: See :func:`sweep`.
        cluster: See :func:`sweep`.

    Raises:
        ValueError: If there is no such study or case, an option has no use in it, or the rows of all jobs are errors.
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
    told = study.report(rows, out)
    return rows, f"{told}\n{len(errors)} jobs failed, the first with {errors[0]}" if errors else told


def _population(options: StudyOptions) -> list[Job]:
    return [options.job(seed) for seed in options.seeds(40)]


def _coverage(options: StudyOptions) -> list[Job]:
    cases = {"neighbours": options.seeds(50), "around": options.seeds(50)}
    return [options.job(seed, views=views) for views, seeds in cases.items() for seed in seeds]


def covered(job: Job) -> Row:
    """A row that knows its set of views."""
    return {**simulated(job), "views": job["views"]}


def _geometry(options: StudyOptions) -> list[Job]:
    ways = [{**options.options, "view_motion": way} for way in ("off", "auto")]
    return [
        options.job(seed, geometry=error, known=True, options=way)
        for seed in options.seeds(12)
        for error in ("none", *ERRORS, "all")
        for way in ways
    ]


def corrected(job: Job) -> Row:
    """A row that knows what was wrong, and whether views were moved."""
    row = simulated(job)
    moved = row["view_motion_mm"] is not None
    return {**row, "geometry": job["geometry"], "view_motion": job["options"]["view_motion"], "views_moved": moved}


def _views(options: StudyOptions) -> list[Job]:
    sets = [None, *range(_RANDOM_SETS)]
    return [options.job(seed, views="many", known=True, random=number) for seed in options.seeds(4) for number in sets]


def planned(job: Job) -> Row:
    """Registered to three views of many: the set that is planned, or, by its number, a random one."""
    draw = draw_case(job["seed"])
    case = made_case(draw, job["views"], job["elastic"], job["cache"])
    config = RegistrationConfig(material=case.implant_material, **job["options"])
    _, cloud, screws = registration_inputs(case, config.pitch_mm)
    scene = build_scene(cloud, config, spectrum=case.spectrum, components=screws)
    known = view_information(scene, case.geometry, config)
    if job["random"] is None:
        chosen = list(known.best(_VIEWS)[0].views)
    else:
        generator = torch.Generator().manual_seed(1000 * job["seed"] + job["random"])
        chosen = torch.randperm(case.geometry.num_views, generator=generator)[:_VIEWS].tolist()
    expected = float(known.expected(torch.tensor([chosen]))[0])
    row = registered(job, draw, case, chosen=chosen)
    return {**row, "chosen": chosen, "expected_mm": round(expected, 4), "planned": job["random"] is None}


def _loads(options: StudyOptions) -> list[Job]:
    return load_jobs(options.seeds(2), known=options.known, options=options.options)


STUDIES = {
    "population": Study("errors and verdicts of randomly drawn cases", _population, simulated, of_population),
    "coverage": Study("how often error bars hold the truth", _coverage, covered, of_coverage, ("views",)),
    "geometry": Study("what a geometry that is off costs, and what is won back", _geometry, corrected, of_geometry),
    "loads": Study(
        "loads in newton, views and noise, on the tibial plate",
        _loads,
        registered_load,
        of_loads,
        ("views", "elastic", "images", "cache"),
    ),
    "views": Study("whether planned views beat random ones", _views, planned, of_views, ("views",)),
}
