"""Run folders of a registration: their files, package versions and overlay layers; each file is written atomically."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchkcreg.deformation import SplineField
from torchkcreg.geometry import transform_points
from torchkcreg.plain import first_line, plain
from torchkcreg.registration import RegisteredImplant, RegistrationResult

from .arrays import require_loadable, with_arrays, without_arrays, write_arrays
from .config import read_config, write_config
from .files import TEMPORARY_PREFIX, atomic_path, read_json, write_figure, write_json
from .point_clouds import write_point_cloud_ply, write_points_vtp
from .transforms import warp, write_displacement_field, write_itk_transform

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAMES = ("grey", "overlay", "labels")
_PACKAGES = ("torchkcreg", "torch", "numpy", "scipy", "kornia", "cma", "trimesh", "SimpleITK", "pydantic")
CONFIG, VERSIONS, HISTORY, METRICS = "config.yaml", "versions.json", "history.json", "metrics.json"
DEFORMATION, FIELD, TRANSFORM, CLOUD = "deformation.json", "dvf.mha", "bspline.tfm", "implant_deformed.ply"
CHECKPOINT, ARRAYS, UNCERTAINTY = "checkpoint.pt", "arrays.npz", "uncertainty.json"
SEEDS, LAYERS, REPORT, VTK_CLOUD = "seeds", "overlay.npz", "report.html", "implant_deformed.vtp"
FIGURES = ("overlay.png", "displacement.png", "history.png")
_RESULT_FILES = (DEFORMATION, METRICS, UNCERTAINTY, FIELD, TRANSFORM, CLOUD, VTK_CLOUD, ARRAYS)
REGISTRATION, RECONSTRUCTION = "registration", "reconstruction"
_CORRECTED = "geometry_corrected.json"
_DERIVED = {  # folders that other commands write into a run by default, which belong to its result
    "load": ("load.json", "load.png", "load.vtu", REPORT),
    "compare": ("compare.json", "compare.csv", "compare.png", REPORT),
    "densitometry": ("densitometry.json", "densitometry.png", REPORT),
}
RUN_FILES = (CONFIG, VERSIONS, HISTORY, CHECKPOINT, *_RESULT_FILES, *FIGURES, LAYERS, REPORT, _CORRECTED)
_FIGURE_SUFFIXES = (".png", ".pdf", ".svg")


def write_layers(path: Path, layers: dict[str, Any]) -> None:
    """Write the overlay layers as NPZ: "grey" (V, h, w) and "overlay" (V, h, w, 3), both uint8, and "labels" (V,)."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{name: layers[name] for name in _NAMES})  # type: ignore[arg-type]


def read_layers(path: Path) -> dict[str, Any] | None:
    """Read the file of `write_layers`; None if it is missing or damaged, since the report works without it."""
    try:
        with np.load(path, allow_pickle=False) as file:
            layers = {name: file[name] for name in _NAMES}
    except Exception:  # numpy, zipfile and zlib raise various types
        return None
    shape = layers["grey"].shape
    fits = len(shape) == 3 and layers["overlay"].shape == (*shape, 3) and layers["labels"].shape == shape[:1]
    return layers if fits and layers["grey"].dtype == layers["overlay"].dtype == np.uint8 else None


def versions() -> dict[str, str | int]:
    """Versions of Python and of the packages that affect the results, the platform, and the number of threads.

    >>> sorted(versions())[:3]
    ['SimpleITK', 'cma', 'kornia']
    """
    packages: dict[str, str | int] = {package: _version(package) for package in _PACKAGES}
    return {
        **packages,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": platform.machine(),
        "threads": torch.get_num_threads(),
    }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed as a package"


def implant_of_run(run_folder: Path, name: str | None = None) -> tuple[RegistrationResult, RegisteredImplant]:
    """The result of a finished run and its implant with the given name, by default the first.

    Raises:
        FileNotFoundError: There is no finished run.
        ValueError: There is no implant of that name, or a file is damaged.
    """
    result = read_run(run_folder)
    try:
        return result, result.implant(name)
    except ValueError as error:
        raise ValueError(f"run folder {run_folder}: {error}") from None


def mesh_of_run(run_folder: Path, number: int = 0) -> Path:
    """Path of the undeformed mesh of an implant of a run, by the implant's number.

    Raises:
        FileNotFoundError: The run's configuration names no mesh, or the file does not exist.
    """
    files = read_config(Path(run_folder) / "config.yaml").get("files")
    named = files.get("implant") if isinstance(files, dict) else None
    path: str | None = named[number] if isinstance(named, list) and named else named  # type: ignore[assignment]
    if path is None or not Path(path).is_file():
        problem = "names none" if path is None else f"names {path}, which is not there"
        raise FileNotFoundError(f"the implant's undeformed mesh is needed, and run folder {run_folder} {problem}")
    return Path(path)


