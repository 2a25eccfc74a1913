"""Penalised weighted least squares: ordered subsets, with or without momentum."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from torchkcreg.callbacks import Callback
from torchkcreg.options import Config
from torchkcreg.progress import progress_bar

from .scan_views import ViewShard
from .system import Roughness, System, VoxelRoughness

PRESETS = ("momentum", "paper")
BLOCK_VIEWS = 16  # projected together outside of subsets, to bound memory


def ordered_subsets(num_views: int, num_subsets: int, *, sources: Sequence[str] | None = None) -> list[list[int]]:
    """Views of each subset, in the order in which the subsets are visited.

    Views are distributed over the subsets in turn, focal spot by focal spot. Taking every n-th view instead could give
    subsets with a single focal spot each, if the period of the firing order divides n. Subsets are visited in
    bit-reversed order, so that successive subsets differ as much as possible.

    Args:
        num_views: Number of views V.
        num_subsets: Number of subsets, at most V.
        sources: Label of each view.

    Raises:
        ValueError: If the number of subsets is not between 1 and V, or the number of labels is not V.

    >>> ordered_subsets(8, 2, sources=list("ababcdcd"))
    [[0, 1, 4, 5], [2, 3, 6, 7]]
    """
    if not 1 <= num_subsets <= num_views:
        raise ValueError(f"subsets must be between 1 and the number of views {num_views}, got {num_subsets}")
    labels = [""] * num_views if sources is None else list(sources)
    if len(labels) != num_views:
        raise ValueError(f"sources must have one entry for each of {num_views} views, got {len(labels)}")
    dealt = [view for label in sorted(set(labels)) for view in range(num_views) if labels[view] == label]
    return [dealt[start::num_subsets] for start in bit_reversed(num_subsets)]


def bit_reversed(count: int) -> list[int]:
    """Numbers below `count` in bit-reversed order.

    >>> bit_reversed(6)
    [0, 4, 2, 1, 5, 3]
    """
    bits = max(1, (count - 1).bit_length())
    return [n for n in (int(f"{i:0{bits}b}"[::-1], 2) for i in range(1 << bits)) if n < count]


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed volume.

    Attributes:
        volume: Attenuation (D, H, W), 1/mm.
        history: One record per iteration: iteration, subsets, objective (exact if requested, else None), estimate
            (the objective from the subsets' residuals before their steps), change (RMS over the voxels, 1/mm), seconds.
    """

    volume: Tensor
    history: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class SubsetStage:
    """Consecutive iterations with the same number of ordered subsets.

    Attributes:
        iterations: Number of iterations.
        subsets: Number of subsets.
        momentum: True if steps start from the extrapolated point.
    """

    iterations: int
    subsets: int
    momentum: bool = True

    def check(self, num_views: int) -> None:
        """Check that there are not more subsets than views.

        Raises:
            ValueError: If there are.
        """
        if self.subsets > num_views:
            raise ValueError(f"subsets must be at most the number of views {num_views}, got {self.subsets}")


