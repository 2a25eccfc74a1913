"""The page of a visit: the answer in sentences, tiles, the fracture's motion in 3D, views, loads and what to doubt."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch

from torchkcreg.geometry import invert_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import REPORT, mesh_of_run, read_json, read_mesh, read_run, write_text
from torchkcreg.visualization import Page, Row, page_html

from .assessment import TURN_KEYS
from .report import implant_scene, layers_of, picture_of

ASSESSMENT = "assess.json"
_PITCH_MM = 1.5
_FIGURES = {
    "volumes/fdk/slices.png": "The unloaded scan by FDK",
    "volumes/kcrec/slices.png": "The unloaded scan by KC-Rec",
    "volumes/densitometry/densitometry.png": "Bone mineral, and its regions",
    "motion.png": "Deflection of the implant relative to the lower fragment",
    "load/load.png": "Moments along the implant, and the stress on its surface",
}


def write_visit_page(folder: Path, *, out: Path | None = None) -> Path:
    """Write the page of a folder of `torchkcreg assess`, by default its `report.html`, and return its path.

    Raises:
        FileNotFoundError: If the folder has no `assess.json`.
        ValueError: If that file is damaged.
    """
    content = read_json(folder / ASSESSMENT, "assessment")
    try:
        measured = [c for c in content["configurations"] if "rotation_deg" in c]
        statuses = [c["status"] for c in content["configurations"]]
        worst = next((status for status in ("failed", "doubtful") if status in statuses), "ok")
        page = Page(
            f"Motion of a fracture: {folder.resolve().name}",
            verdict=worst,
            answer=[sentence.replace("+-", "±") for sentence in content["answer"]],
            tiles=_tiles(measured[-1]) if measured else (),
            summary="" if worst == "ok" else "Look at these before trusting the numbers.",
            warnings=[
                *(f"{c['name']}: {reason}" for c in content["configurations"] for reason in c["reasons"]),
                *content["warnings"],
            ],
            rows=[
                *(row for c in measured for row in _rows(c)),
                *_callus_rows(content),
                *map(_mineral_row, content.get("mineral", [])),
            ],
            scene=_scene(folder, content["unloaded"], measured[-1]) if measured else None,
            layers=[
                (f"{c['name']}, {label}", grey, overlay)
                for c in measured
                for label, grey, overlay in layers_of(folder / c["name"])
            ],
            pictures=_pictures(folder, [c["name"] for c in measured]),
            details=[
                ("What was assumed", "\n".join(content["assumed"])),
                ("Commands that repeat each step", "\n".join(content["commands"])),
            ],
        )
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{folder / ASSESSMENT} is damaged: {error!r}") from None
    target = out or folder / REPORT
    write_text(target, page_html(page))
    return target


def _pm(value: float, std: float | None, unit: str, form: str = "{:.2f}") -> str:
    deviation = "" if std is None else f" ± {form.format(std)}"
    return f"{form.format(value)}{deviation}\N{NO-BREAK SPACE}{unit.replace(' ', chr(0xA0))}"


def _tiles(last: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The most important numbers of a configuration: tilt, gap, moment and stress."""
    under = f"under {last['load_n']:g} N" if "load_n" in last else f"in {last['name']}"
    turns = [f"{name.replace('_', ' ')} {last[f'{name}_deg']:.2f}" for name in TURN_KEYS]
    tiles = [("tilt of the upper fragment", _pm(last["rotation_deg"], last["rotation_std_deg"], "°"), ", ".join(turns))]
    place = "bone axis" if "bone axis" in last["places"] else next(iter(last["places"]))
    there = last["places"][place]
    tiles.append(
        (
            f"gap at the {place}" if place == "bone axis" else f"motion at the {place}",
            _pm(there["axial_mm"], there["axial_std_mm"], "mm"),
            f"along the implant, {under}: negative closes; shear {there['shear_mm']:.2f} mm",
        )
    )
    if "moment_nmm" in last:
        moment, std = last["moment_nmm"] / 1000, last["moment_std_nmm"] / 1000
        tiles.append(("moment through the implant", _pm(moment, std, "N m"), "across the gap"))
    if "share_of_yield" in last:
        share, std = 100 * last["share_of_yield"], 100 * last["share_of_yield_std"]
        about = f"largest stress {last['stress_mpa']:.0f} MPa"
        tiles.append(("stress over yield", _pm(share, std, "%", "{:.0f}"), about))
    return tiles


