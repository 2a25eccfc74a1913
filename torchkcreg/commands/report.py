"""Write a results folder (registration, comparison, reconstruction, ...) as one self-contained HTML page."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, DetectorFrames, principal_axes
from torchkcreg.io import (
    LAYERS,
    REPORT,
    read_config,
    read_geometry,
    read_json,
    read_layers,
    read_point_cloud_ply,
    write_text,
)
from torchkcreg.visualization import Page, Row, page_html, png_of

MOST_POINTS = 6000  # largest number of points in the 3D view
NAMES = {
    "overlay.png": "Measured views, and the registered implant in them",
    "displacement.png": "Displacement of the implant",
    "history.png": "Course of the registration",
    "slices.png": "Slices of the volume",
    "beam.png": "Transmission over metal thickness, measured and estimated",
    "compare.png": "Motion between the registrations",
    "densitometry.png": "Bone mineral",
    "load.png": "Loads of the implant",
}
TABLES = ("compare.json", "densitometry.json", "load.json")
INTENSITY = {
    "scatter": ("scatter, over the primary", ""),
    "scatter_removed": ("scatter, over the removed intensity", ""),
    "blur_sigma_px": ("blur, standard deviation", "pixels"),
    "hardness": ("additional filtration", "mm aluminium"),
}
SCALARS = {
    "seconds": ("time", "s", "{:.0f}"),
    "largest": ("largest attenuation", "1/mm", "{:.4f}"),
    "mean": ("mean attenuation", "1/mm", "{:.5f}"),
    "reference_kev": ("reference energy", "keV", "{:.1f}"),
    "passes": ("passes", "", "{}"),
}


def write_report(folder: Path, *, out: Path | None = None) -> Path:
    """Write `report.html` of a results folder and return its path.

    The page needs no other file and no network. It shows verdict and warnings, numbers with error bars, the implant in
    3D, the folder's figures, options and versions.

    Args:
        folder: Folder of a registration, a comparison, a reconstruction, or another one with `metrics.json` or a table.
        out: Page to write; `report.html` in the folder if None.

    Raises:
        FileNotFoundError: If the folder does not exist.
        ValueError: If the folder holds no results.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"folder {folder} does not exist")
    metrics = _read(folder / "metrics.json")
    pictures = [picture_of(path, NAMES.get(path.name, path.stem)) for path in _pictures(folder)]
    tables = {path.name: read_json(path, "table") for path in sorted(folder.glob("*.json")) if path.name in TABLES}
    is_run = (folder / "deformation.json").is_file()
    if not metrics and not tables and not is_run:
        raise ValueError(f"folder {folder} holds no results: neither metrics.json nor {', '.join(TABLES)}")
    rows = (_run_rows(metrics) if is_run else _scalar_rows(metrics)) + [
        row for content in tables.values() for row in _nested_rows(content)
    ]
    scene = implant_scene(*_clouds(folder), views=_views(folder)) if is_run else None
    versions = _read(folder / "versions.json")
    page = Page(
        f"{_kind(folder)}: {folder.resolve().name}",
        verdict=metrics.get("status") if is_run else None,
        summary=_summary(metrics) if is_run else "",
        warnings=[str(text) for text in metrics.get("warnings") or []],
        rows=rows,
        scene=scene,
        layers=layers_of(folder),
        pictures=pictures,
        details=_details(folder),
        made_with=", ".join(f"{name} {version}" for name, version in versions.items() if isinstance(version, str)),
    )
    target = out or folder / REPORT
    write_text(target, page_html(page))
    return target


def _kind(folder: Path) -> str:
    kinds = {
        "deformation.json": "Registration",
        "volume.mha": "Reconstruction",
        "compare.json": "Comparison",
        "load.json": "Loads of the implant",
        "densitometry.json": "Bone mineral",
    }
    return next((kind for name, kind in kinds.items() if (folder / name).is_file()), "Results")