class PWLSConfig(Config):
    """Options of `pwls`.

    Attributes:
        iterations: Passes through all views.
        subsets: Number of ordered subsets at the start.
        momentum: Nesterov's momentum. The number of subsets is then halved after each quarter of the iterations, which
            keeps subset errors from accumulating in the momentum and lets the run converge.
        beta: Weight of the roughness, in the unit of the weights times mm^2.
        nonnegative: Constrain attenuation to be at least zero.
        objective_every: Compute the exact objective every so many iterations (half the cost of an iteration); 0: never.

    >>> PWLSConfig.preset("paper").stages()
    [SubsetStage(iterations=500, subsets=20, momentum=False)]
    """

    iterations: int = Field(50, ge=1)
    subsets: int = Field(20, ge=1)
    momentum: bool = True
    beta: float = Field(10.0, ge=0, allow_inf_nan=False)
    nonnegative: bool = True
    objective_every: int = Field(0, ge=0)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> PWLSConfig:
        """Named options: "paper", 500 iterations of 20 subsets (Cao et al. 2020); "momentum", 50 with momentum."""
        if name not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {name!r}")
        if name == "paper":
            return cls(**({"iterations": 500, "subsets": 20, "momentum": False} | changes))
        return cls(**changes)

    def stages(self) -> list[SubsetStage]:
        """Stages of the run."""
        if not self.momentum:
            return [SubsetStage(self.iterations, self.subsets, False)]
        quarters = [self.iterations * (i + 1) // 4 - self.iterations * i // 4 for i in range(4)]
        stages = []
        for count, part in zip(quarters, range(4)):
            if count:
                stages.append(SubsetStage(count, max(1, self.subsets >> part)))
        return stages

    def stage(self, iteration: int) -> SubsetStage:
        """Stage of an iteration, counted from 0."""
        stages = self.stages()
        for stage in stages:
            if iteration < stage.iterations:
                return stage
            iteration -= stage.iterations
        return stages[-1]


class PWLS:
    """Minimiser of `1/2 sum_i w_i ([A (s x)]_i - l_i)^2 + beta R(x)` over nonnegative volumes x.

    One iteration passes once through all views, subset by subset. Each subset's step divides the gradient by the
    curvature of separable paraboloidal surrogates of the objective (Erdogan and Fessler 1999). With momentum the steps
    start from an extrapolated point (Nesterov 1983; ordered subsets: Kim, Ramani and Fessler 2015). Ordered subsets
    end in a limit cycle around the minimum instead of reaching it, so with momentum the number of subsets is reduced
    during the run.

    Args:
        system: Projector: `VoxelSystem` or your own.
        line_integrals: Line integrals l, (V, rows, cols).
        weights: Weights w, same shape, not negative; see `statistical_weights`.
        config: Iterations, subsets, beta, ...
        mask: Mask s, of the volumes' shape: the share of each voxel that is unknown, between 0 and 1; 1 if None. Masked
            voxels are filled smoothly by the roughness.
        initial: Initial volume; zeros if None.
        roughness: Roughness R; that of cubic voxels if None.
        shard: Views that this process works on, see `ViewShard`.

    Raises:
        ValueError: If shapes do not match, values are not finite, weights are negative, or no weight is above zero.
    """

    def __init__(
        self,
        system: System,
        line_integrals: Tensor,
        weights: Tensor,
        config: PWLSConfig | None = None,
        *,
        mask: Tensor | None = None,
        initial: Tensor | None = None,
        roughness: Roughness | None = None,
        shard: ViewShard | None = None,
    ) -> None:
        self.system, self.config = system, config or PWLSConfig()
        self.data, self.weights, self.mask, self.initial = line_integrals, weights, mask, initial
        self.roughness: Roughness = roughness or VoxelRoughness()
        self.shard = shard
        self._check(initial)
        shape = tuple(system.volume_shape)
        self.volume = line_integrals.new_zeros(shape) if initial is None else initial.to(line_integrals).clone()
        if self.config.nonnegative:
            self.volume.clamp_(min=0)
        self.ahead, self.pace = self.volume.clone(), 1.0
        self.iteration = 0
        self.history: list[dict[str, Any]] = []
        self.curvature = self._curvature()

    def _check(self, initial: Tensor | None) -> None:
        data, weights, shape = self.data, self.weights, tuple(self.system.volume_shape)
        if data.dim() != 3 or len(data) != self.system.num_views:
            raise ValueError(
                f"line_integrals must have shape ({self.system.num_views}, rows, cols), got {tuple(data.shape)}"
            )
        if weights.shape != data.shape:
            raise ValueError(
                f"weights must have the line integrals' shape {tuple(data.shape)}, got {tuple(weights.shape)}"
            )
        least = torch.stack([view.min() for view in weights])  # view by view: the data may be larger than memory
        most = torch.stack([view.max() for view in weights])
        sums = torch.stack([view.sum() for view in data])
        for name, values in (("line_integrals", sums), ("weights", least + most)):
            if not bool(values.isfinite().all()):
                raise ValueError(
                    f"{name} must be finite; give pixels without a measurement weight 0 and any finite value"
                )
        if bool((least < 0).any()) or not bool((most > 0).any()):
            raise ValueError("weights must not be negative, and some must be above zero")
        for name, volume in (("mask", self.mask), ("initial", initial)):
            if volume is not None and (tuple(volume.shape) != shape or not bool(volume.isfinite().all())):
                raise ValueError(f"{name} must be finite numbers of shape {shape}, got {tuple(volume.shape)}")
        if self.mask is not None and bool(((self.mask < 0) | (self.mask > 1)).any()):
            raise ValueError("mask must be between 0 and 1, the share of each voxel that is unknown")
        self.config.stage(0).check(self.system.num_views)

    def _own(self, views: Sequence[int]) -> list[int]:
        """Subset of the views that this process works on."""
        if self.shard is None:
            return list(views)
        local_views = set(self.shard.views)
        return [view for view in views if view in local_views]

    def _total(self, tensor: Tensor) -> Tensor:
        return tensor if self.shard is None else self.shard.sum(tensor)

    def _masked(self, volume: Tensor) -> Tensor:
        return volume if self.mask is None else volume * self.mask

    def _curvature(self) -> Tensor:
        """Curvature `s A' W A s 1 + 2 beta deg`, (D, H, W), positive."""
        total = torch.zeros_like(self.volume)
        ones = self._masked(torch.ones_like(self.volume))
        for views in self._blocks():
            paths = self.system.project(ones, views)
            total += self.system.backproject(paths * self.weights[views], views)
        data = self._masked(self._total(total))
        if not bool((data > 0).any()):
            raise ValueError("the volume lies outside the field of view: no ray with positive weight crosses it")
        rough = self.config.beta * self.roughness.curvature(self.volume)
        return (data + rough).clamp_min(1e-6 * float(data.max()))

    def _blocks(self) -> list[list[int]]:
        views = self._own(range(self.system.num_views))
        return [views[start : start + BLOCK_VIEWS] for start in range(0, len(views), BLOCK_VIEWS)]

    def objective(self, volume: Tensor | None = None) -> float:
        """Objective of a volume, by default the current one; needs a projection of all views."""
        volume = self.volume if volume is None else volume
        misfit = torch.zeros((), dtype=torch.float64, device=volume.device)
        for views in self._blocks():
            residual = self.system.project(self._masked(volume), views) - self.data[views]
            misfit += 0.5 * (self.weights[views] * residual.square()).sum(dtype=torch.float64)
        return float(self._total(misfit)) + self.config.beta * float(self.roughness.value(volume))

    def step(self) -> dict[str, Any]:
        """Run one iteration and return its record."""
        start, before = time.perf_counter(), self.volume
        stage = self.config.stage(self.iteration)
        if self.iteration and stage.subsets != self.config.stage(self.iteration - 1).subsets:
            # restart: the old momentum contains errors of the old subsets
            self.ahead, self.pace = self.volume.clone(), 1.0
        subsets = ordered_subsets(self.system.num_views, stage.subsets, sources=self.system.sources)
        misfit = sum(self._sub_iteration(v, self.system.num_views / len(v), stage.momentum) for v in subsets)
        rough = float(self.roughness.value(self.volume))
        self.iteration += 1
        every = self.config.objective_every
        record = {
            "iteration": self.iteration,
            "subsets": stage.subsets,
            "objective": self.objective() if every and self.iteration % every == 0 else None,
            "estimate": misfit + self.config.beta * rough,
            "change": float((self.volume - before).square().mean().sqrt()),
            "seconds": time.perf_counter() - start,
        }
        self.history.append(record)
        return record

    def _sub_iteration(self, views: list[int], scale: float, momentum: bool) -> float:
        """Update the volume with one subset; returns the subset's misfit before the step."""
        local_views, point = self._own(views), self.ahead if momentum else self.volume
        gradient, misfit = torch.zeros_like(point), torch.zeros((), dtype=torch.float64, device=point.device)
        if local_views:
            residual = self.system.project(self._masked(point), local_views) - self.data[local_views]
            weighted = self.weights[local_views] * residual
            misfit += 0.5 * (weighted * residual).sum(dtype=torch.float64)
            gradient += self.system.backproject(weighted, local_views)
        gradient = self._masked(self._total(gradient)).mul_(scale)
        gradient.add_(self.roughness.gradient(point), alpha=self.config.beta)
        stepped = point - gradient.div_(self.curvature)
        if self.config.nonnegative:
            stepped.clamp_(min=0)
        if momentum:
            pace = (1 + (1 + 4 * self.pace**2) ** 0.5) / 2
            self.ahead = torch.lerp(self.volume, stepped, 1 + (self.pace - 1) / pace)
            self.pace = pace
        self.volume = stepped
        return float(self._total(misfit))

    def run(
        self, *, callbacks: Sequence[Callback] = (), number: int = 0, progress: bool | None = False
    ) -> Reconstruction:
        """Run the remaining iterations and return the reconstruction.

        Args:
            callbacks: Called at the start and end with the configuration, and after each iteration with its record.
            number: Number of this run among several passes, given to the callbacks.
            progress: Show a tqdm bar; None: on a terminal only.
        """
        for callback in callbacks:
            callback.on_stage_start(self, number, self.config)
        with progress_bar(total=self.config.iterations, initial=self.iteration, desc="PWLS", shown=progress) as bar:
            while self.iteration < self.config.iterations:
                record = self.step()
                bar.set_postfix(objective=f"{record['objective'] or record['estimate']:.6g}", refresh=False)
                bar.update()
                for callback in callbacks:
                    callback.on_iteration(self, number, record)
        for callback in callbacks:
            callback.on_stage_end(self, number, self.config)
        return Reconstruction(self.volume, self.history)

    def state_dict(self) -> dict[str, Any]:
        """State for resuming the run, without its inputs: tensors and plain data."""
        return {
            "volume": self.volume,
            "ahead": self.ahead,
            "pace": self.pace,
            "iteration": self.iteration,
            "history": list(self.history),
            "config": self.config.model_dump(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`; the resumed run is identical bit by bit.

        Raises:
            ValueError: If the state belongs to another configuration or volume shape.
        """
        if state["config"] != self.config.model_dump():
            raise ValueError("the checkpoint was made with another configuration")
        if tuple(state["volume"].shape) != tuple(self.volume.shape):
            raise ValueError(
                f"the checkpoint holds a volume of {tuple(state['volume'].shape)}, not {tuple(self.volume.shape)}"
            )
        self.volume, self.ahead = (state[name].to(self.volume).clone() for name in ("volume", "ahead"))
        self.pace, self.iteration, self.history = state["pace"], state["iteration"], list(state["history"])


def pwls(
    system: System,
    line_integrals: Tensor,
    weights: Tensor,
    config: PWLSConfig | None = None,
    *,
    progress: bool | None = False,
    callbacks: Sequence[Callback] = (),
    **options: Any,
) -> Reconstruction:
    """Run a PWLS reconstruction in one call; arguments as for `PWLS` and `PWLS.run`.

    >>> from torchkcreg.geometry import VolumeGrid, circular_geometry
    >>> from torchkcreg.reconstruction import VoxelSystem
    >>> geometry = circular_geometry(range(0, 180, 30), sad=404, sdd=538, det_shape=(9, 9), pixel_spacing=(2.0, 2.0))
    >>> system = VoxelSystem(geometry, VolumeGrid.centered((6, 6, 6), 2.0))
    >>> truth = torch.full((6, 6, 6), 0.02)
    >>> data = system.project(truth, range(6))
    >>> result = pwls(system, data, torch.ones_like(data), PWLSConfig(iterations=30, subsets=2, beta=0.0))
    >>> bool((system.project(result.volume, range(6)) - data).abs().max() < 0.01)
    True
    """
    return PWLS(system, line_integrals, weights, config, **options).run(callbacks=callbacks, progress=progress)
