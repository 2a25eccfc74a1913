"""Check of the installation: compiled kernels, threads, and a self-test of a few seconds with known results."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchkcreg.evaluation import bb_rmse
from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.projector import backproject, project_points, project_volume
from torchkcreg.reconstruction import fdk
from torchkcreg.registration import RegistrationConfig, register
from torchkcreg.simulation import weight_bearing_case

from .info import describe_installation, kernels_in_words

GEOMETRY = circular_geometry(range(0, 360, 12), sad=404, sdd=538, det_shape=(24, 32), pixel_spacing=(3.0, 3.0))
ROUNDING = 1e-4  # relative to the largest value: single precision with a margin
ROUGH_MM = 0.2  # largest accepted error; a quick registration of a small case is much better


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        name: Name of the check.
        passed: True if it works.
        found: A figure, or the reason of a failure.
    """

    name: str
    passed: bool
    found: str

    def __str__(self) -> str:
        return f"{'ok  ' if self.passed else 'FAIL'} {self.name}: {self.found}"


def self_test() -> list[Check]:
    """Run every check. A check that raises has failed, and its error is reported."""
    checks: dict[str, Callable[[], tuple[bool, str]]] = {
        "kernels": _kernels,
        "threads": _threads,
        "projector of nodes": _nodes,
        "projector of voxels": _voxels,
        "FDK of a ball": _fdk,
        "registration of a small case": _registration,
    }
    results = []
    for name, check in checks.items():
        try:
            passed, text = check()
        except Exception as error:  # any error is a finding to report
            passed, text = False, f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
        results.append(Check(name, passed, text))
    return results


def doctor() -> tuple[str, bool]:
    """Report of versions, backend and self-test, a line each, and True if every check passed."""
    checks = self_test()
    healthy = all(check.passed for check in checks)
    last = "all is well" if healthy else "something does not work: see FAIL above"
    return "\n".join([describe_installation(), *map(str, checks), last]), healthy


def _kernels() -> tuple[bool, str]:
    backend, why = kernels_in_words()
    return backend == "cpp", why


def _threads() -> tuple[bool, str]:
    threads, cores = torch.get_num_threads(), os.cpu_count() or 1
    limited = {name: os.environ[name] for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS") if name in os.environ}
    settings = "".join(f", {name}={value}" for name, value in limited.items())
    return threads >= 1, f"{threads} of {cores} cores{settings}"


def _nodes() -> tuple[bool, str]:
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 30 - 15
    volumes = torch.full((2000,), 0.1)
    matrices = GEOMETRY.projection_matrices.float()[:3]
    cell = 0.5 * torch.eye(3)
    images = [
        project_points(points, volumes, matrices, (24, 32), cell=cell, backend=name) for name in ("auto", "torch")
    ]
    return _alike(images[0], images[1], "from the reference")


def _voxels() -> tuple[bool, str]:
    grid = VolumeGrid.centered((12, 20, 20), 2.0)
    generator = torch.Generator().manual_seed(0)
    volume = torch.rand(grid.shape, generator=generator)
    images = project_volume(volume, grid, GEOMETRY.projection_matrices, (24, 32))
    weights = torch.rand(images.shape, generator=generator)
    forward = (images * weights).sum(dtype=torch.float64)
    adjoint = (volume * backproject(weights, grid, GEOMETRY.projection_matrices)).sum(dtype=torch.float64)
    return _alike(forward, adjoint, "between projector and adjoint")


def _alike(values: torch.Tensor, reference: torch.Tensor, label: str) -> tuple[bool, str]:
    error = float((values - reference).abs().max() / reference.abs().max())
    return error < ROUNDING, f"{error:.1e} {label}"


def _fdk() -> tuple[bool, str]:
    grid, radius = VolumeGrid.centered((10, 24, 24), 2.0), 18.0
    source = GEOMETRY.source_positions[:, None, None]
    ray = GEOMETRY.rays()
    ray = ray / ray.norm(dim=-1, keepdim=True)
    nearest = torch.linalg.cross(source.expand_as(ray), ray).norm(dim=-1)
    chords = 2 * (radius**2 - nearest**2).clamp_min(0).sqrt()
    volume = fdk(0.02 * chords.float(), GEOMETRY, grid)
    mean = float(volume[grid.points().norm(dim=-1) < 8].mean())
    return abs(mean - 0.02) < 0.001, f"{mean:.4f} for 0.02 per mm"


def _registration() -> tuple[bool, str]:
    start = time.perf_counter()
    case = weight_bearing_case(0.5, binning=4)
    result = register(case.cloud(0.5), case.data(), RegistrationConfig(material="steel"), components=case.screws)
    error = bb_rmse(result.warp(case.beads_before), case.beads_after)
    return bool(error < ROUGH_MM), f"{error:.3f} mm off, {time.perf_counter() - start:.0f} s"
