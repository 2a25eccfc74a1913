"""Describe files, folders and the installation in a few lines; rank runs of the same images."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from torchkcreg.deformation import FiniteElementDeformation, FreeFormDeformation
from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.implant import volume
from torchkcreg.io import (
    MESH_SUFFIXES,
    RunFolder,
    geometry_from_dict,
    read_components,
    read_config,
    read_geometry,
    read_init,
    read_json,
    read_mesh,
    read_points,
    read_projections,
    read_rtk,
    read_spectrum,
    read_volume,
    versions,
    write_figure,
)
from torchkcreg.io.scans import is_dicom
from torchkcreg.kernels import PACKAGE, choose_backend, unavailable_reason
from torchkcreg.registration import RegisteredImplant
from torchkcreg.visualization import geometry_figure

_IMAGES = ("projections", "geometry", "views", "open_beam")
_VOLUMES = (".mha", ".mhd", ".nrrd", ".nhdr", ".nii", ".gz")
_STACKS = (".tif", ".tiff", ".png", ".h5", ".hdf5", ".hdf", ".nxs")


def runs_compared(paths: Sequence[Path]) -> str:
    """Ranking of the run folders of the same images among the paths by Akaike's criterion, best first, as text.

    The criterion is `n ln(misfit) + 2 p`: n is the number of informative pixel blocks, misfit the unexplained part of
    the images' contrast, and p the effective number of parameters that the images determine (priors reduce it). Only
    differences are meaningful; 10 is a clear difference. The text is empty if there are fewer than two such runs.

    Args:
        paths: Run folders; other paths are skipped.
    """
    runs = [(path, *run) for path in paths if (run := _told(path)) is not None]
    same = [run for run in runs if run[1] == runs[0][1]]
    if len(same) < 2:
        return ""
    blocks = sum(diagnostics["blocks"] for *_, diagnostics in same) / len(same)
    ranked = sorted((blocks * math.log(f["misfit"]) + 2 * f["effective_parameters"], path, f) for path, _, f in same)
    lines = ["which explains the same images better (difference of Akaike's criterion):"]
    for value, path, diagnostics in ranked:
        words = (
            f"misfit {diagnostics['misfit']:.4f} with {diagnostics['effective_parameters']:.1f} effective parameters"
        )
        lines.append(f"  {path}: +{value - ranked[0][0]:.1f}, {words}")
    return "\n".join(lines)


def _told(path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Image files of a finished run and its diagnostics; None for anything else."""
    if not ((path / "config.yaml").is_file() and (path / "metrics.json").is_file()):
        return None
    files = read_config(path / "config.yaml").get("files")
    diagnostics = read_json(path / "metrics.json", "metrics").get("diagnostics", {})
    if not isinstance(files, dict) or not all(
        diagnostics.get(key) for key in ("blocks", "misfit", "effective_parameters")
    ):
        return None
    return {name: files.get(name) for name in _IMAGES}, diagnostics


def describe_run(path: Path) -> str:
    """Description of a registration: verdict, measured motion, expected error and time."""
    run = RunFolder(path)
    result = run.read_result()
    metrics = read_json(path / "metrics.json", "metrics") if (path / "metrics.json").is_file() else {}
    sizes = "; ".join(_size(implant) for implant in result.implants)
    lines = [
        f"run, {result.status}, {sizes}, {len(result.history)} iterations",
        "  gradient correlation of each view: " + " ".join(f"{gc:.3f}" for gc in result.gc.tolist()),
    ]
    if isinstance(metrics.get("node_std_mm"), float):
        lines.append(f"  expected error of the nodes: {metrics['node_std_mm']:.3f} mm (RMS)")
    if {"mean_motion_mm", "largest_motion_mm"} <= metrics.keys():
        lines.append(
            f"  motion of the nodes: mean {metrics['mean_motion_mm']:.3f} mm, largest "
            f"{metrics['largest_motion_mm']:.3f} mm"
        )
    if isinstance(metrics.get("seconds"), (int, float)):
        lines.append(f"  took {metrics['seconds']:.0f} s")
    lines += [f"  {name}: {value:.3g}" for name, value in result.intensity.items()]
    return "\n".join([*lines, *(f"  warning: {text}" for text in result.warnings)])


