"""An implant of a run, and where the mesh is that the run was started with."""

from __future__ import annotations

from pathlib import Path

from torchkcreg.io import read_config, read_run
from torchkcreg.registration import RegisteredImplant, RegistrationResult


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
