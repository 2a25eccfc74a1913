"""Run folders: everything that a registration leaves behind, each file whole or not there."""

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
from torchkcreg.plain import plain
from torchkcreg.registration import RegisteredImplant, RegistrationResult

from .arrays import require_loadable, with_arrays, without_arrays, write_arrays
from .config import read_config, write_config
from .files import TEMPORARY_PREFIX, atomic_path, read_json, write_figure, write_json
from .meshes import write_point_cloud_ply
from .point_clouds import write_points_vtp
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
RUN_FILES = (CONFIG, VERSIONS, HISTORY, CHECKPOINT, *_RESULT_FILES, *FIGURES, LAYERS, REPORT)
_FIGURE_SUFFIXES = (".png", ".pdf", ".svg")


def write_layers(path: Path, layers: dict[str, Any]) -> None:
    """Nothing; writes "grey" (V, h, w), "overlay" (V, h, w, 3), both uint8, and "labels" (V,) as an NPZ file."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{name: layers[name] for name in _NAMES})  # type: ignore[arg-type]


def read_layers(path: Path) -> dict[str, Any] | None:
    """What `write_layers` wrote; None where there is nothing, or it is damaged: a page does without."""
    try:
        with np.load(path, allow_pickle=False) as file:
            held = {name: file[name] for name in _NAMES}
    except Exception:  # numpy's, zipfile's and zlib's own
        return None
    shape = held["grey"].shape
    fits = len(shape) == 3 and held["overlay"].shape == (*shape, 3) and held["labels"].shape == shape[:1]
    return held if fits and held["grey"].dtype == held["overlay"].dtype == np.uint8 else None


def versions() -> dict[str, str | int]:
    """Versions of Python, of the packages the numbers depend on, of the machine, and the number of threads.

    >>> sorted(versions())[:3]
    ['SimpleITK', 'cma', 'kornia']
    """
    found: dict[str, str | int] = {package: _version(package) for package in _PACKAGES}
    return {
        **found,
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
    """The result of a finished run and its implant of a name, the first one without.

    Raises:
        FileNotFoundError: If there is no finished run.
        ValueError: If there is no implant of that name, or a file is damaged.
    """
    result = read_run(run_folder)
    try:
        return result, result.implant(name)
    except KeyError as error:
        raise ValueError(f"run folder {run_folder}: {error.args[0]}") from None


def mesh_of_run(run_folder: Path, number: int = 0) -> Path:
    """The undeformed mesh of an implant of a run, by its number.

    Raises:
        FileNotFoundError: If the run names none, or it is not there.
    """
    files = read_config(Path(run_folder) / "config.yaml").get("files")
    named = files.get("implant") if isinstance(files, dict) else None
    path: str | None = named[number] if isinstance(named, list) and named else named  # type: ignore[assignment]
    if path is None or not Path(path).is_file():
        where = "names none" if path is None else f"names {path}, which is not there"
        raise FileNotFoundError(f"the implant's undeformed mesh is needed, and run folder {run_folder} {where}")
    return Path(path)


class RunFolder:
    """A registration on disk.

    | file | what |
    | --- | --- |
    | `config.yaml` | the resolved configuration; there from the start |
    | `versions.json` | torchkcreg, torch, numpy, ..., platform, threads |
    | `checkpoint.pt` | the trainer's state, replaced as the run goes on |
    | `history.json` | a record an iteration |
    | `metrics.json` | what was measured |
    | `deformation.json` | all parameters of the result; written last, so where it is the run is complete |
    | `arrays.npz` | what of it is too long for JSON: how an implant may be off, and responds to loads |
    | `uncertainty.json` | expected errors, see `uncertainty_of` |
    | `dvf.mha` | displacement field, see `displacement_field` |
    | `bspline.tfm` | ITK transform, see `itk_transform` |
    | `implant_deformed.ply`, `.vtp` | deformed point cloud with the displacement and expected error of each node |
    | `overlay.png`, `displacement.png`, `history.png` | figures |
    | `overlay.npz`, `report.html` | views with and without the implant, and the page that shows them |
    | `seeds/<seed>/` | a run folder of each seed, where several were run |

    Use `RunFolder.create` for a new or resumed run and `read_run` for a finished one.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @classmethod
    def create(cls, path: str | os.PathLike[str], *, overwrite: bool = False, resume: bool = False) -> RunFolder:
        """A run folder ready to be written to.

        Args:
            path: the folder; made, parents too, where it does not exist. An empty one is taken as it is.
            overwrite: discard the run in it: the files that a run writes are deleted, others stay.
            resume: go on with the run in it.

        Raises:
            FileExistsError: there is a run and neither is asked for, or files that are no run.
            FileNotFoundError: there is no run to resume.
            NotADirectoryError: the path, or one above it, is a file.
            ValueError: both are asked for.
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
        if is_run and not (resume or overwrite):
            raise FileExistsError(f"run folder {run.path} holds a run already: overwrite or resume it")
        run._discard(() if resume else RUN_FILES)
        return run

    def start(self, config: dict[str, Any]) -> None:
        """Nothing; writes `config.yaml`, which makes the folder a run, and `versions.json`."""
        write_config(self.path / CONFIG, config)
        write_json(self.path / VERSIONS, versions())

    def of_seed(self, seed: int) -> RunFolder:
        """The run folder, made anew, that keeps the run of one seed of several."""
        return RunFolder.create(self.path / SEEDS / str(seed))

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Nothing; writes the checkpoint, in place of the last one only when it is whole.

        Raises:
            ValueError: something in it is neither a tensor nor plain data, and where; it could not be loaded safely.
        """
        require_loadable(state, "state")
        with atomic_path(self.path / CHECKPOINT) as temporary:
            torch.save(state, temporary)

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last checkpoint, on the CPU, or None where there is none yet; nothing in the file is executed.

        Raises:
            ValueError: the file cannot be read.
        """
        path = self.path / CHECKPOINT
        if not path.is_file():
            return None
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch.load fails in many ways on a damaged file
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise ValueError(f"checkpoint {path} cannot be read: {reason[:120]}") from error

    def write_history(self, history: list[dict[str, Any]]) -> None:
        """Nothing; writes `history.json`."""
        write_json(self.path / HISTORY, history)

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Nothing; writes `metrics.json`."""
        write_json(self.path / METRICS, metrics)

    def write_figure(self, name: str, figure: Figure) -> None:
        """Nothing; writes a figure under a file name such as `overlay.png`."""
        if Path(name).name != name or Path(name).suffix not in _FIGURE_SUFFIXES:
            raise ValueError(f"name must be a file name ending in {', '.join(_FIGURE_SUFFIXES)}, got {name!r}")
        write_figure(self.path / name, figure)

    def write_result(
        self, result: RegistrationResult, points: Sequence[Tensor], *, initial_to_world: Sequence[Tensor] | None = None
    ) -> None:
        """Nothing; writes history, displacement field, ITK transform, deformed cloud and, last, `deformation.json`.

        The files of a second implant, and of more, begin with its name.

        Args:
            result: the registration.
            points: nodes (N, 3) of each implant in its own frame.
            initial_to_world: pose (4, 4) of each from which the cloud's displacements are counted; the identity if not
                given.

        Raises:
            ValueError: a parameter is not finite.
        """
        content, arrays = without_arrays(result.to_dict())
        content = plain(content)  # refuses what cannot be written before anything is
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
        """The result in the folder; see `read_run`."""
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
        for leftover in self.path.glob(f"{TEMPORARY_PREFIX}*"):  # of a run that was killed while writing
            leftover.unlink(missing_ok=True)
        for name in names:
            (self.path / name).unlink(missing_ok=True)
        for name in (FIELD, TRANSFORM, CLOUD, VTK_CLOUD) if names else ():  # of further implants
            for path in self.path.glob(f"*_{name}"):
                path.unlink()
        if names:
            self._discard_seeds(names)

    def _discard_seeds(self, names: tuple[str, ...]) -> None:
        folder = self.path / SEEDS
        for config in folder.glob(f"*/{CONFIG}"):
            RunFolder(config.parent)._discard(names)
        for emptied in (*folder.glob("*/"), folder):
            if emptied.is_dir() and not any(emptied.iterdir()):
                emptied.rmdir()