def _size(implant: RegisteredImplant) -> str:
    deformation = implant.deformation
    if isinstance(deformation, FiniteElementDeformation):
        element = deformation.superelement
        return f"{implant.name}: elastic body held at {len(element.holds)} places, {element.num_amounts} parameters"
    if not isinstance(deformation, FreeFormDeformation):
        return f"{implant.name}: {deformation.model} deformation"
    shape = " x ".join(str(n) for n in deformation.grid.shape)
    groups = deformation.num_groups
    return f"{implant.name}: {shape} control points in {groups} group{'s' * (groups > 1)}"


def describe_installation() -> str:
    """Versions, threads and the projector's backend with its reason, a line each."""
    lines = [f"{name} {version}" for name, version in versions().items()]
    backend, why = kernels_in_words()
    return "\n".join([*lines, f"projector backend {backend} ({why})"])


def kernels_in_words() -> tuple[str, str]:
    """The projector's backend on the CPU, and the reason for it."""
    backend = choose_backend(torch.empty(0), "auto").name
    if backend != "cpp":
        return backend, f"the readable reference, slow; no C++ kernels: {unavailable_reason()}"
    built = any(PACKAGE.glob("_C*.so")) or any(PACKAGE.glob("_C*.pyd"))
    return backend, "C++ kernels built with the package" if built else "C++ kernels compiled at first use"


def describe(path: Path, *, open_beam: float | None = None) -> str:
    """Description of a mesh, a geometry, projections, a table, a configuration, a volume or a folder of results.

    Args:
        path: A folder (a run, a reconstruction, a comparison, images), or a file of any kind that is read or written.
        open_beam: Unattenuated intensity of projections, if their file does not give it.

    Raises:
        FileNotFoundError: If the path does not exist, or the run in the folder is not finished.
        ValueError: If it cannot be read, or is of another kind.
    """
    path, projections = Path(path), partial(_projections, open_beam=open_beam)
    readers: dict[tuple[str, ...], list[Callable[[Path], str]]] = {
        MESH_SUFFIXES: [_mesh],
        (".json",): [_json],
        (".xml",): [_rtk],
        (".csv", ".txt"): [_spectrum, _points, _matrices],
        (".npz", ".npy"): [_matrices, projections],
        _VOLUMES: [projections, _volume],
        _STACKS: [projections],
        (".yaml", ".yml"): [partial(_yaml, open_beam=open_beam)],
    }
    if path.is_dir():
        return f"{path}: {_folder(path, open_beam)}"
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if is_dicom(path):
        return f"{path}: {_first(path, [_dicom, projections])}"
    for suffixes, candidates in readers.items():
        if path.suffix.lower() in suffixes:
            return f"{path}: {_first(path, candidates)}"
    known = ", ".join(suffix for suffixes in readers for suffix in suffixes)
    raise ValueError(
        f"{path} cannot be described: it is neither a folder of results, nor DICOM, nor a file ending in {known}"
    )


def picture_geometry(paths: Sequence[Path], out: Path) -> None:
    """Write a figure of a geometry's focal spots and detectors.

    Raises:
        ValueError: If there is not exactly one file, or it does not describe a complete geometry.
    """
    if len(paths) != 1:
        raise ValueError(f"a picture is of one geometry, got {len(paths)} files")
    write_figure(out, geometry_figure(read_geometry(paths[0]), title=paths[0].name))


def _first(path: Path, candidates: list[Callable[[Path], str]]) -> str:
    """Description by the first reader that can read the file; if none can, the error of the last one."""
    for read in candidates[:-1]:
        with contextlib.suppress(ValueError):
            return read(path)
    return candidates[-1](path)


def _mesh(path: Path) -> str:
    mesh = read_mesh(path)
    low, high = mesh.bounds
    size = " x ".join(f"{extent:.4g}" for extent in high - low)
    center = ", ".join(f"{x:.4g}" for x in (low + high) / 2)
    return f"closed mesh, {len(mesh.faces)} triangles, {size} mm about ({center}), volume {volume(mesh):.6g} mm^3"


def _json(path: Path) -> str:
    content = read_json(path, "JSON")
    keys = content.keys() if isinstance(content, dict) else {}
    if "screws" in keys:
        screws = read_components(path)
        materials = ", ".join(sorted({screw.material for screw in screws}))
        return f"screws, {len(screws)} of {materials}"
    if "implant_to_world" in keys:
        shift = ", ".join(f"{x:.4g}" for x in read_init(path)[:3, 3].tolist())
        return f"initial pose, shifts the implant's origin to ({shift}) mm"
    if "views" in keys:
        try:
            return _geometry(geometry_from_dict(content))
        except ValueError as error:
            raise ValueError(f"geometry file {path}: {error}") from error
    return f"JSON with {', '.join(sorted(map(str, keys))) or 'no keys'}: neither geometry, nor screws, nor initial pose"


