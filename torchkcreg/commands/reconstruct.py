"""Reconstruct a volume from files: write volumes, metrics and figures to a folder."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torch.distributed as distributed
from matplotlib.figure import Figure
from torch import Tensor

from torchkcreg.callbacks import Callback
from torchkcreg.geometry import TwoLevelGrid, VolumeGrid
from torchkcreg.io import RECONSTRUCTION, REPORT, RunFolder, read_config, read_volume, write_volume
from torchkcreg.physics import material
from torchkcreg.progress import progress_bar
from torchkcreg.reconstruction import (
    PWLS,
    BeamModel,
    FDKConfig,
    PWLSConfig,
    ViewShard,
    component_path_lengths,
    fdk,
    hounsfield,
    inpainted,
    known_materials,
    path_lengths_through,
    prepare,
    reconstruct,
    seen_from_all_sides,
    unknown_share,
    with_components,
)
from torchkcreg.visualization import beam_figure, reconstruction_figure

from .reconstruct_inputs import ReconstructionInputs, read_reconstruction_inputs
from .reconstruct_options import ReconstructionFiles, ReconstructionOptions
from .report import write_report

CHECKPOINT_EVERY = 5
MEASURED = "measured.mha"
OUTPUTS = (
    *(f"{level}{kind}.mha" for level in ("", "near_metal_") for kind in ("volume", "volume_hu", "with_implant")),
    MEASURED,
    "slices.png",
    "beam.png",
    REPORT,
)


def line_integrals(inputs: ReconstructionInputs, options: ReconstructionOptions) -> Tensor:
    """Input of FDK (V, rows, cols): line integrals with known metal inpainted, or path lengths of a single material."""
    alone = options.single_material
    beam = inputs.beam.without_metals() if alone is None else BeamModel.monoenergetic([])
    lines = prepare(inputs.transmission, inputs.geometry, beam, scatter=inputs.scatter, mask=inputs.mask).line_integrals
    if alone is not None:
        return path_lengths_through(torch.exp(-lines), material(alone), inputs.spectrum)
    if not inputs.components:
        return lines
    metal = component_path_lengths(inputs.components, inputs.geometry, backend=options.backend)
    return inpainted(lines, metal, mask=inputs.mask)


def counted(lines: Tensor) -> Callable[[list[int]], Tensor]:
    """Reader of views out of line integrals (V, rows, cols), with a progress bar that counts the views."""
    bar = progress_bar(total=len(lines), desc="views")

    def read(views: list[int]) -> Tensor:
        bar.update(len(views))
        return lines[views]

    return read


def streamed(inputs: ReconstructionInputs, options: ReconstructionOptions) -> Callable[[list[int]], Tensor]:
    """Reader of FDK's input of some views from the projections' file, with a progress bar that counts the views."""
    bar = progress_bar(total=inputs.geometry.num_views, desc="views")

    def read(views: list[int]) -> Tensor:
        lines = line_integrals(inputs.of_views(views), options)
        bar.update(len(views))
        return lines

    return read


@contextmanager
def processes() -> Iterator[int]:
    """Rank of this process. If `torchrun` started several, torch.distributed is initialized inside the block."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        yield 0
        return
    started = not distributed.is_initialized()
    if started:
        distributed.init_process_group("gloo")
    try:
        yield distributed.get_rank()
    finally:
        if started:
            distributed.destroy_process_group()


def resolve_options(overrides: dict[str, Any], config: Path | None = None) -> ReconstructionOptions:
    """Options of a YAML or JSON file, with overrides on top.

    Raises:
        ValueError: For unknown keys and wrong values, in one line that names them.
    """
    options = read_config(config) if config is not None else {}
    return ReconstructionOptions.of({**options, **overrides}, f"config {config}" if config else "options")