def _rows(c: dict[str, Any]) -> list[Row]:
    rows = [Row(f"{c['name']}: tilt", f"{c['rotation_deg']:.3f}°", f"{c['rotation_std_deg']:.3f}°")]
    rows += [
        Row(name.replace("_", " "), f"{c[f'{name}_deg']:.3f}°", f"{c[f'{name}_std_deg']:.3f}°") for name in TURN_KEYS
    ]
    for name, there in c["places"].items():
        about = f"axial {there['axial_mm']:.3f}, shear {there['shear_mm']:.3f} mm"
        value, std = f"{there['translation_mm']:.3f} mm", f"{there['translation_std_mm']:.3f} mm"
        rows.append(Row(f"translation at the {name}", value, std, about))
    for name in TURN_KEYS:
        if f"{name}_moment_nmm" in c:
            moment, std = (c[f"{name}_moment_{part}nmm"] / 1000 for part in ("", "std_"))
            rows.append(Row(f"moment of {name.replace('_', ' ')}", f"{moment:.2f} N m", f"{std:.2f} N m"))
    return rows


def _callus_rows(content: dict[str, Any]) -> list[Row]:
    callus = content.get("callus")
    if callus is None:
        return []
    about = "if the force acts along the bone's axis, and the tissue is an elastic column as wide as the bone"
    axial, axial_std = callus["axial_n_per_mm"], callus["axial_std_n_per_mm"]
    bending, bending_std = callus["bending_nm_per_deg"], callus["bending_std_nm_per_deg"]
    share, share_std = (100 * callus[name][-1] for name in ("shares_of_load", "shares_of_load_std"))
    return [
        Row("stiffness of the tissue in the gap, axial", f"{axial:.0f} N/mm", f"{axial_std:.0f} N/mm", about),
        Row("its bending stiffness", f"{bending:.3f} N m/°", f"{bending_std:.3f} N m/°"),
        Row("its share of the largest load", f"{share:.0f} %", f"{share_std:.0f} %"),
    ]


def _mineral_row(m: dict[str, Any]) -> Row:
    about = f"hydroxyapatite in {m['volume_ml']:.2f} mL; {100 * m['left_out']:.0f} % of the region left out"
    return Row(f"bone mineral: {m['region']}", f"{m['hydroxyapatite_mg_ml']:.0f} mg/mL", about=about)


def _scene(folder: Path, unloaded: str, last: dict[str, Any]) -> dict[str, Any] | None:
    """The implant and its screws under load, relative to the lower fragment; the unloaded implant as a ghost."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first, second = (read_run(folder / name).implants[0] for name in (unloaded, last["name"]))
    try:
        mesh = read_mesh(mesh_of_run(folder / unloaded))
    except FileNotFoundError:
        return None
    back = invert_rigid(torch.tensor(last["motion"]["lower_motion"], dtype=torch.float64))
    nodes = ImplantPointCloud.from_mesh(mesh, _PITCH_MM, dtype=torch.float64).points
    before, after = first.warp(nodes), transform_points(back, second.warp(nodes))
    std = torch.zeros(len(nodes)) if second.deviations is None else second.deviations.of_nearest(nodes)
    scene = implant_scene(after, after - before, std)
    if first.screws:
        ends = torch.tensor([end for screw in first.screws for end in (screw.start, screw.end)], dtype=torch.float64)
        old, new = (
            torch.cat(
                [transform_points(i.motion_of(s, nodes), ends[2 * n : 2 * n + 2]) for n, s in enumerate(i.screws)]
            )
            for i in (first, second)
        )
        new = transform_points(back, new)
        scene["lines"] = [round(float(x), 3) for x in new.flatten()]
        scene["linesMoved"] = [round(float(x), 3) for x in (new - old).flatten()]
    return {**scene, "ghost": True}


def _pictures(folder: Path, names: list[str]) -> list[tuple[str, bytes]]:
    pictures = []
    for name, title in _FIGURES.items():
        paths = {"": folder / name} if name[:4] != "load" else {f": {c}": folder / c / name for c in names}
        for where, path in paths.items():
            if path.is_file():
                pictures.append(picture_of(path, f"{title}{where}"))
    return pictures