def _read(path: Path) -> dict[str, Any]:
    content = read_json(path, path.stem) if path.is_file() else {}
    return content if isinstance(content, dict) else {}


def picture_of(path: Path, title: str) -> tuple[str, bytes]:
    """A picture for a page: its title and content."""
    return title, path.read_bytes()


def _pictures(folder: Path) -> list[Path]:
    order = {name: number for number, name in enumerate(NAMES)}
    return sorted(folder.glob("*.png"), key=lambda path: (order.get(path.name, len(order)), path.name))


def _summary(metrics: dict[str, Any]) -> str:
    deviation = metrics.get("node_std_mm")
    expected = ""
    if isinstance(deviation, float):
        expected = f"The implant's nodes are expected to be off by {deviation:.3f} mm (RMS)."
    return {
        "ok": f"The result can be trusted. {expected}",
        "doubtful": f"Look before trusting the numbers. {expected}",
        "failed": "Do not use these numbers.",
    }.get(str(metrics.get("status")), expected)


def _run_rows(metrics: dict[str, Any]) -> list[Row]:
    rows = []
    deviation = metrics.get("node_std_mm")
    error = f"{deviation:.3f} mm" if isinstance(deviation, float) else ""
    if isinstance(metrics.get("largest_bending_mm"), float):
        about = "largest distance of a node from the best rigid fit of the undeformed implant"
        rows.append(Row("bending of the implant", f"{metrics['largest_bending_mm']:.3f} mm", about=about))
    for key, name, about in (
        ("mean_motion_mm", "mean motion of the implant", "from its start pose"),
        ("largest_motion_mm", "largest motion", "from its start pose"),
    ):
        if isinstance(metrics.get(key), float):
            rows.append(Row(name, f"{metrics[key]:.3f} mm", error, about))
    correlations = [value for value in metrics.get("gc") or [] if isinstance(value, float)]
    if correlations:
        about = "of each view: " + " ".join(f"{value:.3f}" for value in correlations)
        rows.append(Row("gradient correlation, least", f"{min(correlations):.3f}", about=about))
    rows += _scalar_rows(metrics)
    for name, value in (metrics.get("intensity") or {}).items():
        label, unit = INTENSITY.get(name, (str(name).replace("_", " "), ""))
        rows.append(Row(f"image model: {label}", f"{value:.3g} {unit}".strip(), about="estimated with the implant"))
    return rows


def _scalar_rows(metrics: dict[str, Any]) -> list[Row]:
    rows = [
        Row(name, f"{form.format(metrics[key])} {unit}".strip())
        for key, (name, unit, form) in SCALARS.items()
        if isinstance(metrics.get(key), (int, float))
    ]
    if isinstance(metrics.get("shape"), list) and isinstance(metrics.get("spacing_mm"), list):
        size = " x ".join(str(count) for count in reversed(metrics["shape"]))
        rows.insert(0, Row("voxels", size, about=f"of {' x '.join(f'{x:g}' for x in metrics['spacing_mm'])} mm"))
    for name, title in (("scatter", "scatter"), ("beam", "estimated beam")):
        if isinstance(metrics.get(name), dict):
            rows += [replace(row, name=f"{title}: {row.name}") for row in _nested_rows(metrics[name])]
    if metrics.get("components"):
        rows.append(Row("known metal", str(len(metrics["components"])), about=", ".join(metrics["components"])))
    return rows


def _nested_rows(content: Any, prefix: str = "") -> list[Row]:
    """Rows of the numbers in a JSON content, named by their path of keys; `x_std` is shown as the error of `x`."""
    rows: list[Row] = []
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    named = dict(items)
    for key, value in named.items():
        name = f"{prefix} {key}".strip().replace("_", " ")
        if isinstance(value, (dict, list)):
            rows += _nested_rows(value, name)
        elif isinstance(value, (int, float)) and not isinstance(value, bool) and not str(key).endswith("_std"):
            deviation = named.get(f"{key}_std")
            rows.append(Row(name, f"{value:.4g}", f"{deviation:.2g}" if isinstance(deviation, float) else ""))
    return rows[:200]


