"""However a command fails: one line, exit status 2, and a traceback for those who ask."""

from __future__ import annotations

import json
import logging
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import torchkcreg.commands  # noqa: F401  (its modules are patched)
from torchkcreg import cli
from torchkcreg.console import Answer, Voice, run_command
from torchkcreg.progress import progress_bar


def broken(kind: str) -> None:
    if kind == "memory":
        raise MemoryError
    if kind == "allocator":
        raise RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: not enough memory: you tried ...")
    if kind == "singular":
        torch.linalg.inv(torch.zeros(2, 2))
    raise {"value": ValueError("two\nlines"), "missing": FileNotFoundError("x does not exist"), "key": KeyError("a")}[
        kind
    ]


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("memory", "error: out of memory (--debug shows the traceback)"),
        ("allocator", "error: out of memory"),
        ("singular", "LinAlgError: linalg.inv"),
        ("value", "error: two lines"),
        ("missing", "error: x does not exist"),
        ("key", "KeyError: 'a' (--debug shows the traceback)"),
    ],
)
def test_every_failure_is_one_line(capsys, kind, message):
    assert run_command("torchkcreg x", lambda: broken(kind)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("torchkcreg x: error: ")
    assert message in line


def test_a_failure_that_nothing_foresaw_names_its_step(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules["torchkcreg.commands.info"], "read_mesh", lambda path: [][0])
    (tmp_path / "a.stl").write_bytes(b"")
    assert cli.main(["info", str(tmp_path / "a.stl")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "IndexError: list index out of range in commands.info (--debug" in line
    with pytest.raises(IndexError):
        cli.main(["info", str(tmp_path / "a.stl"), "--debug"])


def test_debug_raises_and_warnings_are_lines(capsys):
    with pytest.raises(KeyError):
        run_command("x", lambda: broken("key"), Voice(debug=True))

    def warns() -> Answer:
        warnings.warn("careful,\nit is hot", stacklevel=1)
        return Answer("", status=3)

    assert run_command("x", warns) == 3
    assert capsys.readouterr().err == "x: warning: careful, it is hot\n"


def test_what_was_found_is_said_as_was_asked(capsys):
    def found() -> Answer:
        print("on the way")
        logging.getLogger("torchkcreg.some.step").info("step %d", 1)
        warnings.warn("it is hot", stacklevel=1)
        return Answer("two views", {"views": 2, "folder": Path("run"), "gc": float("nan")})

    assert run_command("x", found) == 0
    told = capsys.readouterr()
    assert told.out == "on the way\ntwo views\n" and told.err == "x: warning: it is hot\n"
    run_command("x", found, Voice(quiet=True))
    told = capsys.readouterr()
    assert told.out == "" and told.err == "x: warning: it is hot\n"
    run_command("x", found, Voice(json=True))
    told = capsys.readouterr()
    assert json.loads(told.out) == {"views": 2, "folder": "run", "gc": None, "warnings": ["it is hot"]}
    assert "on the way" in told.err
    run_command("x", found, Voice(verbose=True))
    assert re.search(r"x: +0\.\d s  step 1\n", capsys.readouterr().err)
    run_command("x", found)
    assert "step 1" not in capsys.readouterr().err


def test_quiet_silences_bars_and_only_for_as_long_as_the_command_runs(capsys):
    list(progress_bar(range(3), shown=True))
    assert "3/3" in capsys.readouterr().err
    run_command("x", lambda: Answer(str(list(progress_bar(range(3), shown=True)))), Voice(quiet=True))
    assert capsys.readouterr().err == ""
    list(progress_bar(range(3), shown=True))
    assert "3/3" in capsys.readouterr().err


def test_the_shell_is_told_commands_and_flags(capsys):
    assert cli.main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert "--soft-tissue" in script and "reconstruct" in script


def test_info_takes_the_open_beam_that_a_file_lacks(capsys, tmp_path):
    np.savez(tmp_path / "p.npz", intensity=np.full((2, 4, 4), 500.0) + np.arange(2)[:, None, None])
    assert cli.main(["info", str(tmp_path / "p.npz")]) == 2
    assert "no open_beam" in capsys.readouterr().err
    assert cli.main(["info", str(tmp_path / "p.npz"), "--open-beam=1000"]) == 0
    assert "2 views of 4 x 4 pixels, line integrals 0.691 to 0.693" in capsys.readouterr().out


def test_a_notebooks_backend_of_matplotlib_does_no_harm():
    draw = "from matplotlib.figure import Figure; Figure().savefig('/dev/null', format='png')"
    code = f"import torchkcreg.visualization; {draw}"
    environment = {"MPLBACKEND": "module://no_such_backend", "PATH": ""}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
