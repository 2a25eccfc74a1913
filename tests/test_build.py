"""What happens without compiled kernels: each case in a copy of the package and a Python of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

import torchkcreg

SOURCE = Path(torchkcreg.__file__).parent
IGNORED = shutil.ignore_patterns("_C*", "__pycache__")
PROJECT = """
import sys, warnings
import torch
from torchkcreg.projector import project_points
P = torch.tensor([[[1000.0, 0, 8, 4000], [0, 1000, 8, 4000], [0, 0, 1, 500]]])
points = torch.tensor([[0.0, 0, 0], [0.5, 1, 2]])
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for _ in range(2):
        image = project_points(points, torch.ones(2), P, (16, 16), cell=0.25 * torch.eye(3))
for warning in caught:
    print("WARNING", warning.message)
print("SUM %.4f" % image.sum())
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the package without built kernels."""
    copy = tmp_path / "site" / "torchkcreg"
    copy.parent.mkdir()
    shutil.copytree(SOURCE, copy, ignore=IGNORED)
    return copy


def run_python(package: Path, *command: str, compiler: str | None = "/nonexistent/c++") -> subprocess.CompletedProcess:
    """Runs Python on the copy, with a cache of its own, and by default without a compiler."""
    environment = {**os.environ, "PYTHONPATH": str(package.parent)}
    environment["TORCH_EXTENSIONS_DIR"] = str(package.parent / "cache")
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    if compiler:
        environment.update(CXX=compiler, CC=compiler)
    return subprocess.run(
        [sys.executable, *command], env=environment, cwd=package.parent, capture_output=True, text=True, timeout=600
    )


def expected_sum() -> str:
    output: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(PROJECT, {"print": lambda *words: output.append(" ".join(map(str, words)))})
    return output[-1]


def test_without_kernels_or_compiler_the_reference_draws_with_one_warning(package: Path):
    result = run_python(package, "-c", PROJECT)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[-1] == expected_sum()
    warned = [line for line in lines if line.startswith("WARNING")]
    assert len(warned) == 1
    assert "slow torch reference" in warned[0]
    assert "pip install --no-build-isolation" in warned[0]


def test_a_broken_library_is_no_reason_to_fail(package: Path):
    (package / "_C.abi3.so").write_bytes(b"not a library")
    result = run_python(package, "-c", PROJECT)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == expected_sum()
    assert result.stdout.count("WARNING") == 1


def test_asking_for_missing_kernels_says_what_is_missing(package: Path):
    program = (
        "import torch, warnings; warnings.simplefilter('ignore')\n"
        "from torchkcreg.kernels import choose_backend\n"
        "try: choose_backend(torch.zeros(1), 'cpp')\n"
        "except OSError as error: print(error)"
    )
    result = run_python(package, "-c", program)
    assert 'the kernels of backend "cpp" are not available: no built library in' in result.stdout, result.stderr


def test_importing_the_package_neither_loads_nor_compiles_kernels():
    program = (
        "import sys, torch, torchkcreg.projector\n"
        "print(bool(torch.ops.loaded_libraries), 'torch.utils.cpp_extension' in sys.modules)"
    )
    result = run_python(SOURCE, "-c", program)
    assert result.stdout.split() == ["False", "False"], result.stderr


def test_installing_without_a_compiler_succeeds(package: Path):
    root = SOURCE.parent
    if not (root / "setup.py").is_file():
        pytest.skip("the package is installed without its sources")
    for name in ("setup.py", "setup.cfg", "pyproject.toml"):
        shutil.copy(root / name, package.parent / name)
    (package.parent / "README.md").touch()
    (package.parent / "LICENSE").touch()
    result = run_python(package, "setup.py", "build", "--build-lib", "built")
    assert result.returncode == 0, result.stderr
    assert "installed without its C++ kernels" in result.stderr
    assert (package.parent / "built/torchkcreg/projector/point_ops.py").is_file()
    assert (package.parent / "built/torchkcreg/csrc/cpu/point_drr.cpp").is_file()
    assert not list((package.parent / "built/torchkcreg").glob("_C*"))


@pytest.mark.slow
def test_a_source_distribution_holds_what_a_wheel_is_built_from(package: Path, tmp_path: Path):
    root = SOURCE.parent
    if not (root / "setup.py").is_file():
        pytest.skip("the package is installed without its sources")
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(root / name, package.parent / name)
    made = run_python(package, "setup.py", "--quiet", "sdist", "--dist-dir", str(tmp_path), compiler=None)
    assert made.returncode == 0, made.stderr
    (archive,) = tmp_path.glob("torchkcreg-*.tar.gz")
    shutil.unpack_archive(archive, tmp_path / "unpacked")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    shutil.rmtree(package)
    built = subprocess.run(
        [sys.executable, "setup.py", "--quiet", "build", "--build-lib", "built"],
        cwd=unpacked, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    files = {str(path.relative_to(unpacked / "built")) for path in (unpacked / "built").rglob("*") if path.is_file()}
    there = {str(Path("torchkcreg") / path.relative_to(SOURCE)) for path in SOURCE.rglob("*") if path.is_file()}
    missing = {name for name in there - files if "__pycache__" not in name and "_C" not in name}
    assert missing == set()


@pytest.mark.slow
def test_kernels_are_compiled_at_first_use_where_there_is_a_compiler(package: Path):
    if shutil.which("c++") is None:
        pytest.skip("no compiler")
    result = run_python(package, "-c", PROJECT, compiler=None)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == expected_sum()
    assert "WARNING" not in result.stdout
    assert list((package.parent / "cache").rglob("torchkcreg_kernels.so"))


def test_torch_is_new_enough_for_the_stable_interface():
    assert tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2]) >= (2, 10)
