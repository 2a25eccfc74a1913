"""Assess a visit: from the scans without and under load to the motion of the fracture and the load on the implant."""

from __future__ import annotations

import math
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.evaluation import (
    BONE_PLACES,
    CallusStiffness,
    Fragments,
    bone_places,
    fracture_plane,
    fragments_of,
    relative_motion,
)
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_geometry, read_mesh, read_run, write_components, write_figure, write_json
from torchkcreg.io.runs import CONFIG, DEFORMATION
from torchkcreg.physics import is_elastic, material
from torchkcreg.plain import first_line, plain
from torchkcreg.registration import RegisteredImplant, RegistrationResult
from torchkcreg.search import spread_views
from torchkcreg.visualization import comparison_figure

from .assessment import Assessment, LoadedConfiguration, callus_of, load_at
from .load import load_files
from .register import register_files
from .register_inputs import RegistrationFiles
from .visit_doubts import (
    CONTRADICTION,
    MINERAL_WITHOUT_SPECTRUM,
    TURNED_AROUND,
    beyond_the_screws,
    fragments_turned,
    turned_around,
)
from .visit_page import ASSESSMENT, write_visit_page
from .visit_volumes import FEWEST_VIEWS, regions_of, volumes_of

_PITCH_MM = 1.0
_MOST_VIEWS = 12  # of a scan: more take longer than the answer gains
_FEW = 15  # views; of a scan with more, some are chosen


