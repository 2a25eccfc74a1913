"""Where the mesh is that a run was started with."""

from __future__ import annotations

from pathlib import Path

from torchkcreg.io import read_config


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