def _rtk(path: Path) -> str:
    return _geometry(
        read_rtk(path, det_shape=(1, 1), pixel_spacing=(1.0, 1.0)), "RTK's geometry (pixels are the images')"
    )


def _matrices(path: Path) -> str:
    return _geometry(
        read_geometry(path, det_shape=(1, 1), pixel_spacing=(1.0, 1.0), layout="matrices"),
        "3 x 4 matrices (pixels are the images')",
    )


def _dicom(path: Path) -> str:
    return _geometry(read_geometry(path))


def _geometry(geometry: ConeBeamGeometry, what: str = "") -> str:
    rows, cols = geometry.det_shape
    dv, du = geometry.pixel_spacing
    distances = geometry.detector_distances
    head = what or (
        f"geometry, {geometry.num_views} views of {rows} x {cols} pixels ({dv:.4g} x {du:.4g} mm), source to detector "
        f"{_range(distances.min().item(), distances.max().item())} mm"
    )
    return "\n".join([head, *(f"  view {i}: {_view(geometry, i)}" for i in range(geometry.num_views))])


def _spectrum(path: Path) -> str:
    spectrum = read_spectrum(path)
    low, high = min(spectrum.energies_kev), max(spectrum.energies_kev)
    number, mean = len(spectrum.weights), spectrum.mean_energy
    return f"spectrum, {number} energies from {low:g} to {high:g} keV, mean {mean:.1f} keV"


def _points(path: Path) -> str:
    points = read_points(path)
    low, high = points.amin(0).tolist(), points.amax(0).tolist()
    spans = " ".join(f"{name} {a:.4g} to {b:.4g}" for name, a, b in zip("xyz", low, high, strict=True))
    return f"points, {len(points)}: {spans} mm"


def _volume(path: Path) -> str:
    values, grid = read_volume(path)
    size = " x ".join(str(n) for n in reversed(grid.shape))
    spacing = " x ".join(f"{step:.4g}" for step in reversed(grid.spacing))
    return f"volume, {size} voxels of {spacing} mm, values {values.min():.4g} to {values.max():.4g}"


def _yaml(path: Path, *, open_beam: float | None) -> str:
    content = read_config(path)
    if "images" in content:
        return _projections(path, open_beam=open_beam)
    return f"configuration with {', '.join(content) or 'nothing'}"


def _folder(path: Path, open_beam: float | None) -> str:
    if (path / "deformation.json").exists() or ((path / "config.yaml").exists() and not (path / "volume.mha").exists()):
        return describe_run(path)
    if (path / "volume.mha").exists():
        return "reconstruction; volume.mha is a " + _volume(path / "volume.mha")
    for name, what in (("compare.json", "comparison"), ("load.json", "loads"), ("plan.json", "plan of views")):
        if (path / name).exists():
            return f"{what}, in {name}"
    try:
        return _projections(path, open_beam=open_beam)
    except ValueError as error:
        raise FileNotFoundError(f"{path} holds neither results nor a scan: {error}") from error


def _view(geometry: ConeBeamGeometry, view: int) -> str:
    angle = "" if geometry.angles_deg is None else f"{geometry.angles_deg[view]:g} degrees, "
    name = "source" if geometry.sources is None else f"source {geometry.sources[view]}"
    x, y, z = (round(x, 1) + 0.0 for x in geometry.source_positions[view].tolist())  # no -0.0
    return f"{angle}{name} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"


def _range(low: float, high: float) -> str:
    return f"{low:.4g}" if high - low < 1e-4 * high else f"{low:.4g} to {high:.4g}"


def _projections(path: Path, *, open_beam: float | None) -> str:
    projections = read_projections(path, open_beam=open_beam)
    views, rows, cols = projections.line_integrals.shape
    values = projections.line_integrals[projections.mask]
    span = f"line integrals {values.min():.3g} to {values.max():.3g}" if len(values) else "no valid pixel"
    masked = [f"{count} pixels masked ({reason})" for reason, count in projections.num_masked.items()]
    saturated = [f"{projections.num_saturated} saturated"] if projections.num_saturated else []
    return ", ".join([f"projections, {views} views of {rows} x {cols} pixels", span, *masked, *saturated])