@dataclass(frozen=True)
class VisitFiles:
    """Input files of a visit.

    Attributes:
        implant: Closed mesh of the undeformed implant, mm.
        material: Name of its material.
        geometry: Projection matrices, the same for all scans.
        unloaded: Projections without load.
        loaded: Projections under load, one file each.
        loads: Load of each loaded scan, N; empty if unknown.
        screws: Screws, if they are known.
        spectrum: Detected spectrum, if it is known.
        views: Views to register with; None for all of up to 15, or of more the 12 that lie furthest apart.
        open_beam: Unattenuated intensity, if the files do not give it.
        at: Point in the implant's frame whose translation is wanted, mm.
        config: Options of the registrations, as YAML or JSON.
    """

    implant: Path
    material: str
    geometry: Path
    unloaded: Path
    loaded: Sequence[Path]
    loads: Sequence[float] = ()
    screws: Path | None = None
    spectrum: Path | None = None
    views: list[int] | None = None
    open_beam: float | None = None
    at: Sequence[float] | None = None
    config: Path | None = None

    def names(self) -> list[str]:
        """Names of the configurations, those of the files: first the unloaded one.

        Raises:
            ValueError: If two files have the same name.
        """
        names = [path.stem if path.is_file() else path.name for path in (self.unloaded, *self.loaded)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(
                f"scans are named after their files, but {twice[0]} is there {names.count(twice[0])} times"
            )
        return names

    def check(self) -> None:
        """Raise ValueError for inputs that contradict each other, before anything is computed."""
        if not self.loaded:
            raise ValueError("there is nothing to compare with: name a scan under load, or several")
        self.names()
        material(self.material)
        if self.loads and len(self.loads) != len(self.loaded):
            raise ValueError(f"{len(self.loaded)} loaded scans need as many loads, got {len(self.loads)}")
        if not all(math.isfinite(load) and load > 0 for load in self.loads):
            given = ", ".join(f"{load:g}" for load in self.loads)
            raise ValueError(f"loads must be above 0 N, got {given}")
        if self.at is not None and (len(self.at) != 3 or not all(math.isfinite(x) for x in self.at)):
            raise ValueError("a point has three finite coordinates, mm")


def assess(
    files: VisitFiles,
    out: Path,
    *,
    overwrite: bool = False,
    resume: bool = False,
    figures: bool = True,
    volumes: bool = True,
    spacing_mm: float = 0.8,
) -> Assessment:
    """Measure how a fracture moves under load and what its implant carries; write a run folder a scan and the answer.

    The unloaded scan is registered first, searched from nowhere if need be. The scans under load start from it. If the
    alloy's stiffness is known, they are bent from its shape by loads at the holes (finite elements). A scan under load
    that cannot be registered is listed with its reason and does not stop the others.

    Args:
        files: Input files.
        out: Output folder: a run folder of its file's name for each scan, and `assess.json`.
        overwrite: Replace existing runs in the folder.
        resume: Continue an interrupted assessment; finished registrations are kept.
        figures: Draw figures and write reports.
        volumes: Reconstruct the unloaded scan by FDK and KC-Rec, after the answer is written, and measure bone mineral
            in the gap, under the implant and around the screws. Scans of fewer than 60 views give no volumes.
        spacing_mm: Voxel size of the volumes.

    Raises:
        ValueError: If files contradict each other, or the unloaded scan cannot be registered.
        FileNotFoundError: If a file is missing.
        FileExistsError: If `out` holds runs and neither overwrite nor resume is set.
    """
    files.check()
    names = files.names()
    if not (overwrite or resume):
        for name in names:
            if (out / name / CONFIG).exists():
                raise FileExistsError(f"folder {out / name} holds a run already: --overwrite or --resume it")
    work = _Work(files, out, overwrite=overwrite, resume=resume, figures=figures)
    unloaded = work.register(files.unloaded, names[0])
    if unloaded.status == "failed":
        raise ValueError(
            f"the unloaded scan was not registered, so nothing can be compared with it: {'; '.join(unloaded.warnings)}"
        )
    first = unloaded.implants[0]
    screws = work.screws_of(first)
    start = out / names[0]
    results = [work.tried(path, n, start, screws) for path, n in zip(files.loaded, names[1:], strict=True)]
    visit = _Visit.of(files, first, [r.implants[0] for r in results if not isinstance(r, str) and r.status != "failed"])
    loads: Sequence[float | None] = files.loads or [None] * len(results)
    configurations = tuple(
        visit.configuration(name, load, result, work)
        for name, load, result in zip(names[1:], loads, results, strict=True)
    )
    turned = turned_around(unloaded, visit.cloud.points)
    doubts = [
        f"{names[0]} is {unloaded.status}: {why}"
        for why in unloaded.warnings
        if unloaded.status != "ok" and not (turned and why.startswith("the implant fits nearly as well"))
    ]
    assumed = (*work.assumed, *visit.assumed, *([TURNED_AROUND] if turned else []))
    assessment = Assessment(
        names[0], configurations, assumed, (*doubts, *visit.doubts), tuple(work.commands), folder=out
    )
    callus = visit.callus(configurations)
    if callus is not None and callus.contradicts:
        assessment = replace(assessment, warnings=(*assessment.warnings, CONTRADICTION))
    else:
        assessment = replace(assessment, callus=callus)
    _write(assessment, figures)
    if volumes and visit.regions:
        mineral, missing = work.volumes(out / names[0], visit.regions, spacing_mm)
        if mineral and files.spectrum is None:
            missing.append(MINERAL_WITHOUT_SPECTRUM)
        assessment = replace(assessment, mineral=tuple(mineral), warnings=(*assessment.warnings, *missing))
        _write(assessment, figures)
    return assessment


def _write(assessment: Assessment, figures: bool) -> None:
    """Write `assess.json` and, with figures, `motion.png` and the page."""
    out = assessment.folder
    write_json(out / ASSESSMENT, plain(assessment.to_dict()))
    if not figures:
        return
    measured = [(c.name, c.load_n, c.motion) for c in assessment.configurations if c.motion is not None]
    if measured:
        labels, loads, motions = zip(*measured, strict=True)
        known = [load for load in loads if load is not None]
        write_figure(out / "motion.png", comparison_figure(motions, labels, known))
    write_visit_page(out)


class _Work:
    """Registrations of a visit, their commands, and what they assume."""

    def __init__(self, files: VisitFiles, out: Path, *, overwrite: bool, resume: bool, figures: bool) -> None:
        self.files, self.out, self.overwrite, self.resume, self.figures = files, out, overwrite, resume, figures
        self.views = files.views
        self.assumed: list[str] = []
        self.commands: list[str] = []
        geometry = read_geometry(files.geometry, projections=files.unloaded)
        self.num_views = geometry.num_views
        if files.views is None and geometry.num_views > _FEW:
            self.views = spread_views(geometry, _MOST_VIEWS, opposite=True)
            chosen = ", ".join(map(str, self.views))
            self.assumed.append(f"{_MOST_VIEWS} of {geometry.num_views} views, spread over all directions: {chosen}")
        if files.screws is None:
            self.assumed.append("screws are not known: they are searched for in the implant's holes")
        if files.spectrum is None:
            self.assumed.append("the spectrum is not known: that of a 90 kV tungsten tube, hardened as the images ask")
        self.elastic = is_elastic(files.material)
        if not self.elastic:
            self.assumed.append(f"the stiffness of {files.material} is not known: motion is measured, loads are not")

    def register(
        self, projections: Path, name: str, *, start: Path | None = None, screws: Path | None = None
    ) -> RegistrationResult:
        """Register a scan, or read it if it was registered before an interruption."""
        elastic = self.elastic and start is not None
        inputs = RegistrationFiles(
            implant=self.files.implant,
            geometry=self.files.geometry,
            projections=projections,
            spectrum=self.files.spectrum,
            components=screws or self.files.screws,
            init=start,
            rest=start if elastic else None,
            views=self.views,
            open_beam=self.files.open_beam,
            config=self.files.config,
        )
        options = {"material": self.files.material, "deformation": "fe" if elastic else "modes"}
        folder = self.out / name
        self.commands.append(_command(inputs, folder, options))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the answer gives them with the scan's name
            if not (self.resume and (folder / DEFORMATION).exists()):
                going_on = self.resume and (folder / CONFIG).exists()
                register_files(
                    inputs, folder, overrides=options, overwrite=self.overwrite, resume=going_on, figures=self.figures
                )
            return read_run(folder)

    def tried(self, projections: Path, name: str, start: Path, screws: Path | None) -> RegistrationResult | str:
        """Register a scan under load; or why it cannot be."""
        try:
            return self.register(projections, name, start=start, screws=screws)
        except (ValueError, OSError, RuntimeError) as error:
            warnings.warn(f"scan {name} was not registered: {first_line(error)}", stacklevel=3)
            return first_line(error)

    def volumes(
        self, run: Path, regions: dict[str, list[float]], spacing_mm: float
    ) -> tuple[list[dict[str, Any]], list[str]]:
        """Bone mineral of regions of the unloaded scan, and why something is missing."""
        if self.num_views < FEWEST_VIEWS:
            return [], [f"{self.num_views} views are too few for a volume, which takes {FEWEST_VIEWS}"]
        folder = self.out / "volumes"
        return volumes_of(
            run,
            folder,
            regions,
            spacing_mm=spacing_mm,
            resume=self.resume,
            overwrite=self.overwrite,
            figures=self.figures,
        )

    def screws_of(self, implant: RegisteredImplant) -> Path | None:
        """File of the screws for the scans under load: those given, or those found without load; None without any."""
        if self.files.screws is not None or not implant.screws:
            return self.files.screws
        path = self.out / "screws.json"
        write_components(path, implant.screws)
        self.assumed.append(f"{len(implant.screws)} screws as found in the unloaded scan")
        return path


@dataclass(frozen=True, eq=False)
class _Visit:
    """The unloaded implant, its fragments and places, with which all scans under load are compared."""

    files: VisitFiles
    first: RegisteredImplant
    cloud: ImplantPointCloud
    fragments: Fragments
    places: Tensor
    place: str
    regions: dict[str, list[float]]
    assumed: tuple[str, ...]
    doubts: tuple[str, ...]

    @classmethod
    def of(cls, files: VisitFiles, first: RegisteredImplant, loaded: Sequence[RegisteredImplant]) -> _Visit:
        cloud = ImplantPointCloud.from_mesh(read_mesh(files.implant), _PITCH_MM, dtype=torch.float64)
        assumed, doubts = [], []
        try:
            plane = fracture_plane(first, [(implant, None) for implant in loaded], cloud.points)
            fragments = fragments_of(cloud.points, first.screws, radius_mm=first.follow_radius_mm, plane=plane)
        except ValueError as error:
            fragments = fragments_of(cloud.points, [])
            doubts.append(f"{error}; the ends of the implant stand for the fragments instead")
        beyond = beyond_the_screws(cloud.points, first.screws)
        if beyond is not None and not any(fragments_turned(first, implant, fragments) for implant in loaded):
            doubts.append(beyond)
        if not first.screws:
            doubts.append("no screws show what is fixed to which fragment: the ends of the implant are used instead")
        place = "gap" if files.at is None else "point asked for"
        at = fragments.gap if files.at is None else torch.tensor(list(files.at), dtype=torch.float64)
        places = at[None]
        regions: dict[str, list[float]] = {}
        if first.screws:
            bone = bone_places(cloud.points, first.screws, fragments.gap)
            places = torch.cat([places, bone])
            axis = first.warp(fragments.upper).mean(0) - first.warp(fragments.lower).mean(0)
            regions = regions_of(first, cloud.points, bone, axis / axis.norm())
            assumed.append("the bone lies along the screws: its axis half-way between the implant and their tips")
        return cls(files, first, cloud, fragments, places, place, regions, tuple(assumed), tuple(doubts))

    def callus(self, configurations: Sequence[LoadedConfiguration]) -> CallusStiffness | None:
        """Stiffness of the tissue in the gap; None if something that it takes is not known."""
        motions = [c.motion for c in configurations if c.motion is not None]
        if not motions or len(self.places) < 1 + len(BONE_PLACES):
            return None
        gap, *bone = self.first.warp(torch.cat([self.fragments.gap[None], self.places[-len(BONE_PLACES) :]]))
        return callus_of(configurations, gap, torch.stack(bone), motions[0].axes)

    def configuration(
        self, name: str, load: float | None, result: RegistrationResult | str, work: _Work
    ) -> LoadedConfiguration:
        """The numbers of a scan under load, or why there are none."""
        if isinstance(result, str):
            return LoadedConfiguration(name, "failed", (result,), load)
        if result.status == "failed":
            return LoadedConfiguration(name, "failed", tuple(result.warnings), load)
        implant = result.implants[0]
        motion = relative_motion(self.first, implant, self.cloud, self.fragments, places=self.places)
        carried = gap_load = None
        reasons = [text for text in result.warnings if not text.startswith("the registration in ")]  # the unloaded one
        if work.elastic:
            folder = work.out / name
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # the same doubts again
                carried = load_files(folder, folder / "load", implant=self.files.implant, figures=work.figures)
            gap_load = load_at(carried.carried, self.places[0], motion, self.first, self.cloud)
            reasons += [text for text in carried.warnings if not text.startswith("the registration is")]
        status = "doubtful" if self.doubts and result.status == "ok" else result.status
        return LoadedConfiguration(name, status, tuple(reasons), load, motion, self.place, carried, gap_load)


def _command(files: RegistrationFiles, folder: Path, options: dict[str, Any]) -> str:
    """The `register` command of a step."""
    words = ["torchkcreg", "register"]
    names = ("implant", "geometry", "projections", "spectrum", "components", "init", "rest", "open_beam", "config")
    for name in names:
        if (value := getattr(files, name)) is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    if isinstance(files.views, list):
        words += ["--views", ",".join(map(str, files.views))]
    for name, value in options.items():
        words += [f"--{name}", str(value)]
    return shlex.join([*words, "--out", str(folder)])
