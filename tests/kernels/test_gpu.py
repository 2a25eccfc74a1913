"""Triton's kernels: each is its reference, interpreted on the CPU and on a GPU where there is one, and compiles."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not installed")
HERE = Path(__file__).parent


def run(script: str, *arguments: str) -> str:
    """What a script in a process of its own prints; Triton reads its environment when it is imported."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    command = [sys.executable, str(HERE / script), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def test_every_kernel_is_its_reference_under_the_interpreter() -> None:
    assert run("interpreted.py", "cpu").endswith("all kernels are their references\n")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no such device here: a GPU")
def test_every_kernel_is_its_reference_on_a_gpu() -> None:
    assert run("interpreted.py", "cuda").endswith("all kernels are their references\n")


def test_every_kernel_compiles_for_a_gpu_that_is_not_there() -> None:
    assert run("compiled.py").endswith("all kernels compile\n")