def uncertainty_of(result: RegistrationResult) -> dict[str, Any]:
    """Expected errors of a registration: of its nodes as a whole, and of each implant across and along the rays, mm."""
    implants = {}
    for implant in result.implants:
        if implant.deviations is not None:
            whole, lateral, depth = implant.deviations.rms
            directions = {"lateral_std_mm": lateral, "depth_std_mm": depth, "depth": implant.deviations.depth}
            implants[implant.name] = {"node_std_mm": whole, **directions}
    return plain({"node_std_mm": result.diagnostics.get("node_std_mm"), "implants": implants})


def read_run(path: str | os.PathLike[str]) -> RegistrationResult:
    """The result of a finished registration, in float64: it warps points as the result that was written did.

    One that is not to be trusted is read too, with a warning that says why.

    Args:
        path: the run folder.

    Raises:
        FileNotFoundError: there is no such folder, or the run in it is not finished.
        ValueError: the files in it are damaged; the message names the file and the key.
    """
    if not Path(path).is_dir():
        raise FileNotFoundError(f"run folder {path} does not exist")
    result = RunFolder(path).read_result()
    if result.status != "ok":
        reasons = "; ".join(result.warnings)
        warnings.warn(f"the registration in {path} is {result.status}: {reasons}", stacklevel=2)
    return result
