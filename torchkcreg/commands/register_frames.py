"""Register the same implants in a series of frames, each from its neighbour's result, and their motion over them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchkcreg.evaluation import FRAME_COLUMNS, FrameMotion, frame_motion
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_mesh, write_figure, write_json, write_text, write_tra
from torchkcreg.io.runs import CONFIG
from torchkcreg.plain import first_line, plain, std_key
from torchkcreg.registration import RegisteredImplant, RegistrationResult
from torchkcreg.visualization import frames_figure

from .register import register_files
from .register_inputs import RegistrationFiles

_PITCH_MM = 1.0
_FAILED = "failed"
_NOWHERE = torch.full((4, 4), torch.nan, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class FrameSeries:
    """Registrations of a series of frames.

    Attributes:
        names: Name of each frame; its run folder has the same name.
        statuses: Status of each registration, "failed" also where there is none.
        reasons: Reasons to doubt each frame, or why there is no registration.
        motions: Motion of each implant since the first frame by its name: relative to the last implant, which is the
            reference, or in the world if there is only one.
        reference: Name of the reference: an implant, or "world".
        folder: Output folder.
    """

    names: tuple[str, ...]
    statuses: tuple[str, ...]
    reasons: tuple[tuple[str, ...], ...]
    motions: dict[str, FrameMotion]
    reference: str
    folder: Path

    def to_dict(self) -> dict[str, Any]:
        """Dictionary of plain types and tensors, with units in the keys; null where there is no number."""
        implants = {}
        for name, motion in self.motions.items():
            rows = zip(motion.values.tolist(), motion.std.tolist(), motion.poses, strict=True)
            implants[name] = [
                {
                    **{column: _finite(value) for column, value in zip(FRAME_COLUMNS, values, strict=True)},
                    **{std_key(column): _finite(value) for column, value in zip(FRAME_COLUMNS, std, strict=True)},
                    "pose": pose if bool(pose.isfinite().all()) else None,
                }
                for values, std, pose in rows
            ]
        frames = zip(self.names, self.statuses, self.reasons, strict=True)
        return {
            "frames": [{"name": n, "status": s, "reasons": list(r)} for n, s, r in frames],
            "reference": self.reference,
            "implants": implants,
        }

    def table(self) -> str:
        """CSV table with a row for each frame and implant; empty where there is no number."""
        heads = ["frame", "status", "implant", *(c for name in FRAME_COLUMNS for c in (name, std_key(name)))]
        lines = [",".join(heads)]
        for number, (frame, status) in enumerate(zip(self.names, self.statuses, strict=True)):
            for name, motion in self.motions.items():
                pairs = torch.stack([motion.values[number], motion.std[number]], dim=1).flatten().tolist()
                cells = [f"{value:.5f}" if math.isfinite(value) else "" for value in pairs]
                lines.append(",".join([frame, status, name, *cells]))
        return "\n".join(lines) + "\n"

    def __str__(self) -> str:
        lines = []
        for name, motion in self.motions.items():
            lines.append(f"{name} relative to {self.reference}, since {self._first}:")
            for frame, status, angle, values, std in zip(
                self.names, self.statuses, motion.angles_deg.tolist(), motion.values, motion.std, strict=True
            ):
                shift, error = float(values[3:].norm()), float(std[3:].norm())
                size = f"turned {angle:.2f} +- {float(std[:3].norm()):.2f} degrees, moved {shift:.3f} +- {error:.3f} mm"
                lines.append(f"  {frame}: {size if math.isfinite(angle) else 'no registration'} ({status})")
        return "\n".join([*lines, f"folder {self.folder}"])

    @property
    def _first(self) -> str:
        motion = next(iter(self.motions.values()))
        return self.names[int(motion.angles_deg.isfinite().nonzero()[0])]


def register_frames(
    files: RegistrationFiles,
    frames: Sequence[Path],
    out: Path,
    *,
    overrides: dict[str, Any] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    figures: bool = True,
) -> FrameSeries:
    """Register implants in each frame of a series; write a run folder a frame, `frames.json`, `.csv` and `.png`.

    `NAME.tra` has the pose of each implant in the world, a line a frame.

    Each frame starts from the result of the one before it; where that does not agree with the images, the implants are
    searched for. A frame that cannot be registered is listed with its reason and does not stop the others. The last
    implant is the reference for the motion of the others.

    Args:
        files: Input files; the projections are replaced by each frame's, and `init` is the start of the first frame.
        frames: Projections of each frame, of the same geometry.
        out: Output folder.
        overrides: Options that override those of `files.config`.
        overwrite: Replace existing runs in the folder.
        resume: Continue an interrupted series.
        figures: Draw figures and write reports.

    Raises:
        ValueError: If two frames have the same name, or no frame could be registered.
        FileExistsError: If `out` holds runs and neither overwrite nor resume is set.
    """
    names = [path.stem if path.is_file() else path.name for path in frames]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"frames are named after their files, but {twice[0]} is there {names.count(twice[0])} times")
    if not (overwrite or resume):
        for name in names:
            if (out / name / CONFIG).exists():
                raise FileExistsError(f"run folder {out / name} holds a run already: overwrite or resume it")
    results: list[RegistrationResult | None] = []
    statuses: list[str] = []
    reasons: list[tuple[str, ...]] = []
    start: Path | None = None
    for name, projections in zip(names, frames, strict=True):
        inputs = replace(files, projections=projections)
        if start is not None:
            inputs = replace(inputs, init=start if isinstance(files.implant, Path) else [start] * len(files.each()))
        going_on = resume and (out / name / CONFIG).exists()
        try:
            result = register_files(
                inputs, out / name, overrides=overrides, overwrite=overwrite, resume=going_on, figures=figures
            )
        except (ValueError, OSError, RuntimeError) as error:
            results.append(None)
            statuses.append(_FAILED)
            reasons.append((first_line(error),))
            warnings.warn(f"frame {name} was not registered: {first_line(error)}", stacklevel=2)
            continue
        failed = result.status == _FAILED
        results.append(None if failed else result)
        statuses.append(result.status)
        reasons.append(tuple(result.warnings))
        start = start if failed else out / name
    if all(result is None for result in results):
        raise ValueError(f"none of {len(frames)} frames was registered; the last: {reasons[-1][0]}")
    motions, reference = _motions(files, results)
    series = FrameSeries(tuple(names), tuple(statuses), tuple(reasons), motions, reference, out)
    write_json(out / "frames.json", plain(series.to_dict()))
    write_text(out / "frames.csv", series.table())
    for implant in files.each():
        poses = [_NOWHERE if result is None else result.implant(implant.name).implant_to_world for result in results]
        write_tra(out / f"{implant.name}.tra", torch.stack(poses))
    if figures:
        for name, motion in motions.items():
            title = f"{name} relative to {reference}"
            figure = frames_figure(motion.values, motion.std, names, title=title)
            write_figure(out / ("frames.png" if len(motions) == 1 else f"{name}_frames.png"), figure)
    return series


def _motions(
    files: RegistrationFiles, results: Sequence[RegistrationResult | None]
) -> tuple[dict[str, FrameMotion], str]:
    """Motion of each implant relative to the last one, or of the only one in the world, and the reference's name."""
    each = files.each()
    clouds = {f.name: ImplantPointCloud.from_mesh(read_mesh(f.mesh), _PITCH_MM, dtype=torch.float64) for f in each}

    def registered(name: str) -> list[RegisteredImplant | None]:
        return [None if result is None else result.implant(name) for result in results]

    *moving, last = clouds
    if not moving:
        return {last: frame_motion(registered(last), clouds[last])}, "world"
    reference = registered(last)
    return {name: frame_motion(registered(name), clouds[name], reference, clouds[last]) for name in moving}, last


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
