"""The script that writes figures of `benchmarks/results` into the pages."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parent.parent / "scripts" / "results.py"
filled = runpy.run_path(str(SCRIPT))["filled"]


def test_a_stale_value_and_a_stale_table_are_replaced():
    page = "off by <!-- value demo.csv: bead error (mm); registration=start -->9<!-- /value --> mm"
    assert filled(page).count("-->2.26<!--") == 1
    table = "<!-- table demo.csv: registration | bead error (mm); registration=start -->\nold\n<!-- /table -->"
    assert "| start | 2.26 |" in filled(table) and "old" not in filled(table)


def test_statistics_of_a_column_have_a_format():
    page = "<!-- value population-neighbours-known.csv: count seed d -->0<!-- /value -->"
    assert int(filled(page).split("-->")[1].split("<")[0]) > 0


@pytest.mark.parametrize(
    ("request_", "message"),
    [("seconds; registration=nobody", "0 rows"), ("hours; registration=start", "no 'hours'"), ("x; y=1", "no column")],
)
def test_a_figure_that_no_file_has_is_an_error(request_, message):
    with pytest.raises(ValueError, match=message):
        filled(f"<!-- value demo.csv: {request_} --><!-- /value -->")
