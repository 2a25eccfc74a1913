"""The self-test of an installation: it passes on this one, and tells what does not work."""

from __future__ import annotations

import importlib

import torch

from torchkcreg.cli import main
from torchkcreg.commands import doctor, self_test


def test_the_installation_works(capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "all is well"
    names = ("kernels", "threads", "projector of nodes", "projector of voxels", "FDK of a ball", "registration")
    for name in names:
        assert [line for line in lines if line.startswith(f"ok   {name}")]


def test_a_projector_that_is_wrong_and_one_that_raises_are_told(monkeypatch):
    where = importlib.import_module("torchkcreg.commands.doctor")  # the package has a function of this name

    def broken(*arguments, backend="auto", **options):
        return torch.ones(3, 24, 32) * (1.01 if backend == "auto" else 1.0)

    def raising(*arguments, **options):
        raise OSError("no such\nlibrary")

    monkeypatch.setattr(where, "project_points", broken)
    monkeypatch.setattr(where, "backproject", raising)
    monkeypatch.setattr(where, "_registration", lambda: (True, "left out"))
    found = {check.name: check for check in self_test()}
    assert not found["projector of nodes"].passed and "1.0e-02 from the reference" in found["projector of nodes"].found
    assert str(found["projector of voxels"]) == "FAIL projector of voxels: OSError: no such library"
    text, healthy = doctor()
    assert not healthy and text.endswith("see FAIL above")
