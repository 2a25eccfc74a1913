"""Follow a fracture over visits: motion per newton, load on the implant, stiffness and mineral of the gap over time."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchkcreg.io import REPORT, read_json, write_figure, write_json, write_text
from torchkcreg.plain import plain
from torchkcreg.visualization import Page, Row, healing_figure, page_html

from .report import picture_of
from .visit_page import ASSESSMENT

HEALING, TABLE = "follow.png", "follow.csv"
Number = tuple[float, float] | None  # value and standard deviation


@dataclass(frozen=True)
class Measure:
    """A quantity that is followed.

    Attributes:
        key: Its name in tables, with the unit.
        title: Its name for people.
        unit: Its unit.
        of: Reads it from the content of an `assess.json`; None where it was not measured.
    """

    key: str
    title: str
    unit: str
    of: Callable[[dict[str, Any]], Number]


def _per_kilonewton(value: str, std: str, *, at: str | None = None, sign: float = 1.0, each: float = 1000.0):
    """Reader of the slope of a number over the load, through the origin, weighted by its standard deviations."""

    def slope(content: dict[str, Any]) -> Number:
        above = below = 0.0
        for c in content["configurations"]:
            numbers = c if at is None else c.get("places", {}).get(at, {})
            if value not in numbers or "load_n" not in c:
                continue
            weight = 1 / max(numbers[std], 1e-9) ** 2
            above += weight * c["load_n"] * sign * numbers[value]
            below += weight * c["load_n"] ** 2
        return (each * above / below, each / math.sqrt(below)) if below > 0 else None

    return slope


def _callus(key: str) -> Callable[[dict[str, Any]], Number]:
    name, unit = key.split("_", 1)

    def read(content: dict[str, Any]) -> Number:
        callus = content.get("callus")
        return None if callus is None else (callus[key], callus[f"{name}_std_{unit}"])

    return read


def _mineral(content: dict[str, Any]) -> Number:
    for region in content.get("mineral", []):
        if region["region"] == "gap":
            return region["hydroxyapatite_mg_ml"], float("nan")
    return None


MEASURES = (
    Measure(
        "tilt_deg_per_kn", "tilt of the upper fragment", "°/kN", _per_kilonewton("rotation_deg", "rotation_std_deg")
    ),
    Measure(
        "closing_mm_per_kn",
        "closing of the gap at the bone's axis",
        "mm/kN",
        _per_kilonewton("axial_mm", "axial_std_mm", at="bone axis", sign=-1.0),
    ),
    Measure(
        "moment_nm_per_kn",
        "moment through the implant",
        "N m/kN",
        _per_kilonewton("moment_nmm", "moment_std_nmm", each=1.0),
    ),
    Measure("callus_n_per_mm", "stiffness of the tissue in the gap", "N/mm", _callus("axial_n_per_mm")),
    Measure("gap_mineral_mg_ml", "hydroxyapatite in the gap", "mg/mL", _mineral),
)


@dataclass(frozen=True)
class Healing:
    """A fracture over its visits.

    Attributes:
        visits: Names of the visits' folders, in the order of time.
        days: Days since the first visit; 0, 1, 2, ... if no dates are known.
        dated: True if they are days, not numbers of visits.
        series: Each measure's value and standard deviation at each visit, by its key; None where it was not measured.
        warnings: What to doubt, a line each.
        folder: Output folder.
    """

    visits: tuple[str, ...]
    days: tuple[float, ...]
    dated: bool
    series: dict[str, tuple[Number, ...]]
    warnings: tuple[str, ...]
    folder: Path

    def to_dict(self) -> dict[str, Any]:
        """Content of `follow.json`; null where something was not measured."""
        series = {
            key: [None if n is None else {"value": n[0], "std": n[1] if math.isfinite(n[1]) else None} for n in numbers]
            for key, numbers in self.series.items()
        }
        time = {"days": list(self.days)} if self.dated else {}
        return {"visits": list(self.visits), **time, "series": series, "warnings": list(self.warnings)}

    def table(self) -> str:
        """CSV table with a row for each visit; empty where something was not measured."""
        heads = ["visit", "day", *(name for key in self.series for name in (key, f"{key}_std"))]
        lines = [",".join(heads)]
        for number, (visit, day) in enumerate(zip(self.visits, self.days, strict=True)):
            cells = [cell for numbers in self.series.values() for cell in _cells(numbers[number])]
            lines.append(",".join([visit, f"{day:g}" if self.dated else "", *cells]))
        return "\n".join(lines) + "\n"

    def __str__(self) -> str:
        lines = []
        for measure in MEASURES:
            numbers = self.series[measure.key]
            if any(n is not None for n in numbers):
                lines.append(f"{measure.title} ({measure.unit}): {', '.join(map(_text, numbers))}")
        return "\n".join([*lines, *(f"doubt: {text}" for text in self.warnings), f"folder {self.folder}"])


def _cells(number: Number) -> list[str]:
    return ["", ""] if number is None else [f"{number[0]:.5g}", f"{number[1]:.3g}" if math.isfinite(number[1]) else ""]


def _text(number: Number) -> str:
    if number is None:
        return "-"
    return f"{number[0]:.3g} +- {number[1]:.2g}" if math.isfinite(number[1]) else f"{number[0]:.3g}"


def follow(visits: Sequence[Path], out: Path, *, dates: Sequence[datetime.date] = (), figures: bool = True) -> Healing:
    """Collect the assessments of a fracture's visits over time; write `follow.json`, a table, a figure and a page.

    Args:
        visits: Folders of `torchkcreg assess`, in the order of time.
        out: Output folder, created if missing.
        dates: Date of each visit; if empty, visits are only numbered.
        figures: Draw the figure and write the page.

    Raises:
        ValueError: If there are other numbers of dates than visits, dates do not rise, or a visit has no known loads.
        FileNotFoundError: If a folder has no assessment.
    """
    if dates and len(dates) != len(visits):
        raise ValueError(f"{len(visits)} visits need as many dates, got {len(dates)}")
    days = [float((date - dates[0]).days) for date in dates] or [float(n) for n in range(len(visits))]
    if sorted(set(days)) != days:
        raise ValueError("visits must be named in the order of time, one a day")
    contents = []
    for visit in visits:
        content = read_json(visit / ASSESSMENT, "assessment")
        if not isinstance(content, dict) or not isinstance(content.get("configurations"), list):
            raise ValueError(f"{visit / ASSESSMENT} is no assessment")
        if not any("load_n" in c and "rotation_deg" in c for c in content["configurations"]):
            raise ValueError(f"visit {visit} has no motion under a known load: assess it with --loads")
        contents.append(content)
    names = tuple(visit.resolve().name for visit in visits)
    series = {measure.key: tuple(measure.of(content) for content in contents) for measure in MEASURES}
    doubts = tuple(
        f"{name}: {c['name']} is {c['status']}"
        for name, content in zip(names, contents, strict=True)
        for c in content["configurations"]
        if c["status"] != "ok"
    )
    healing = Healing(names, tuple(days), bool(dates), series, doubts, out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "follow.json", plain(healing.to_dict()))
    write_text(out / TABLE, healing.table())
    if figures:
        curves = {f"{m.title} ({m.unit})": series[m.key] for m in MEASURES if any(n is not None for n in series[m.key])}
        write_figure(out / HEALING, healing_figure(days, curves, xlabel="days" if dates else "visit"))
        rows = [
            Row(
                f"{name}: {m.title}",
                f"{number[0]:.3g} {m.unit}",
                f"{number[1]:.2g}" if math.isfinite(number[1]) else "",
            )
            for m in MEASURES
            for name, number in zip(names, series[m.key], strict=True)
            if number is not None
        ]
        first, last = (next(iter(s), None) for s in (series["tilt_deg_per_kn"], series["tilt_deg_per_kn"][::-1]))
        answer = [_answer(first, last, len(names))] if first and last else []
        pictures = [picture_of(out / HEALING, "The fracture over its visits, with one standard deviation")]
        page = Page("A fracture over its visits", answer=answer, warnings=doubts, rows=rows, pictures=pictures)
        write_text(out / REPORT, page_html(page))
    return healing


def _answer(first: tuple[float, float], last: tuple[float, float], number: int) -> str:
    change, std = last[0] - first[0], math.hypot(first[1], last[1])
    if number < 2:
        return f"Under 1 kN the upper fragment tilts by {first[0]:.2f} ± {first[1]:.2f}°."
    trend = "no less and no more" if abs(change) < 2 * std else "less" if change < 0 else "more"
    return (
        f"The upper fragment tilts {trend} than at the first visit: {last[0]:.2f} ± {last[1]:.2f}° per kN, "
        f"{first[0]:.2f} ± {first[1]:.2f}° then."
    )
