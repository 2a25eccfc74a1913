"""Reports of the studies: summaries of their rows in words, tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchkcreg.console import markdown_table
from torchkcreg.io import write_figure
from torchkcreg.io.tables import write_rows
from torchkcreg.visualization.studies import (
    coverage_figure,
    errors_figure,
    geometry_figure,
    loads_figure,
    planned_figure,
    verdict_figure,
)

from .simulated import MOMENTS, WIDTHS
from .sweeps import Row

WRONG_MM, RIGHT_MM = 0.15, 0.10
_SETS = {"neighbours": "three views a degree apart", "around": "six views around the limb"}
_WAYS = {"off": "views fixed", "auto": "views may move"}


def of_population(rows: Sequence[Row], folder: Path) -> str:
    """Report errors, verdicts, coverage of the error bars and, if the loads are known, errors of the moments."""
    whole = [row for row in rows if "error" not in row]
    write_rows(folder / "population.csv", rows)
    lines = [errors_in_words(rows)]
    if whole and all(row["worst"] is not None for row in whole):
        write_figure(folder / "errors.png", errors_figure(whole, right_mm=RIGHT_MM), dpi=110)
        write_figure(folder / "verdict.png", verdict_figure(whole, wrong_mm=WRONG_MM, right_mm=RIGHT_MM), dpi=110)
    if covered := [row for row in whole if row.get("coverage")]:
        lines.append(of_coverage(covered, folder))
    if loads := [row for row in whole if "gap_true" in row]:
        lines += [loads_in_words(loads, place) for place in ("gap", "largest")]
    return "\n".join(lines)


def errors_in_words(rows: Sequence[Row]) -> str:
    """Main figures in one line. A registration that raised an error counts as a large error with a warning."""
    # an infinite error is None in JSON
    worst = np.array([np.inf if row.get("worst") is None else row["worst"] for row in rows])
    nodes = np.array([row.get("nodes", np.inf) for row in rows])
    flagged = np.array(["error" in row or row["status"] != "ok" or bool(row["warnings"]) for row in rows])
    seeds = np.array([row.get("seed", -1) for row in rows])
    silent, false_alarms = seeds[~flagged & (worst > WRONG_MM)].tolist(), seeds[flagged & (worst < RIGHT_MM)].tolist()
    seconds = np.median([row.get("seconds", np.nan) for row in rows])
    return (
        f"{len(rows)} cases: node RMSE median {np.median(nodes):.3f}, worst figure median {np.median(worst):.3f}, "
        f"90th percentile {np.percentile(worst, 90):.3f} mm; {int((worst < RIGHT_MM).sum())} below {RIGHT_MM} mm; "
        f"silent failures {len(silent)} {silent}; false alarms {len(false_alarms)} {false_alarms}; {seconds:.0f} s"
    )


def of_coverage(rows: Sequence[Row], folder: Path) -> str:
    """Report the share of true positions within 68 % and 95 % intervals, averaged over cases, by set of views."""
    sets = {}
    for views in dict.fromkeys(row.get("views", "neighbours") for row in rows):
        shares = [row["coverage"] for row in rows if row.get("views", "neighbours") == views]
        sets[views] = (len(shares), {name: np.mean([share[name] for share in shares], axis=0) for name in shares[0]})
    curves = {f"{_SETS.get(views, views)} ({n} cases)": parts for views, (n, parts) in sets.items()}
    write_figure(folder / "coverage.png", coverage_figure(WIDTHS, curves), dpi=110)
    header = ["true positions within 68 %, 95 % intervals", *next(iter(sets.values()))[1]]
    table = [
        [title, *(f"{c[WIDTHS.index(1.0)]:.0%}, {c[WIDTHS.index(1.96)]:.0%}" for c in parts.values())]
        for title, parts in curves.items()
    ]
    return markdown_table(header, table)


def loads_in_words(rows: Sequence[Row], place: str) -> str:
    """Errors of the bending moments at a place, and how often the true moment is within its interval."""
    true, estimated, std = (np.array([row[f"{place}_{name}"] for row in rows], dtype=float) for name in MOMENTS)
    error = np.abs(estimated - true)
    within = error <= np.maximum(0.05 * np.abs(true), 50.0)
    return (
        f"bending moments, {place}, of {len(rows)}: error median {np.median(error):.0f} N mm, "
        f"{np.median(error / np.abs(true)):.1%} of them; "
        f"{within.sum()} within 5 % or 50 N mm; {np.mean(error <= std):.0%} within one standard deviation, "
        f"{np.mean(error <= 2 * std):.0%} within two"
    )


def of_geometry(rows: Sequence[Row], folder: Path) -> str:
    """Report errors caused by a wrong geometry, with views fixed and with views that may move."""
    write_rows(folder / "geometry.csv", rows)
    rows = [row for row in rows if "error" not in row]
    names = list(dict.fromkeys(row["geometry"] for row in rows))
    by_error = {
        name: {way: [r for r in rows if (r["geometry"], r["view_motion"]) == (name, way)] for way in _WAYS}
        for name in names
    }
    errors = {
        title: {
            name: {way: [r[key] for r in selected] for way, selected in ways.items()} for name, ways in by_error.items()
        }
        for key, title in (("nodes", "where the nodes are"), ("shape", "how the implant is bent"))
    }
    write_figure(folder / "geometry.png", geometry_figure(errors, _WAYS), dpi=110)
    header = ["geometry off", "cases", *(f"{words}: nodes, shape (median, mm)" for words in _WAYS.values()), "moved"]
    table = []
    for name, selected in by_error.items():
        cells = [
            f"{np.median([r['nodes'] for r in group]):.3f}, {np.median([r['shape'] for r in group]):.3f}"
            for group in selected.values()
        ]
        moved = sum(bool(r["views_moved"]) for r in selected["auto"])
        table.append([name, str(len(selected["off"])), *cells, f"{moved} of {len(selected['auto'])}"])
    return markdown_table(header, table)


def of_loads(rows: Sequence[Row], folder: Path) -> str:
    """Report median errors for each load, set of views and number of quanta."""
    write_rows(folder / "loads.csv", rows)
    rows = [row for row in rows if "error" not in row]
    kinds = sorted({(int(row["views"]), row["photons"]) for row in rows})
    loads = sorted({row["load_n"] for row in rows})
    curves = {
        f"{views} views, {photons:.0f} photons": [
            [r["nodes"] for r in rows if (int(r["views"]), r["photons"], r["load_n"]) == (views, photons, load)]
            for load in loads
        ]
        for views, photons in kinds
    }
    write_figure(folder / "loads.png", loads_figure(loads, curves), dpi=110)
    cells = [
        [f"{load:.0f} N", *(f"{np.median(errors[n]):.3f}" if errors[n] else "-" for errors in curves.values())]
        for n, load in enumerate(loads)
    ]
    return markdown_table(["node RMSE (median, mm)", *curves], cells)


def of_views(rows: Sequence[Row], folder: Path) -> str:
    """Report how often planned sets of views beat random ones."""
    write_rows(folder / "views.csv", rows)
    rows = [row for row in rows if "error" not in row]
    planned = {row["seed"]: row["nodes"] for row in rows if row["planned"]}
    random = [row for row in rows if not row["planned"] and row["seed"] in planned]
    won = sum(planned[row["seed"]] < row["nodes"] for row in random)
    expected, actual = ([row[name] for row in rows] for name in ("expected_mm", "nodes"))
    write_figure(folder / "views.png", planned_figure(expected, actual, [row["planned"] for row in rows]), dpi=110)
    correlation = float(np.corrcoef(np.log(expected), np.log(actual))[0, 1])
    best, others = (np.median([row["nodes"] for row in rows if row["planned"] == chosen]) for chosen in (True, False))
    return (
        f"planned sets of three beat random ones in {won} of {len(random)} draws, {len(planned)} cases: nodes "
        f"{best:.3f} against {others:.3f} mm (median); "
        f"correlation of log expected and log actual error {correlation:.2f}"
    )
