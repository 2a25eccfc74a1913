"""Experiment A: a tibial plate under six loads, from twelve and from three views (Table 1 and Fig. 3)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.console import markdown_table
from torchkcreg.evaluation import bb_rmse, find_beads
from torchkcreg.geometry import transform_points
from torchkcreg.io import read_init, read_json, read_volume, write_json, write_text
from torchkcreg.registration import RegistrationResult
from torchkcreg.simulation.bench import LoadRecipe

from .departures import PAPER, Settings, departures
from .experiment import (
    ViewSets,
    bench_model,
    draw_series,
    packaged,
    reconstructed,
    registered,
    seconds_of,
    simulated,
    start_of,
)

CAD, BENCH = "CAD", "bench scan"
_DEPARTED = "cfg3"
_QUICK_LOADS = ("cfg0", "cfg3")
_NEAR_MM = 4.0  # search radius around the expected position of a bead
_SCAN_VOXELS: dict[str, Any] = {"spacing_mm": 0.5, "size_mm": (40.0, 32.0, 196.0)}
_BENCH_MM = (24.0, 14.0, 196.0)


@dataclass(frozen=True)
class LoadRow:
    """One registration of the experiment. All errors are root mean squares in mm.

    Attributes:
        configuration: Name of the configuration.
        load_n: Axial force, N.
        model: Model of the implant: its CAD file, its bench scan, or the CAD file with settings of `departures`.
        views: Number of views.
        start: Error of the beads at the start pose.
        beads: Error of the beads against their simulated positions.
        segmented: Error of the beads against their segmentations in FDK volumes of the same scans; None without FDK.
        nodes: Error of the implant's nodes.
        std: Error of the nodes expected by the registration.
        status: Verdict of the run.
        seconds: Duration of the run.
    """

    configuration: str
    load_n: float
    model: str
    views: int
    start: float
    beads: float
    segmented: float | None
    nodes: float
    std: float | None
    status: str
    seconds: float


def tibial_plate(out: Path, *, quick: bool = False, known: bool = True, paper: bool = False) -> str:
    """Run the experiment, write all results and figures to a folder, and return its table.

    Six loads are simulated with an image formation other than the registration's model. Each is registered from the
    paper's twelve views and from its three, and compared with the true positions of the beads and with their
    segmentations in FDK volumes of the same scans. The largest load is also registered with an implant model from a
    bench scan. Existing results are kept.

    Args:
        out: Output folder, created if missing.
        quick: Two loads, three binned views, no FDK and no bench scan: takes two minutes.
        known: Give screws and spectrum to the registration.
        paper: Also register three views with the paper's settings, and one load with each departure from them, see
            `departures`. Takes an hour.

    Raises:
        FileExistsError: If the folder holds another experiment.
    """
    study = _Study(Path(out), quick, known)
    rows = []
    for configuration, number, model in study.jobs(paper):
        rows.append(study.row(configuration, number, model))
        print(_in_words(rows[-1]), flush=True)
        write_json(study.out / "rows.json", [asdict(row) for row in rows])
    draw_series(study.out, study.case, study.drawn, study.sets.places(3)[1])
    table = load_table(rows)
    write_text(study.out / "table.md", table + "\n")
    return table


@dataclass
class _Study:
    out: Path
    quick: bool
    known: bool
    drawn: dict[str, RegistrationResult] = field(default_factory=dict)
    segmented: dict[str, Tensor] = field(default_factory=dict)

    @cached_property
    def content(self) -> dict[str, Any]:
        """Content of the experiment's recipe."""
        content = packaged("tibial_plate")
        if self.quick:
            content["configurations"] = {name: content["configurations"][name] for name in _QUICK_LOADS}
        return content

    @cached_property
    def departures(self) -> dict[str, Settings]:
        """The paper's settings and each departure from them, by name."""
        return departures(self.content["implant"]["material"])

    @cached_property
    def sets(self) -> ViewSets:
        """Sets of views that are registered."""
        return ViewSets.of_paper(quick=self.quick)

    @cached_property
    def start(self) -> Path:
        """Path of the start pose's file."""
        return start_of(self.out)

    @cached_property
    def case(self) -> Path:
        """Case folder with images of the registered views."""
        scanner = {"views": self.sets.imaged, "binning": 2 if self.quick else 1}
        return simulated(self.content, self.out / "views", scanner=scanner)

    @cached_property
    def scan(self) -> Path:
        """Case folder with binned images of all views."""
        return simulated(self.content, self.out / "scan", scanner={"binning": 2})

    @cached_property
    def truth(self) -> dict[str, Mapping[str, Any]]:
        """Ground truth of each configuration, by name."""
        return {entry["name"]: entry for entry in read_json(self.case / "truth.json", "truth")["cfg"]}

    @cached_property
    def beads(self) -> Tensor:
        """Centres of the beads in the implant's frame (B, 3), mm."""
        return _points(read_json(self.case / "truth.json", "truth")["bb_reference_mm"])

    @cached_property
    def bench(self) -> Path:
        """Path of the implant model from its bench scan."""
        return bench_model(self.content["implant"], self.out / "bench", size_mm=_BENCH_MM)

    def jobs(self, paper: bool) -> Iterator[tuple[str, int, str]]:
        """Yield configuration, number of views and implant model of each registration."""
        names = list(self.content["configurations"])
        for name in names:
            yield from ((name, number, CAD) for number in sorted(self.sets.views))
            if name == names[-1] and not self.quick:
                yield name, 3, BENCH
            if paper:
                yield from ((name, 3, model) for model in self.departures if model == PAPER or name == _DEPARTED)

    def row(self, configuration: str, number: int, model: str) -> LoadRow:
        """Run one registration and return its errors."""
        known = Settings({"material": self.content["implant"]["material"]}, screws=self.known, spectrum=self.known)
        suffix = {CAD: "", BENCH: "-bench", PAPER: "-paper"}.get(model, f"-{model.replace(' ', '_')}")
        run = self.out / "runs" / f"{configuration}-{number}{suffix}"
        result = registered(
            self.case,
            configuration,
            self.sets.places(number),
            run,
            start=self.start,
            settings=self.departures.get(model, known),
            implant=self.bench if model == BENCH else None,
        )
        if model == CAD and number == 3:
            self.drawn[configuration] = result
        truth = self.truth[configuration]
        before, after = _points(truth["nodes_undeformed_mm"]), _points(truth["nodes_deformed_mm"])
        placed = transform_points(read_init(self.start), self.beads)
        return LoadRow(
            configuration,
            _newton(self.content["configurations"][configuration]),
            model,
            number,
            float(bb_rmse(placed, _points(truth["bb_mm"]))),
            float(bb_rmse(result.warp(self.beads), _points(truth["bb_mm"]))),
            None if self.quick else self._segmented_error(configuration, result),
            float(bb_rmse(result.warp(before), after)),
            result.diagnostics.get("node_std_mm"),
            result.status,
            seconds_of(run),
        )

    def _segmented_error(self, configuration: str, result: RegistrationResult) -> float | None:
        """Bead error as in the paper: beads of the unloaded scan, moved as registered, against the loaded scan's."""
        unloaded = next(iter(self.content["configurations"]))
        before = self._segmentation(unloaded, self.beads)
        after = self._segmentation(configuration, result.warp(before))
        in_both = before.isfinite().all(1) & after.isfinite().all(1)
        return float(bb_rmse(result.warp(before[in_both]), after[in_both])) if bool(in_both.any()) else None

    def _segmentation(self, configuration: str, expected: Tensor) -> Tensor:
        """Beads (B, 3) in the FDK of a scan, each the nearest to its expected position; nan if none is near."""
        if configuration not in self.segmented:
            path = reconstructed(self.scan, configuration, self.out / "fdk" / configuration, **_SCAN_VOXELS)
            self.segmented[configuration] = find_beads(*read_volume(path)).centers
        distances = torch.cdist(expected, self.segmented[configuration])
        nearest, index = distances.min(1)
        return self.segmented[configuration][index].masked_fill((nearest > _NEAR_MM)[:, None], torch.nan)


