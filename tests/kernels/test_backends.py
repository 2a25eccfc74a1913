"""Which backend serves a request, and that one more is a line in the table."""

import threading
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from filelock import FileLock

from torchkcreg.kernels import BACKENDS, Backend, Operator, backend_names, choose_backend, extension, kernel

TWICE = Operator("twice_for_tests(Tensor x) -> Tensor", reference=lambda x: 2 * x, fake=torch.empty_like)


def of_device(name: str) -> SimpleNamespace:
    """Data of a device that this machine need not have."""
    return SimpleNamespace(device=torch.device(name))


def test_the_reference_comes_last_and_serves_everything() -> None:
    assert BACKENDS[-1].is_reference and not any(backend.is_reference for backend in BACKENDS[:-1])
    assert BACKENDS[-1].serves("anything", "any operator")
    assert backend_names() == ("auto", "cpp", "triton", "torch")


def test_an_operator_without_a_kernel_is_its_reference_under_the_dispatcher() -> None:
    x = torch.arange(3.0)
    assert torch.ops.torchkcreg.twice_for_tests(x).tolist() == [0.0, 2.0, 4.0]
    torch.library.opcheck(TWICE.dispatched, (x,))
    assert kernel(TWICE, x, "torch") is TWICE.reference


def test_one_more_backend_is_one_line_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Backend("own", frozenset({"cuda"}), lambda: None, operators=frozenset({"twice_for_tests"}))
    monkeypatch.setattr("torchkcreg.kernels.backends.BACKENDS", (own, *BACKENDS))
    assert choose_backend(of_device("cuda"), operator="twice_for_tests") is own
    assert choose_backend(of_device("cuda"), operator="no_such_kernel").is_reference
    assert choose_backend(of_device("cpu"), operator="twice_for_tests").name == "cpp"
    with pytest.raises(ValueError, match="backend must be one of auto, own, cpp, triton, torch, got 'other'"):
        choose_backend(of_device("cuda"), "other")
    with pytest.raises(ValueError, match='backend "own" needs tensors on cuda, got cpu'):
        choose_backend(of_device("cpu"), "own")


def test_one_that_is_not_to_be_had_is_passed_over_unless_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Backend("own", None, lambda: "no such chip")
    monkeypatch.setattr("torchkcreg.kernels.backends.BACKENDS", (own, *BACKENDS))
    assert choose_backend(of_device("cpu")).name == "cpp"
    with pytest.raises(OSError, match='kernels of backend "own" are not available: no such chip'):
        choose_backend(of_device("cpu"), "own")


def test_auto_says_once_that_it_falls_back_to_the_slow_reference() -> None:
    with pytest.warns(UserWarning, match="no kernels for xpu: torchkcreg runs on its readable reference there"):
        choose_backend(of_device("xpu"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        choose_backend(of_device("xpu"))
        choose_backend(of_device("hpu"), "torch")  # asked for by name
        choose_backend(of_device("meta"))


def test_the_lock_of_a_killed_compilation_stops_nobody(monkeypatch, tmp_path):
    from torch.utils import cpp_extension

    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    folder = tmp_path / f"{extension.NAME}_{torch.__version__}"
    folder.mkdir()
    (folder / "lock").write_text("")  # torch waits for it to vanish
    seen = []
    monkeypatch.setattr(
        cpp_extension, "load", lambda *_a, build_directory, **_k: seen.append((Path(build_directory) / "lock").exists())
    )
    extension._load_compiled()
    assert seen == [False]


def test_waiting_for_another_compilation_is_said(monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(extension, "PATIENCE_SECONDS", 0.05)
    held, ended = threading.Event(), threading.Event()

    def compiles() -> None:
        with FileLock(tmp_path / "lock"):
            held.set()
            ended.wait(0.5)

    other = threading.Thread(target=compiles)
    other.start()
    held.wait()
    with caplog.at_level("WARNING"), extension.only_one(tmp_path / "lock"):
        pass
    other.join()
    assert "another process compiles torchkcreg's kernels" in caplog.text