def reconstruct_files(
    files: ReconstructionFiles,
    out: Path,
    options: ReconstructionOptions,
    *,
    overwrite: bool = False,
    resume: bool = False,
    figures: bool = True,
) -> dict[str, Any]:
    """Reconstruct a volume, write its folder `out`, and return the metrics.

    The folder holds `volume.mha` in 1/mm (with known components: the background without them; with a single material:
    its fraction per voxel, and no CT numbers), `volume_hu.mha`, `with_implant.mha` (with known components), the same
    three as `near_metal_...` if voxels near the metal are divided, `measured.mha` (1 where
    lines of all directions pass the voxel), `metrics.json`, `config.yaml`, `slices.png`,
    `report.html` and, with an estimated beam, `beam.png`. Under `torchrun` the views are distributed over the
    processes, and the first process writes.

    Args:
        files: Input files.
        out: Output folder.
        options: Options of the reconstruction.
        overwrite: Replace an existing reconstruction.
        resume: Continue an interrupted reconstruction, which must have been started with the same files and options.
        figures: Draw figures and report.

    Raises:
        ValueError: If files or options are wrong, or a resumed run was started with others.
        FileNotFoundError: If a file is missing.
        FileExistsError: If `out` holds a run and neither overwrite nor resume is set.
    """
    start = time.perf_counter()
    if files.run is not None and out.resolve() == files.run.resolve():
        raise ValueError(f"out must not be the registration's folder {files.run}: it would be overwritten")
    inputs = read_reconstruction_inputs(files, options)
    with processes() as rank:
        shard = ViewShard.of(inputs.geometry.num_views) if distributed.is_initialized() else None
        record = _record(files, options)
        run = _folder(out, record, overwrite=overwrite, resume=resume) if rank == 0 else None
        state = RunFolder(out).load_checkpoint() if resume else None
        levels, history = _reconstructed(files, inputs, options, shard, run, state, out)
        metrics = _metrics(inputs, options, levels, history, time.perf_counter() - start)
        if run is not None:
            _write(run, inputs, options, levels, metrics, figures)
    return metrics


def _reconstructed(
    files: ReconstructionFiles,
    inputs: ReconstructionInputs,
    options: ReconstructionOptions,
    shard: ViewShard | None,
    run: RunFolder | None,
    state: dict[str, Any] | None,
    out: Path,
) -> tuple[list[tuple[Tensor, VolumeGrid]], list[dict[str, Any]]]:
    """Volume and grid, with those near the metal if voxels there are divided; and records of the iterations."""
    geometry, grid, backend = inputs.geometry, inputs.grid, options.backend
    if options.is_filtered:
        ramp = FDKConfig(window=options.window)
        lines = counted(line_integrals(inputs, options)) if inputs.file is None else streamed(inputs, options)
        return [(fdk(lines, geometry, grid, config=ramp, shard=shard, backend=backend), grid)], []
    changes = {name: getattr(options, name) for name in ("iterations", "subsets") if getattr(options, name) is not None}
    config = PWLSConfig.preset(options.preset, beta=options.beta, **changes)
    initial = None
    if files.initial is not None:
        initial, its_grid = read_volume(files.initial)
        if its_grid.shape != grid.shape:
            raise ValueError(f"initial volume {files.initial} has shape {its_grid.shape}, the grid has {grid.shape}")
        if not its_grid.lies_on(grid):
            raise ValueError(f"initial volume {files.initial} has the grid's shape, but lies elsewhere in the world")
    levels = None
    if options.refine > 1:
        metal = 1 - unknown_share(inputs.components, grid)
        levels = TwoLevelGrid.near(metal, grid, within_mm=options.refine_within_mm, factor=options.refine)
    result = reconstruct(
        inputs.transmission if inputs.file is None else inputs.read,
        geometry,
        levels or grid,
        inputs.beam,
        config=config,
        components=inputs.components,
        scatter=inputs.scatter,
        mask=inputs.mask if inputs.file is None else None,
        passes=options.num_passes,
        initial=initial,
        blur_sigma_px=inputs.blur_sigma_px,
        shard=shard,
        backend=backend,
        callbacks=[] if run is None else [_Checkpoints(run, config.iterations)],
        state=state,
        progress=None if run is not None else False,
        folder=None if inputs.file is None else out,
    )
    if levels is None:
        return [(result.volume, grid)], result.history
    return list(zip(levels.volumes(result.volume), (grid, levels.fine), strict=True)), result.history


class _Checkpoints(Callback):
    """Write a checkpoint every few iterations and at the end of a pass."""

    def __init__(self, folder: RunFolder, iterations: int) -> None:
        self.folder, self.iterations = folder, iterations

    def on_iteration(self, run: PWLS, index: int, progress: dict[str, Any]) -> None:
        if progress["iteration"] % CHECKPOINT_EVERY == 0 or progress["iteration"] == self.iterations:
            self.folder.save_checkpoint({"pass": index, "solver": run.state_dict(), "volume": run.initial})