class RunFolder:
    """Folder with all files of a registration.

    | file | content |
    | --- | --- |
    | `config.yaml` | resolved configuration, written at the start |
    | `versions.json` | torchkcreg, torch, numpy, ..., platform, threads |
    | `checkpoint.pt` | state of the trainer, updated during the run |
    | `history.json` | one record per iteration |
    | `metrics.json` | metrics of the run |
    | `deformation.json` | all parameters of the result; written last, so its presence marks a complete run |
    | `arrays.npz` | large arrays of `deformation.json`: error fields of an implant and its response to loads |
    | `uncertainty.json` | expected errors, see `uncertainty_of` |
    | `dvf.mha` | displacement field, see `displacement_field` |
    | `bspline.tfm` | ITK transform, see `itk_transform` |
    | `implant_deformed.ply`, `.vtp` | deformed point cloud with displacement and expected error of each node |
    | `overlay.png`, `displacement.png`, `history.png` | figures |
    | `overlay.npz`, `report.html` | views with and without the implant overlay, and the report page that shows them |
    | `seeds/<seed>/` | run folder of each seed, if several seeds were run |

    Use `RunFolder.create` for a new or resumed run and `read_run` for a finished one.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        kind: str = REGISTRATION,
        overwrite: bool = False,
        resume: bool = False,
    ) -> RunFolder:
        """Create or open a run folder for writing.

        Args:
            path: The folder. It is created with its parents if missing. An existing empty folder is used.
            kind: "registration" or "reconstruction". A folder of the other kind is never taken.
            overwrite: Discard an existing run: the files written by a run are deleted, other files stay.
            resume: Continue an existing run.

        Raises:
            FileExistsError: The folder holds a run and neither `overwrite` nor `resume` is set, or one of the other
                kind, or other files.
            FileNotFoundError: There is no run to resume.
            NotADirectoryError: The path or one of its parents is a file.
            ValueError: Both `overwrite` and `resume` are set.
        """
        if overwrite and resume:
            raise ValueError("a run is either overwritten or resumed, not both")
        run = cls(path)
        is_run = (run.path / CONFIG).is_file()
        if resume and not is_run:
            raise FileNotFoundError(f"run folder {run.path} holds no run to resume (no {CONFIG})")
        try:
            run.path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise NotADirectoryError(f"run folder {run.path} cannot be made: a file is in the way") from error
        if not is_run and any(not entry.name.startswith(TEMPORARY_PREFIX) for entry in run.path.iterdir()):
            raise FileExistsError(f"folder {run.path} is not empty and holds no run: choose another one")
        if is_run and (held := _kind(run.path)) != kind:
            raise FileExistsError(f"folder {run.path} holds a {held}, no {kind}: choose another one")
        if is_run and not (resume or overwrite):
            raise FileExistsError(f"run folder {run.path} holds a run already: overwrite or resume it")
        run._discard(() if resume else RUN_FILES)
        return run

    def start(self, config: dict[str, Any]) -> None:
        """Write `config.yaml`, which marks the folder as a run, and `versions.json`."""
        write_config(self.path / CONFIG, config)
        write_json(self.path / VERSIONS, versions())

    def of_seed(self, seed: int) -> RunFolder:
        """Create the run folder of one of several seeds."""
        return RunFolder.create(self.path / SEEDS / str(seed))

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Write the checkpoint atomically, replacing the last one.

        Raises:
            ValueError: The state holds something other than tensors and plain data, which could not be loaded safely.
                The message names its place.
        """
        require_loadable(state, "state")
        with atomic_path(self.path / CHECKPOINT) as temporary:
            torch.save(state, temporary)

    def load_checkpoint(self) -> dict[str, Any] | None:
        """Load the last checkpoint to the CPU; None if there is none. Nothing in the file is executed.

        Raises:
            ValueError: The file cannot be read.
        """
        path = self.path / CHECKPOINT
        if not path.is_file():
            return None
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch.load fails in many ways on a damaged file
            reason = first_line(error)
            raise ValueError(f"checkpoint {path} cannot be read: {reason[:120]}") from error

    def write_history(self, history: list[dict[str, Any]]) -> None:
        """Write `history.json`."""
        write_json(self.path / HISTORY, history)

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write `metrics.json`."""
        write_json(self.path / METRICS, metrics)

    def write_figure(self, name: str, figure: Figure) -> None:
        """Write a figure under a file name such as `overlay.png`."""
        if Path(name).name != name or Path(name).suffix not in _FIGURE_SUFFIXES:
            raise ValueError(f"name must be a file name ending in {', '.join(_FIGURE_SUFFIXES)}, got {name!r}")
        write_figure(self.path / name, figure)

    def write_result(
        self, result: RegistrationResult, points: Sequence[Tensor], *, initial_to_world: Sequence[Tensor] | None = None
    ) -> None:
        """Write history, displacement field, ITK transform, deformed cloud and, last, `deformation.json`.

        File names of the second and further implants are prefixed with the implant's name.

        Args:
            result: The registration.
            points: Nodes (N, 3) of each implant, in the implant's frame.
            initial_to_world: Pose (4, 4) of each implant relative to which the cloud's displacements are computed; by
                default the identity.

        Raises:
            ValueError: A parameter is not finite.
        """
        content, arrays = without_arrays(result.to_dict())
        content = plain(content)  # raises on invalid content before any file is touched
        for name in (DEFORMATION, ARRAYS):
            (self.path / name).unlink(missing_ok=True)
        self.write_history(result.history)
        starts = initial_to_world or [torch.eye(4, dtype=torch.float64)] * len(result.implants)
        for number, (implant, nodes, start) in enumerate(zip(result.implants, points, starts, strict=True)):
            prefix = f"{implant.name}_" if number else ""
            pose, deformation = implant.implant_to_world, implant.deformation
            moved = warp(pose, deformation, nodes)
            displacement = moved - transform_points(start.detach().cpu().double(), nodes.detach().cpu().double())
            write_displacement_field(self.path / f"{prefix}{FIELD}", pose, deformation, nodes)
            if isinstance(deformation, SplineField):
                write_itk_transform(self.path / f"{prefix}{TRANSFORM}", pose, deformation)
            std = None if implant.deviations is None else implant.deviations.of_nearest(nodes)
            write_point_cloud_ply(self.path / f"{prefix}{CLOUD}", moved, displacement, std)
            error = {} if std is None else {"expected_error_mm": std}
            write_points_vtp(self.path / f"{prefix}{VTK_CLOUD}", moved, {"displacement_mm": displacement, **error})
        if any(implant.deviations is not None for implant in result.implants):
            write_json(self.path / UNCERTAINTY, uncertainty_of(result))
        if arrays:
            write_arrays(self.path / ARRAYS, arrays)
        write_json(self.path / DEFORMATION, content, indent=None)

    def read_result(self) -> RegistrationResult:
        """Read the result in the folder; see `read_run`."""
        path = self.path / DEFORMATION
        if not path.is_file():
            state = "is not finished" if (self.path / CONFIG).is_file() else "is no run"
            raise FileNotFoundError(f"run folder {self.path} {state}: it has no {DEFORMATION}")
        history = read_json(self.path / HISTORY, "history") if (self.path / HISTORY).is_file() else []
        content = with_arrays(read_json(path, "deformation"), self.path / ARRAYS)
        try:
            return RegistrationResult.from_dict(content, history=history)
        except ValueError as error:
            raise ValueError(f"deformation file {path}: {' '.join(str(error).split())}") from error

    def _discard(self, names: tuple[str, ...]) -> None:
        for leftover in self.path.glob(f"{TEMPORARY_PREFIX}*"):  # from a run that was killed while writing
            leftover.unlink(missing_ok=True)
        for name in names:
            (self.path / name).unlink(missing_ok=True)
        for name in (FIELD, TRANSFORM, CLOUD, VTK_CLOUD) if names else ():  # of further implants
            for path in self.path.glob(f"*_{name}"):
                path.unlink()
        if names:
            self._discard_seeds(names)
            for folder, files in _DERIVED.items():
                for name in files:
                    (self.path / folder / name).unlink(missing_ok=True)
                if (self.path / folder).is_dir() and not any((self.path / folder).iterdir()):
                    (self.path / folder).rmdir()

    def _discard_seeds(self, names: tuple[str, ...]) -> None:
        folder = self.path / SEEDS
        for config in folder.glob(f"*/{CONFIG}"):
            RunFolder(config.parent)._discard(names)
        for emptied in (*folder.glob("*/"), folder):
            if emptied.is_dir() and not any(emptied.iterdir()):
                emptied.rmdir()


def _kind(folder: Path) -> str:
    """Kind of result in a folder with a `config.yaml`."""
    try:
        return RECONSTRUCTION if RECONSTRUCTION in read_config(folder / CONFIG) else REGISTRATION
    except ValueError:  # damaged: a registration's result tells
        return REGISTRATION


def uncertainty_of(result: RegistrationResult) -> dict[str, Any]:
    """Expected errors of a registration, mm: of all nodes, and of each implant across and along the rays."""
    implants = {}
    for implant in result.implants:
        if implant.deviations is not None:
            whole, lateral, depth = implant.deviations.rms
            directions = {"lateral_std_mm": lateral, "depth_std_mm": depth, "depth": implant.deviations.depth}
            implants[implant.name] = {"node_std_mm": whole, **directions}
    return plain({"node_std_mm": result.diagnostics.get("node_std_mm"), "implants": implants})


def read_run(path: str | os.PathLike[str]) -> RegistrationResult:
    """Read the result of a finished registration, in float64. It warps points exactly as the written result.

    A result whose status is not "ok" is read with a warning that gives the reasons.

    Args:
        path: The run folder.

    Raises:
        FileNotFoundError: The folder does not exist, or its run is not finished.
        ValueError: A file is damaged; the message names the file and the key.
    """
    if not Path(path).is_dir():
        raise FileNotFoundError(f"run folder {path} does not exist")
    result = RunFolder(path).read_result()
    if result.status != "ok":
        reasons = "; ".join(result.warnings)
        warnings.warn(f"the registration in {path} is {result.status}: {reasons}", stacklevel=2)
    return result
