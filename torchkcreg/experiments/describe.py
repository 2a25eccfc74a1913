"""What a file or a run folder holds, and what is installed, in a few lines for people."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from torchkcreg.deformation import FiniteElementDeformation, FreeFormDeformation
from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.implant import volume
from torchkcreg.io import RunFolder, geometry_from_dict, read_json, read_mesh, read_projections, versions
from torchkcreg.kernels import PACKAGE, choose_backend, unavailable_reason
from torchkcreg.registration import RegisteredImplant

_MESHES = (".stl", ".obj", ".ply", ".off", ".3mf")
_IMAGES = (".npz", ".npy", ".mha", ".mhd", ".nrrd", ".nii", ".gz", ".tif", ".tiff")


def describe_installation() -> str:
    """Versions, threads and the projector's backend with the reason for it, a line each."""
    lines = [f"{name} {version}" for name, version in versions().items()]
    backend, why = kernels_in_words()
    return "\n".join([*lines, f"projector backend {backend} ({why})"])


def kernels_in_words() -> tuple[str, str]:
    """The projector's backend on a CPU, and why it is this one."""
    backend = choose_backend(torch.empty(0), "auto").name
    if backend != "cpp":
        return backend, f"the readable reference, slow; no C++ kernels: {unavailable_reason()}"
    built = any(PACKAGE.glob("_C*.so")) or any(PACKAGE.glob("_C*.pyd"))
    return backend, "C++ kernels built with the package" if built else "C++ kernels compiled at first use"


def describe(path: Path, *, open_beam: float | None = None) -> str:
    """What a mesh, a geometry, projections or a run folder holds.

    Args:
        path: A run folder, a mesh (STL, OBJ, PLY, OFF, 3MF), a geometry (JSON) or projections (NPZ, NPY, MHA, ...).
        open_beam: Unattenuated intensity, where projections do not say it.

    Raises:
        FileNotFoundError: If nothing is there, or the run in the folder is not finished.
        ValueError: If it cannot be read, or is none of these.
    """
    path = Path(path)
    readers: dict[tuple[str, ...], Callable[[Path], str]] = {
        _MESHES: _mesh,
        (".json",): _geometry,
        _IMAGES: partial(_projections, open_beam=open_beam),
    }
    if path.is_dir():
        return f"{path}: {_run(path)}"
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    for suffixes, read in readers.items():
        if path.suffix.lower() in suffixes:
            return f"{path}: {read(path)}"
    known = ", ".join(suffix for suffixes in readers for suffix in suffixes)
    raise ValueError(f"{path} is none of what can be described: a run folder, or a file ending in {known}")


def _mesh(path: Path) -> str:
    mesh = read_mesh(path)
    low, high = mesh.bounds
    size = " x ".join(f"{extent:.4g}" for extent in high - low)
    center = ", ".join(f"{x:.4g}" for x in (low + high) / 2)
    return f"closed mesh, {len(mesh.faces)} triangles, {size} mm about ({center}), volume {volume(mesh):.6g} mm^3"


def _geometry(path: Path) -> str:
    content = read_json(path, "geometry")
    if not isinstance(content, dict) or "views" not in content:
        raise ValueError(f"{path} is no geometry: it has no 'views'")
    try:
        geometry = geometry_from_dict(content)
    except ValueError as error:
        raise ValueError(f"geometry file {path}: {error}") from error
    rows, cols = geometry.det_shape
    dv, du = geometry.pixel_spacing
    distances = geometry.detector_distances
    head = (
        f"geometry, {geometry.num_views} views of {rows} x {cols} pixels ({dv:.4g} x {du:.4g} mm), source to detector "
        f"{_range(distances.min().item(), distances.max().item())} mm"
    )
    return "\n".join([head, *(f"  view {i}: {_view(geometry, i)}" for i in range(geometry.num_views))])


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


def _run(path: Path) -> str:
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
        return f"{implant.name}: elastic body held at {len(element.holds)} places, {element.num_amounts} ways to bend"
    if not isinstance(deformation, FreeFormDeformation):
        return f"{implant.name}: {deformation.model} deformation"
    shape = " x ".join(str(n) for n in deformation.grid.shape)
    groups = deformation.num_groups
    return f"{implant.name}: {shape} control points in {groups} group{'s' * (groups > 1)}"