def load_table(rows: list[LoadRow]) -> str:
    """Table of all registrations, in the form of the paper's Table 1."""
    header = ["load", "views", "implant", "start", "BB, simulated", "BB, segmented", "nodes", "expected", "", "seconds"]
    listed = [
        [
            f"{row.configuration}, {row.load_n:.0f} N",
            str(row.views),
            row.model,
            f"{row.start:.2f}",
            f"{row.beads:.3f}",
            "-" if row.segmented is None else f"{row.segmented:.3f}",
            f"{row.nodes:.3f}",
            "-" if row.std is None else f"{row.std:.3f}",
            row.status,
            f"{row.seconds:.0f}",
        ]
        for row in rows
    ]
    return markdown_table(header, listed)


def _in_words(row: LoadRow) -> str:
    return (
        f"{row.configuration}, {row.load_n:.0f} N, {row.views} views, {row.model}: beads off by {row.beads:.3f} mm, "
        f"nodes by {row.nodes:.3f} mm; {row.status}, {row.seconds:.0f} s"
    )


def _newton(load: Mapping[str, Any]) -> float:
    return abs(LoadRecipe.of(load).force[2])


def _points(listed: Any) -> Tensor:
    return torch.tensor(listed, dtype=torch.float64, device="cpu").reshape(-1, 3)
