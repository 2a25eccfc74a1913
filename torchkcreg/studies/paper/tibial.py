"""Experiment A: a tibia's plate under six loads, from twelve views and from three (Table 1 and Fig. 3)."""

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

from .experiment import (
    PAPER_SETTINGS,
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

CAD, BENCH, PAPER = "CAD", "bench scan", "paper's settings"
_QUICK_LOADS = ("cfg0", "cfg3")
_NEAR_MM = 4.0  # of where a bead is expected: there it is looked for
_SCAN_VOXELS: dict[str, Any] = {"spacing_mm": 0.5, "size_mm": (40.0, 32.0, 196.0)}
_BENCH_MM = (24.0, 14.0, 196.0)


@dataclass(frozen=True)
class LoadRow:
    """One registration of the experiment; root mean square errors in mm.

    Attributes:
        load_n: Axial force.
        model: Of the implant: its CAD file, its bench scan, or the CAD file with the paper's own settings.
        views: How many.
        start: Of the beads where the registration started.
        beads: Against where the simulation put them.
        segmented: Against their segmentations in FDKs of the same scans; None where there are none.
        nodes: Of the implant's nodes.
        std: What the registration expects of them.
        status, seconds: Of the run.
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
    """The experiment's table; it, the figures and all that they are made of are left in a folder.

    Six loads are imaged by physics that the registration is not told, registered from the paper's twelve views and from
    its three, and compared with the beads' true places and with their segmentations in FDKs of the same scans. The
    largest load is registered with the implant out of a bench scan, too. What is there already is kept.

    Args:
        out: Folder to make.
        quick: Two loads, three views, binned, without FDKs and bench scan: two minutes.
        known: Screws and spectrum are told.
        paper: Register three views with the paper's own settings, too: plain path lengths, gradient correlation, CMA-ES
            of 40 x 400 from two to ten groups of control points. Minutes for each load.

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
        """The recipe."""
        content = packaged("tibial_plate")
        if self.quick:
            content["configurations"] = {name: content["configurations"][name] for name in _QUICK_LOADS}
        return content

    @cached_property
    def sets(self) -> ViewSets:
        """The views that are registered."""
        return ViewSets.of_paper(quick=self.quick)

    @cached_property
    def start(self) -> Path:
        """File of the start pose."""
        return start_of(self.out)

    @cached_property
    def case(self) -> Path:
        """Images of the views that are registered."""
        scanner = {"views": self.sets.imaged, "binning": 2 if self.quick else 1}
        return simulated(self.content, self.out / "views", scanner=scanner)

    @cached_property
    def scan(self) -> Path:
        """Images of all views, binned."""
        return simulated(self.content, self.out / "scan", scanner={"binning": 2})

    @cached_property
    def truth(self) -> dict[str, Mapping[str, Any]]:
        """What the simulation knows of each configuration."""
        return {entry["name"]: entry for entry in read_json(self.case / "truth.json", "truth")["cfg"]}

    @cached_property
    def beads(self) -> Tensor:
        """Centres in the implant's frame, (B, 3)."""
        return _points(read_json(self.case / "truth.json", "truth")["bb_reference_mm"])

    @cached_property
    def bench(self) -> Path:
        """The implant out of its bench scan."""
        return bench_model(self.content["implant"], self.out / "bench", size_mm=_BENCH_MM)

    def jobs(self, paper: bool) -> Iterator[tuple[str, int, str]]:
        """Configuration, number of views and model of each registration."""
        names = list(self.content["configurations"])
        for name in names:
            yield from ((name, number, CAD) for number in sorted(self.sets.views))
            if name == names[-1] and not self.quick:
                yield name, 3, BENCH
            if paper:
                yield name, 3, PAPER

    def row(self, configuration: str, number: int, model: str) -> LoadRow:
        """What a registration finds."""
        own = model == PAPER
        name = f"{configuration}-{number}" + {CAD: "", BENCH: "-bench", PAPER: "-paper"}[model]
        run = self.out / "runs" / name
        result = registered(
            self.case,
            configuration,
            self.sets.places(number),
            run,
            start=self.start,
            options=PAPER_SETTINGS if own else {"material": self.content["implant"]["material"]},
            known=self.known and not own,
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
        """As in the paper: beads of the unloaded scan's FDK, moved as registered, against those of the loaded one's."""
        unloaded = next(iter(self.content["configurations"]))
        before = self._segmentation(unloaded, self.beads)
        after = self._segmentation(configuration, result.warp(before))
        both = before.isfinite().all(1) & after.isfinite().all(1)
        return float(bb_rmse(result.warp(before[both]), after[both])) if bool(both.any()) else None

    def _segmentation(self, configuration: str, expected: Tensor) -> Tensor:
        """Beads (B, 3) in the FDK of a scan, each the nearest to where it is expected; nan where none is near."""
        if configuration not in self.segmented:
            path = reconstructed(self.scan, configuration, self.out / "fdk" / configuration, **_SCAN_VOXELS)
            self.segmented[configuration] = find_beads(*read_volume(path)).centers
        distances = torch.cdist(expected, self.segmented[configuration])
        nearest, which = distances.min(1)
        return self.segmented[configuration][which].masked_fill((nearest > _NEAR_MM)[:, None], torch.nan)


def load_table(rows: list[LoadRow]) -> str:
    """Table 1 of the paper, as this experiment has it."""
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
