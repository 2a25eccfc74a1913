"""Choose the best views of a scan from an implant's mesh and the scanner's geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.io import read_geometry, read_spectrum, write_figure, write_json, write_text
from torchkcreg.plain import plain
from torchkcreg.registration import PlannedSet, RegistrationConfig, ViewInformation, build_scene, view_information
from torchkcreg.visualization import plan_figure

from .register_inputs import ImplantFiles, read_implant

_RANDOM_SETS = 1000
_SHOWN = 5


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """The best sets of views for each number of views.

    Attributes:
        geometry: All candidate views.
        best: Sets for each number of views, best first.
        of_sources: The best set of three views from a single source, by the source's name.
        random: Expected errors (S,) of random sets for each number of views, mm.
        folder: Output folder.
    """

    geometry: ConeBeamGeometry
    best: dict[int, list[PlannedSet]]
    of_sources: dict[str, PlannedSet]
    random: dict[int, Tensor]
    folder: Path

    def label(self, view: int) -> str:
        """Label of a view: number, source and gantry angle, if the geometry has them."""
        parts = [str(view)]
        if self.geometry.sources is not None:
            parts.append(self.geometry.sources[view])
        if self.geometry.angles_deg is not None:
            parts.append(f"{float(self.geometry.angles_deg[view]):.0f} deg")
        return " ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Dictionary of plain types."""
        return {
            "best": {str(n): [asdict(planned) for planned in sets] for n, sets in self.best.items()},
            "of_sources": {name: asdict(planned) for name, planned in self.of_sources.items()},
            "random_median_mm": {str(n): float(errors.median()) for n, errors in self.random.items()},
        }

    def table(self) -> str:
        """CSV table with a row per set."""
        rows = ["number,rank,node_std_mm,views"]
        for number, sets in self.best.items():
            rows += [f"{number},{i},{s.node_std_mm:.4f},{' '.join(map(str, s.views))}" for i, s in enumerate(sets, 1)]
        return "\n".join(rows) + "\n"

    def __str__(self) -> str:
        lines = []
        for number, sets in self.best.items():
            first, median = sets[0], float(self.random[number].median())
            views = "; ".join(self.label(view) for view in first.views)
            lines.append(f"{number} views: {first.node_std_mm:.3f} mm expected ({median:.3f} at random): {views}")
        for name, planned in self.of_sources.items():
            views = "; ".join(self.label(view) for view in planned.views)
            lines.append(f"{len(planned.views)} views of {name} alone: {planned.node_std_mm:.3f} mm expected: {views}")
        return "\n".join([*lines, f"folder {self.folder}"])


def plan_files(
    implant: Path,
    geometry: Path,
    out: Path,
    *,
    material: str,
    components: Path | None = None,
    spectrum: Path | None = None,
    init: Path | None = None,
    every: int = 1,
    most: int = 6,
    figures: bool = True,
) -> ViewPlan:
    """Find the best sets of views for an implant at a pose in a scanner; write JSON, CSV and a figure.

    Args:
        implant: Mesh of the undeformed implant.
        geometry: Projection matrices of all views to choose from.
        out: Folder for `plan.json`, `plan.csv` and `plan.png`, created if missing.
        material: Material of the implant.
        components: Screws that move with the implant.
        spectrum: Detected spectrum.
        init: Pose of the implant, or the run folder of a registration.
        every: Only every Nth view is a candidate; 1 for all views.
        most: Largest number of views in a set.
        figures: Draw the figure.

    Raises:
        ValueError: If files are malformed, or there are fewer candidate views than `most`.
        FileNotFoundError: If a file is missing.
    """
    if every < 1 or most < 2:
        raise ValueError(f"every must be at least 1 and most at least 2, got {every} and {most}")
    config = RegistrationConfig(material=material)
    placed = read_implant(ImplantFiles("implant", implant, components, init), config)
    scene = build_scene(placed, config, spectrum=read_spectrum(spectrum) if spectrum is not None else None)
    views = read_geometry(geometry)
    chosen = list(range(0, views.num_views, every))
    if len(chosen) < most:
        raise ValueError(f"there are {len(chosen)} views to choose from, fewer than the {most} of the largest sets")
    information = view_information(scene, views, config, chosen)
    numbers = range(2, most + 1)
    best = {number: information.best(number) for number in numbers}
    random = {number: information.expected(_random_sets(len(chosen), number)) for number in numbers}
    plan = ViewPlan(views, best, _of_sources(information, views.sources, min(3, most)), random, out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "plan.json", plain(plan.to_dict()))
    write_text(out / "plan.csv", plan.table())
    if figures:
        angles = None if views.angles_deg is None else [float(a) for a in views.angles_deg]
        labels = [[plan.label(view) for view in planned.views] for planned in best[min(3, most)][:_SHOWN]]
        figure = plan_figure(best, random, shown=best[min(3, most)][:_SHOWN], angles_deg=angles, labels=labels)
        write_figure(out / "plan.png", figure)
    return plan


def _random_sets(number_of_views: int, number: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    order = torch.rand(_RANDOM_SETS, number_of_views, generator=generator).argsort(1)
    return order[:, :number]


def _of_sources(information: ViewInformation, sources: Sequence[str] | None, number: int) -> dict[str, PlannedSet]:
    names = [] if sources is None else sorted(set(sources))
    if len(names) < 2 or sources is None:
        return {}
    views_of = {name: [view for view in information.views if sources[view] == name] for name in names}
    return {name: information.best(number, among=views)[0] for name, views in views_of.items() if len(views) >= number}
