"""Write the figures of `benchmarks/results` into their marked places in the README and the documentation.

A place is marked by comments that Markdown does not show:

    <!-- table point_projector.csv: step | library | seconds; step=forward -->
    <!-- /table -->
    <!-- value point_projector.csv: seconds .3f; step=forward; library=nanodrr -->1.621<!-- /value -->
    <!-- value population.csv: median nodes .2f; status=ok -->0.05<!-- /value -->

First come the columns, with bars between them. A value has one column, before it an optional statistic (median, p90,
max, min or count) and behind it an optional format. Then come
the conditions that the rows fulfil. `python scripts/results.py` rewrites all places; `--check` changes nothing and
fails where a place differs from its file.
"""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PLACE = re.compile(r"<!-- (table|value) ([\w-]+\.csv): (.*?) -->(.*?)<!-- /\1 -->", re.DOTALL)
STATISTICS = {
    "median": np.median,
    "p90": lambda numbers: np.percentile(numbers, 90),
    "max": np.max,
    "min": np.min,
    "count": len,
}


def selected(name: str, conditions: list[str]) -> list[dict[str, str]]:
    """Rows of a result file that fulfil all conditions `column=value`."""
    with (RESULTS / name).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for condition in conditions:
        column, value = (part.strip() for part in condition.split("=", 1))
        if rows and column not in rows[0]:
            raise ValueError(f"{name} has no column {column!r}: it has {', '.join(rows[0])}")
        rows = [row for row in rows if row[column] == value]
    return rows


def table(name: str, columns: str, conditions: list[str]) -> str:
    """The selected rows as a Markdown table."""
    rows = selected(name, conditions)
    names = [column.strip() for column in columns.split("|")] if columns != "all" else list(rows[0])
    lines = [names, ["---"] * len(names), *([row[column] for column in names] for row in rows)]
    return "\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def value(name: str, what: str, conditions: list[str]) -> str:
    """One number: of a single row, or a statistic of a column."""
    words = what.split()
    statistic = STATISTICS[words.pop(0)] if words[0] in STATISTICS and len(words) > 1 else None
    form = words.pop() if re.fullmatch(r"\.\d[f%]|d", words[-1]) else ""
    column = " ".join(words)
    rows = selected(name, conditions)
    if statistic is None and len(rows) != 1:
        raise ValueError(f"{name}: {len(rows)} rows with {'; '.join(conditions)}, where one is wanted")
    if not rows or column not in rows[0]:
        raise ValueError(f"{name} has no {column!r} with {'; '.join(conditions)}")
    if not form and statistic is None:
        return rows[0][column]
    numbers = np.array([float(row[column]) for row in rows if row[column] not in ("", "nan")])
    return format((statistic or (lambda all_of_one: all_of_one[0]))(numbers), form or "g")


def filled(text: str) -> str:
    """A page with the figures of the result files in its places."""

    def place(match: re.Match[str]) -> str:
        kind, name, request, _ = match.groups()
        what, *conditions = (part.strip() for part in request.split(";"))
        made = (table if kind == "table" else value)(name, what, conditions)
        return f"<!-- {kind} {name}: {request} -->{made}<!-- /{kind} -->"

    return PLACE.sub(place, text)


def main() -> int:
    """Rewrite the pages, or with `--check` say which differ; the exit status is 1 then."""
    check, stale = "--check" in sys.argv, []
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            stale.append(page.relative_to(ROOT))
            if not check:
                page.write_text(after, encoding="utf-8")
    for name in stale:
        print(f"{name}: {'differs from benchmarks/results, run make results' if check else 'updated'}")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