def _details(folder: Path) -> list[tuple[str, str]]:
    titles = {"config.yaml": "Files and options", "versions.json": "Versions", "metrics.json": "All metrics"}
    return [
        (title, (folder / name).read_text(encoding="utf-8", errors="replace"))
        for name, title in titles.items()
        if (folder / name).is_file()
    ]


def _clouds(folder: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Points (N, 3), their displacements (N, 3) and expected errors (N,) of all implants of a run."""
    tables = [read_point_cloud_ply(path) for path in sorted(folder.glob("*implant_deformed.ply"))]
    if not tables:
        raise ValueError(f"folder {folder} holds no implant_deformed.ply")
    points, moved, std = [], [], []
    for table in tables:
        none = torch.zeros_like(table["x"])
        points.append(torch.stack([table[name] for name in "xyz"], dim=-1))
        moved.append(torch.stack([table.get(f"d{name}", none) for name in "xyz"], dim=-1))
        std.append(table.get("std", none))
    return torch.cat(points), torch.cat(moved), torch.cat(std)


def layers_of(folder: Path) -> list[tuple[str, bytes, bytes]]:
    """Label, measured view and overlay of each view; images as PNG."""
    held = read_layers(folder / LAYERS)
    if held is None:
        return []
    return [
        (str(label), png_of(grey), png_of(overlay))
        for label, grey, overlay in zip(held["labels"], held["grey"], held["overlay"], strict=False)
    ]


def _views(folder: Path) -> ConeBeamGeometry | None:
    """Geometry of the registered views; None if its file is gone or unreadable."""
    files = read_config(folder / "config.yaml").get("files") if (folder / "config.yaml").is_file() else None
    if not isinstance(files, dict) or not files.get("geometry"):
        return None
    try:
        geometry = read_geometry(files["geometry"], projections=files.get("projections"))
        return geometry if files.get("views") is None else geometry.select([int(view) for view in files["views"]])
    except (OSError, ValueError):
        return None  # moved or changed since; the page omits it


def implant_scene(
    points: Tensor, moved: Tensor, std: Tensor, *, views: ConeBeamGeometry | None = None
) -> dict[str, Any]:
    """Content of the page's 3D view: a sample of the points, their displacements, focal spots and detectors.

    Args:
        points: Registered points (N, 3), world mm.
        moved: Displacements (N, 3) from the undeformed shape, mm.
        std: Expected errors (N,), mm.
        views: Geometry whose focal spots and detectors are drawn; none if None.
    """
    chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:MOST_POINTS]
    volume = float((points.amax(0) - points.amin(0)).clamp_min(0.1).prod())
    scene: dict[str, Any] = {
        "points": _rounded(points[chosen].flatten()),
        "moved": _rounded(moved[chosen].flatten()),
        "displacement": _rounded(moved[chosen].norm(dim=-1)),
        "std": _rounded(std[chosen]),
        "yaw": _yaw(points),
        "pitch": round(1.2 * (volume / len(chosen)) ** (1 / 3), 3),
        "sources": [],
        "detectors": [],
    }
    if views is not None:
        frames, (rows, cols) = DetectorFrames.of(views), views.det_shape
        across, down = frames.col_steps * cols / 2, frames.row_steps * rows / 2
        corners = [frames.centers + a * across + b * down for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        scene["sources"] = [_rounded(source) for source in frames.sources]
        scene["detectors"] = [[_rounded(corner[view]) for corner in corners] for view in range(views.num_views)]
    return scene


def _yaw(points: Tensor) -> float:
    """Angle about z, radians, from which the implant is seen nearly face on: half a radian off its thinnest axis."""
    _, axes = principal_axes(points.double())
    return round(math.atan2(float(axes[0][0]), float(axes[0][1])) + 0.5, 3)


def _rounded(values: Tensor) -> list[float]:
    return [round(float(x), 3) for x in values.tolist()]