def _metrics(
    inputs: ReconstructionInputs,
    options: ReconstructionOptions,
    levels: list[tuple[Tensor, VolumeGrid]],
    history: list[dict[str, Any]],
    seconds: float,
) -> dict[str, Any]:
    beam, volume = inputs.beam, levels[0][0]
    return {
        "shape": list(volume.shape),
        "spacing_mm": list(inputs.grid.spacing),
        "near_metal_mm": list(levels[1][1].spacing) if len(levels) > 1 else None,
        "mean": float(volume.mean()),
        "largest": float(volume.max()),
        "reference_kev": beam.reference_kev,
        "water": beam.water,
        "scatter": inputs.scatter_in_words(),
        "beam": None if inputs.estimate is None else inputs.estimate.in_words(),
        "components": [component.material for component in inputs.components],
        "passes": None if options.is_filtered else options.num_passes,
        "history": history,
        "seconds": seconds,
    }


def _write(
    run: RunFolder,
    inputs: ReconstructionInputs,
    options: ReconstructionOptions,
    levels: list[tuple[Tensor, VolumeGrid]],
    metrics: dict[str, Any],
    figures: bool,
) -> None:
    beam, shares, with_implant = inputs.beam, options.single_material is not None, None
    for prefix, (volume, grid) in zip(("", "near_metal_"), levels, strict=False):
        write_volume(run.path / f"{prefix}volume.mha", volume, grid)
        if not shares:
            numbers = hounsfield(volume, beam.water).round().to(torch.int32)
            write_volume(run.path / f"{prefix}volume_hu.mha", numbers, grid)
        if inputs.components:
            with_implant = _with_implant(inputs, volume, grid)
            write_volume(run.path / f"{prefix}with_implant.mha", with_implant, grid)
    write_volume(run.path / MEASURED, seen_from_all_sides(inputs.geometry, inputs.grid).to(torch.uint8), inputs.grid)
    if figures:
        if (estimate := inputs.estimate) is not None:
            curve = beam_figure(estimate.beam.beam, estimate.alloys, estimate.lengths_mm, estimate.measured)
            run.write_figure("beam.png", curve)
        window = (0.0, 1.2 if shares else 2 * beam.water)
        run.write_figure("slices.png", _slices(inputs, *levels[-1], with_implant, window))
    run.write_metrics(metrics)
    if figures:
        write_report(run.path)


def _with_implant(inputs: ReconstructionInputs, volume: Tensor, grid: VolumeGrid) -> Tensor:
    energy = inputs.beam.reference_kev
    if energy is None:
        values = [float(row[0]) for row in inputs.beam.attenuation]
    else:
        values = [float(material(m).attenuation((energy,))[0]) for m in known_materials(inputs.components)]
    return with_components(volume, inputs.components, grid, values)


def _slices(
    inputs: ReconstructionInputs,
    volume: Tensor,
    grid: VolumeGrid,
    with_implant: Tensor | None,
    window: tuple[float, float],
) -> Figure:
    """Figure of slices at three heights, of the volume and, with known components, of the volume with implant."""
    middle, reach = grid.origin[2] + grid.size_mm[2] / 2, grid.size_mm[2] / 4
    heights = (middle - reach, middle, middle + reach) if grid.shape[0] > 3 else (middle,)
    shown, metal = {"reconstruction": volume}, None
    if with_implant is not None:
        shown = {"background": volume, "with the implant": with_implant}
        metal = sum((component.fraction(grid) for component in inputs.components), torch.zeros(grid.shape))
    return reconstruction_figure(shown, grid, heights_mm=heights, window=window, metal=metal)


def _record(files: ReconstructionFiles, options: ReconstructionOptions) -> dict[str, Any]:
    names = {k: str(v.resolve()) if isinstance(v, Path) else v for k, v in vars(files).items() if v is not None}
    return {"files": names, "reconstruction": options.model_dump(mode="json")}


def _folder(out: Path, record: dict[str, Any], *, overwrite: bool, resume: bool) -> RunFolder:
    run = RunFolder.create(out, kind=RECONSTRUCTION, overwrite=overwrite, resume=resume)
    if resume:
        previous = read_config(run.path / "config.yaml")
        changed = sorted(key for key in previous.keys() | record.keys() if previous.get(key) != record.get(key))
        if changed:
            raise ValueError(f"run folder {run.path} was started with other {' and '.join(changed)}")
        return run
    for name in OUTPUTS:
        (run.path / name).unlink(missing_ok=True)
    run.start(record)
    return run
