"""Many runs that are kept: order, resuming, failures, tables that are broken off, joblib and Dask."""

from __future__ import annotations

import json
import math

import pytest

from torchkcreg.studies import sweep


def square(job):
    """Of a number; -1 is none."""
    if job["x"] == -1:
        raise ValueError("no square of -1 here")
    return {"square": job["x"] ** 2, "nothing": math.nan}


def never(job):
    raise AssertionError(f"{job} was run again")


def jobs(*numbers):
    return [{"x": number} for number in numbers]


def test_rows_come_in_the_order_of_jobs_and_are_kept(tmp_path):
    table, heard = tmp_path / "deep" / "table.jsonl", []
    rows = sweep(square, jobs(3, 1, 3, 2), table, workers=1, on_row=heard.append)
    assert [row["square"] for row in rows] == [9, 1, 9, 4] and len(heard) == 3  # two alike are one
    assert rows[0]["nothing"] is None  # as JSON has it, whether it was just made or read
    assert sweep(never, jobs(2, 3), table, workers=1) == [rows[3], rows[0]]
    assert [json.loads(line)["job"]["x"] for line in table.read_text().splitlines()] == [3, 1, 2]


def test_a_job_that_fails_says_so_and_is_tried_again(tmp_path):
    table = tmp_path / "table.jsonl"
    failed, whole = sweep(square, jobs(-1, 2), table, workers=1)
    assert failed == {"error": "ValueError: no square of -1 here"} and whole["square"] == 4
    assert sweep(lambda job: {"square": 1}, jobs(-1, 2), table, workers=1) == [{"square": 1}, whole]


def test_a_line_that_was_broken_off_is_made_again_and_another_is_refused(tmp_path):
    table = tmp_path / "table.jsonl"
    rows = sweep(square, jobs(1, 2), table, workers=1)
    whole = table.read_text()
    table.write_text(whole[:-20])
    with pytest.raises(AssertionError, match="'x': 2"):
        sweep(never, jobs(1, 2), table, workers=1)
    assert sweep(square, jobs(1, 2), table, workers=1) == rows and table.read_text() == whole
    table.write_text("[1]\n" + whole)
    with pytest.raises(ValueError, match="line 1 is no job with its row"):
        sweep(square, jobs(1, 2), table, workers=1)


def test_rows_of_another_version_are_told(tmp_path):
    table = tmp_path / "table.jsonl"
    sweep(square, jobs(1), table, workers=1)
    table.write_text(table.read_text().replace('"version": "', '"version": "0.0.1+'))
    with pytest.warns(UserWarning, match=r"rows that torchkcreg 0\.0\.1\+\S+ made"):
        sweep(never, jobs(1), table, workers=1)


def test_several_processes_give_the_same_rows(tmp_path):
    pytest.importorskip("joblib")
    numbers = range(6)
    alone = sweep(square, jobs(*numbers), tmp_path / "alone.jsonl", workers=1)
    assert sweep(square, jobs(*numbers), tmp_path / "two.jsonl", workers=2) == alone


def test_a_dask_cluster_gives_the_same_rows(tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        rows = sweep(square, jobs(4, -1), tmp_path / "table.jsonl", cluster=cluster.scheduler_address)
    assert [row.get("square", "failed") for row in rows] == [16, "failed"]


def test_a_cluster_that_is_not_there_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("torchkcreg.studies.sweeps._SECONDS", 0.3)
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        sweep(square, jobs(1), tmp_path / "table.jsonl", cluster="tcp://127.0.0.1:9")


@pytest.mark.parametrize(("package", "how"), [("joblib", {"workers": 2}), ("distributed", {"cluster": "tcp://x:1"})])
def test_what_is_not_installed_is_named(package, how, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(ValueError, match=rf"needs {package}: pip install 'torchkcreg\[studies\]'"):
        sweep(square, jobs(1), tmp_path / "table.jsonl", **how)
