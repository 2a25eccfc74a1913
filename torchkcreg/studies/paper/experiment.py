"""Steps of the paper's experiments. Each writes its own folder and is skipped if its result exists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from torchkcreg.commands.reconstruct import reconstruct_files, resolve_options
from torchkcreg.commands.reconstruct_options import ReconstructionFiles
from torchkcreg.commands.register import register_files
from torchkcreg.commands.register_inputs import RegistrationFiles
from torchkcreg.commands.simulate import simulate_files
from torchkcreg.evaluation import displacement_map
from torchkcreg.geometry import MultisourceScanner, rigid_matrix
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_geometry, read_json, read_mesh, read_projections, read_run, write_figure, write_init
from torchkcreg.projector import project_mesh
from torchkcreg.registration import RegistrationResult
from torchkcreg.simulation.bench import Recipe
from torchkcreg.visualization import overlay_figure, series_figure

from .departures import Settings

_PITCH_MM = 0.8
_START_DEG, _START_MM = (0.8, -0.6, 1.0), (1.0, -1.2, 0.8)  # error of the start pose


def draw_series(out: Path, case: Path, results: Mapping[str, RegistrationResult], view: int) -> list[Path]:
    """Draw Figures 3A and 3B of Cao et al. 2020, `overlay.png` and `displacement.png`, and return their paths.

    Args:
        out: Output folder.
        case: Folder of the images, `NAME.npz` for each result.
        results: Registration results by configuration name.
        view: Number of the view on which the models are overlaid.
    """
    geometry, mesh = read_geometry(case / "geometry.json").select([view]), read_mesh(case / "implant.stl")
    images, shadows, bent = [], [], {}
    cloud = ImplantPointCloud.from_mesh(mesh, _PITCH_MM, dtype=torch.float64)
    for name, result in results.items():
        images.append(read_projections(case / f"{name}.npz", views=[view]).line_integrals[0])
        deformed = result.deformed(mesh)
        vertices, faces = (torch.from_numpy(np.array(a)) for a in (deformed.vertices, deformed.faces))
        shadows.append(project_mesh(vertices, faces, geometry.projection_matrices, geometry.det_shape)[0].float())
        bent[name] = displacement_map(cloud.points, result.warp(cloud.points), weights=cloud.volumes)
    spacing = geometry.pixel_spacing
    overlay = overlay_figure(
        torch.stack(images), torch.stack(shadows), view_labels=list(results), pixel_spacing=spacing
    )
    write_figure(out / "overlay.png", overlay)
    panels = {name: (displacement.undeformed, displacement.vectors) for name, displacement in bent.items()}
    write_figure(out / "displacement.png", series_figure(panels, label="displacement against the distal end (mm)"))
    return [out / "overlay.png", out / "displacement.png"]


@dataclass(frozen=True)
class ViewSets:
    """The paper's sets of views. Only these views are simulated.

    Attributes:
        views: Numbers of the scan's views in each set, by the number of views.
    """

    views: dict[int, list[int]]

    @classmethod
    def of_paper(cls, *, quick: bool) -> ViewSets:
        """The sets of three and of twelve views; only three views if `quick`."""
        scanner = MultisourceScanner()
        return cls({int(n): scanner.paper_views(n) for n in (("3",) if quick else ("3", "12"))})

    @property
    def imaged(self) -> list[int]:
        """Numbers of all views in the sets, in the scan's order."""
        return sorted({view for views in self.views.values() for view in views})

    def places(self, number: int) -> list[int]:
        """Indices of a set's views among the imaged views."""
        return [self.imaged.index(view) for view in self.views[number]]


def packaged(name: str) -> dict[str, Any]:
    """Content of the packaged recipe file of an experiment."""
    text = (resources.files("torchkcreg.studies.paper") / f"{name}.yaml").read_text(encoding="utf-8")
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def simulated(content: Mapping[str, Any], folder: Path, **changes: Any) -> Path:
    """Simulate a recipe with changes and return the case folder. Existing images are kept."""
    simulate_files(Recipe.of({**content, **changes}, "recipe"), folder)
    return folder


def start_of(folder: Path) -> Path:
    """Write `start.json`, a start pose with errors of about 1.8 mm and 1.4 degrees, and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    turn = torch.deg2rad(torch.tensor(_START_DEG, dtype=torch.float64, device="cpu"))
    pose = rigid_matrix(turn, torch.tensor(_START_MM, dtype=torch.float64, device="cpu"))
    write_init(folder / "start.json", pose)
    return folder / "start.json"


def registered(
    case: Path,
    configuration: str,
    views: list[int],
    run: Path,
    *,
    start: Path,
    settings: Settings,
    implant: Path | None = None,
) -> RegistrationResult:
    """Register a configuration in its run folder. A finished run is read; an interrupted run is resumed.

    Args:
        case: Folder of the simulated case.
        configuration: Name of the configuration.
        views: Indices of the case's views that are used.
        run: Run folder.
        start: File of the start pose.
        settings: Options of the registration, and what it is given.
        implant: File of an implant model to use instead of the case's.
    """
    if (run / "deformation.json").exists():
        return read_run(run)
    files = RegistrationFiles(
        implant=implant or case / "implant.stl",
        geometry=case / "geometry.json",
        projections=case / f"{configuration}.npz",
        spectrum=case / "spectrum.csv" if settings.spectrum else None,
        components=case / "screws.json" if settings.screws else None,
        init=start,
        views=views,
    )
    return register_files(files, run, overrides=dict(settings.options), resume=run.exists())


def seconds_of(folder: Path) -> float:
    """Duration of a run or a reconstruction in seconds."""
    return float(read_json(folder / "metrics.json", "metrics")["seconds"])


def reconstructed(case: Path, configuration: str, out: Path, *, run: Path | None = None, **options: Any) -> Path:
    """Reconstruct a configuration's scan and return the volume's path. A finished volume is kept."""
    volume = out / "volume.mha"
    if not (out / "metrics.json").exists():
        files = ReconstructionFiles(
            run=run,
            geometry=case / "geometry.json",
            projections=case / f"{configuration}.npz",
            spectrum=case / "spectrum.csv",
        )
        reconstruct_files(files, out, resolve_options(options), resume=(out / "config.yaml").exists())
    return volume


def bench_model(implant: Mapping[str, Any], out: Path, *, size_mm: tuple[float, float, float]) -> Path:
    """Simulate a bench scan of the undeformed implant and return its metal fraction volume (FDK, 0.25 mm voxels)."""
    content = packaged("bench")
    case = simulated({**content, "implant": dict(implant)}, out / "scan")
    alone = {"method": "fdk", "single_material": implant["material"], "scatter": "none"}
    return reconstructed(case, "bench", out / "fdk", spacing_mm=0.25, size_mm=size_mm, **alone)
