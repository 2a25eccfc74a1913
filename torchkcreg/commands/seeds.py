"""Register with several random seeds: the best run is the result, and the spread shows the effect of chance."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchkcreg.io import RunFolder
from torchkcreg.registration import RegistrationResult, Trainer

from .register import prepared_trainer, resolve_config, run_record, train, write_run
from .register_inputs import RegistrationFiles, RegistrationInputs, read_inputs

LARGEST_SPREAD_MM = 0.02


@dataclass(frozen=True)
class SeedRuns:
    """Registrations that differ only in their seed.

    Attributes:
        result: Result of the run with the lowest final loss.
        seeds: Seeds in the order of the runs.
        losses: Final loss of each run.
        distances_mm: Distance of each run's nodes from their mean over all runs, RMS over the nodes.
    """

    result: RegistrationResult
    seeds: tuple[int, ...]
    losses: tuple[float, ...]
    distances_mm: tuple[float, ...]

    @property
    def spread_mm(self) -> float:
        """Largest distance of a run from the mean of the runs, mm."""
        return max(self.distances_mm)

    def to_dict(self) -> dict[str, Any]:
        """Content of metrics.json under `seeds`."""
        return {
            "spread_mm": self.spread_mm,
            "best_seed": self.result.seed,
            "runs": [
                {"seed": seed, "loss": loss, "distance_mm": distance}
                for seed, loss, distance in zip(self.seeds, self.losses, self.distances_mm, strict=True)
            ],
        }

    def __str__(self) -> str:
        each = ", ".join(f"{d:.4f}" for d in self.distances_mm)
        return (
            f"{len(self.seeds)} seeds: spread {self.spread_mm:.4f} mm (RMS over nodes from the mean of the runs: "
            f"{each}); best seed {self.result.seed}"
        )


def register_seeds(
    files: RegistrationFiles,
    out: Path,
    num_seeds: int,
    *,
    overrides: dict[str, Any] | None = None,
    overwrite: bool = False,
    figures: bool = True,
) -> SeedRuns:
    """Register with several consecutive seeds, starting with that of the configuration.

    Each run is written to `out/seeds/<seed>`, without figures. The run with the lowest loss is also written to `out`,
    whose `metrics.json` has the spread under `seeds`. A spread above 0.02 mm gives a warning.

    Args:
        files: Input files: implants, geometry, projections, ...
        out: Run folder.
        num_seeds: Number of seeds.
        overrides: Options that override those of `files.config`.
        overwrite: Replace an existing run and its seeds.
        figures: Draw the best run.

    Raises:
        ValueError: If `num_seeds` is below 1, or files or options are wrong.
        FileNotFoundError: If a file is missing.
        FileExistsError: If `out` holds a run and `overwrite` is False.
    """
    if num_seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {num_seeds}")
    start = time.perf_counter()
    files, config = files.with_views(), resolve_config(files.config, overrides or {})
    inputs = read_inputs(files, config)
    prepared_trainer(inputs, config)  # raises on bad inputs before anything is written
    run = RunFolder.create(out, overwrite=overwrite)
    run.start(run_record(files, config))
    trainers: list[Trainer] = []
    results: list[RegistrationResult] = []
    for seed in range(config.seed, config.seed + num_seeds):
        seed_config, seed_start = config.model_copy(update={"seed": seed}), time.perf_counter()
        trainers.append(prepared_trainer(inputs, seed_config))
        folder = run.of_seed(seed)
        folder.start(run_record(files, seed_config))
        results.append(train(trainers[-1], folder, inputs))
        write_run(folder, results[-1], trainers[-1], inputs, seconds=time.perf_counter() - seed_start, figures=False)
    losses = tuple(float(result.history[-1]["loss"]) for result in results)
    best = losses.index(min(losses))
    nodes = torch.stack([_all_nodes(result, inputs) for result in results])
    seeds, distances = tuple(r.seed for r in results), tuple(distances_from_mean(nodes).tolist())
    result, trainer = results[best], trainers[best]
    runs = SeedRuns(result, seeds, losses, distances)
    _warn(runs, known=len(inputs.warnings))
    run.start(run_record(files, result.config))
    run.save_checkpoint(trainer.state_dict())
    more = {"seeds": runs.to_dict()}
    seconds = time.perf_counter() - start
    write_run(run, result, trainer, inputs, seconds=seconds, figures=figures, more_metrics=more)
    return runs


def _all_nodes(result: RegistrationResult, inputs: RegistrationInputs) -> Tensor:
    """World positions (N, 3) of all implants' nodes."""
    return torch.cat(
        [
            registered.warp(undeformed.cloud.points)
            for registered, undeformed in zip(result.implants, inputs.implants, strict=True)
        ]
    )


def distances_from_mean(nodes: Tensor) -> Tensor:
    """Distance of each run's nodes from their mean over the runs, RMS over the nodes, shape (R,).

    Args:
        nodes: Node positions of each run (R, N, 3), mm.

    >>> distances_from_mean(torch.tensor([[[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.5]]])).tolist()
    [0.25, 0.25]
    """
    return (nodes - nodes.mean(0)).square().sum(-1).mean(-1).sqrt()


def _warn(runs: SeedRuns, known: int) -> None:
    """Issue the best run's warnings after the first `known` (those of the inputs), which are already issued.

    A large spread adds a warning to the result, and makes an "ok" result "doubtful".
    """
    if runs.spread_mm > LARGEST_SPREAD_MM:
        runs.result.warnings.append(
            f"{len(runs.seeds)} seeds end up to {runs.spread_mm:.3f} mm from their mean (RMS over nodes), more than "
            f"{LARGEST_SPREAD_MM:g} mm: the views do not determine the result"
        )
        if runs.result.status == "ok":
            runs.result.status = "doubtful"
    for message in runs.result.warnings[known:]:
        warnings.warn(message, stacklevel=3)
