"""Options of a registration: what is estimated, in which stages, with which optimiser."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from torchkcreg.deformation import BendingPrior, Level
from torchkcreg.options import Config

SimilarityName = Literal["gradient-correlation", "gradient-difference"]
DeformationName = Literal["auto", "ffd", "modes", "fe", "rigid"]
PresetName = Literal["gauss-newton", "paper", "adam"]
StartName = Literal["auto", "given", "search"]

PHYSICS = ("scatter", "removed", "blur", "hardness")  # parameters of a polyenergetic intensity model

PAPER: Mapping[str, Any] = MappingProxyType(
    {
        "deformation": "ffd",
        "grid_shape": (6, 6, 10),
        "grid_spacing_mm": (8.75, 8.75, 25.0),
        "grid_grows": False,
        "beta": 1e-3,
        "stiffness": 0.0,
        "find_screws": False,
        "view_motion": "off",
        "undo_stages": False,
        "start": "given",
    }
)
"""Defaults of the preset "paper": the control points of section 2.4, and an objective of eq. 4 and 5 alone. The paper
does not give the weight beta; this one was the best of 1e-4, 1e-3 and 1e-2 for the tibial plate under 600 N."""

_COARSEST_PIXEL_MM = 6.5  # an implant's width is more than a pixel of it


class Stage(Config):
    """One level of the coarse-to-fine schedule.

    Attributes:
        groups: Number of control-point groups; one group is a rigid registration of the whole implant. An implant that
            spans fewer control points gets as many groups as possible.
        modes: Number of the implant's softest elastic modes, rigid ones included, along which groups move; None: each
            group has six degrees of freedom.
        bin: Detector pixels are averaged in squares of this side, of at most 6.5 mm.
        oversampling: DRRs are rendered on pixels this many times finer and averaged as intensities: the mean of
            exponentials is not the exponential of the mean, and depth is sensitive to the difference.
        pitch_factor: The implant's nodes are merged on a lattice this many times coarser.
        similarity: "gradient-correlation", or "gradient-difference", which also compares contrast, not only shape.
            Gradient correlation is used if DRRs are plain path lengths.
        optimizer: Name in `OPTIMIZERS`: "gauss-newton", "cmaes" or "adam".
        iterations: At most this many iterations (generations of CMA-ES).
        tolerance: The stage ends when an iteration moves the implant by less, mm (CMA-ES: the spread of a generation).
        step_mm: Initial step: CMA-ES standard deviation, Adam learning rate, largest Gauss-Newton step.
        population: Candidates of a CMA-ES generation.
        margin_mm: Margin around the implant's projection, mm at the detector; None: the whole detector.
        estimate: Parameters estimated besides the motion. Of the intensity model: "scatter" (from transmitted
            intensity), "removed" (from removed intensity), "blur", "hardness", each with a prior. "screws": lengths and
            radii of found screws. "tilts": small rotations of components about their heads. "views": motions of views.
        before: Names of the steps before the stage's optimiser, see `BEFORE`.
        after: Names of the steps after it, see `AFTER`.
    """

    groups: int = Field(1, ge=1, le=64)
    modes: int | None = Field(None, ge=6)
    bin: int = Field(1, ge=1, le=64)
    oversampling: int = Field(2, ge=1, le=8)
    pitch_factor: int = Field(1, ge=1, le=16)
    similarity: SimilarityName = "gradient-correlation"
    optimizer: str = "gauss-newton"
    iterations: int = Field(20, ge=1)
    tolerance: float = Field(0.002, gt=0)
    step_mm: float = Field(1.0, gt=0)
    population: int = Field(40, ge=4)
    margin_mm: float | None = Field(6.0, ge=0)
    estimate: tuple[str, ...] = ()
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()

    @property
    def level(self) -> Level:
        """Fineness of the deformation."""
        return Level(self.groups, self.modes)

    def binning(self, pixel_mm: float) -> int:
        """Number of detector pixels averaged along each side."""
        return binning(self.bin, pixel_mm)

    @model_validator(mode="after")
    def _slides_as_one(self) -> Stage:
        if "slide" in self.after and not self.level.is_rigid:
            raise ValueError(f"only a stage of one group can slide, this one has {self.groups} groups")
        return self


def binning(asked: int, pixel_mm: float) -> int:
    """Number of detector pixels averaged along each side: as requested, but at most 6.5 mm wide."""
    return min(asked, max(1, int(_COARSEST_PIXEL_MM / pixel_mm)))


def preset_stages(preset: PresetName, deformation: DeformationName = "modes") -> tuple[Stage, ...]:
    """Stages of a named schedule.

    All begin with a rigid CMA-ES on coarse pixels, which tolerates a start that is off by several mm.

    * "gauss-newton": then Gauss-Newton with one group, two groups, and finally elastic modes.
    * "paper": then CMA-ES with population 40, at most 400 iterations a stage, with one group and with 2 to 10 groups
      (Cao et al. 2020, section 2.3). No stage searches screws or places, or estimates anything but the motion.
    * "adam": the groups and images of "gauss-newton", with Adam.

    If the deformation is "ffd", groups move freely in all stages.
    """
    start = Stage(
        bin=16,
        pitch_factor=8,
        oversampling=1,
        optimizer="cmaes",
        iterations=60,
        tolerance=0.1,
        step_mm=4.0,
        population=16,
        margin_mm=25.0,
        estimate=("screws",),
        before=("find_screws",),
        after=("slide",),
    )
    if preset == "paper":
        return _paper_stages(start)
    finest = {"groups": 10} if deformation == "ffd" else {"groups": 20, "modes": 40}
    two = {"groups": 2}
    if deformation == "rigid":
        finest, two = {}, {}
    parts, every = ("screws", "tilts"), ("screws", "tilts", *PHYSICS)
    seen = {"pitch_factor": 2, "similarity": "gradient-difference"}
    fine = {"estimate": every, **seen}
    coarse = {"iterations": 12}  # finer pixels determine the rest better
    after_others = ("background", "reweight")
    weighed = ("weigh",) if deformation in ("fe", "auto") else ()
    hardness = ("scatter", "removed", "hardness")  # coarse pixels do not determine blur
    levels = [
        Stage(bin=8, pitch_factor=4, before=("find_screws",), estimate=parts, **coarse),
        Stage(bin=4, before=("find_screws", "background"), estimate=(*parts, *hardness), **seen, **coarse),
        Stage(**two, bin=4, before=("choose_screws", "background"), estimate=every, **seen, **coarse),
        Stage(**two, bin=2, before=after_others, **fine),
        Stage(**finest, bin=2, before=after_others, **fine),
        Stage(**finest, bin=1, before=("align", *after_others, *weighed), **(fine | {"estimate": (*every, "views")})),
    ]
    if preset == "adam":
        steps = (0.2, 0.1, 0.05, 0.05, 0.02, 0.02)
        descend = {"optimizer": "adam", "iterations": 120}
        levels = [s.model_copy(update={**descend, "step_mm": step}) for s, step in zip(levels, steps, strict=True)]
    return (start, *levels)


def _paper_stages(start: Stage) -> tuple[Stage, ...]:
    """Groups from 2 to 10 by CMA-ES after a rigid alignment (the paper takes that from "rigid-body registration")."""
    evolve = {"optimizer": "cmaes", "iterations": 400, "population": 40, "oversampling": 1}
    alone: dict[str, Any] = {"estimate": (), "before": (), "after": ()}
    return (
        start.model_copy(update=alone),
        Stage(bin=4, pitch_factor=2, step_mm=0.5, tolerance=0.02, **evolve),
        Stage(groups=2, bin=2, pitch_factor=2, step_mm=0.3, tolerance=0.01, **evolve),
        *(Stage(groups=groups, pitch_factor=2, step_mm=0.1, tolerance=0.005, **evolve) for groups in (4, 6, 8, 10)),
    )


class RegistrationConfig(Config):
    """All options of a registration except its files; unknown keys are refused.

    Attributes:
        preset: Named schedule, used when `stages` is empty. "paper" also changes the defaults of other options to those
            of Cao et al. (2020), see `PAPER`; what is given beside it counts.
        stages: The schedule itself, see `Stage`.
        start: "given": start from the given pose; "search": search for the implant in any orientation; "auto": search
            only if the given pose does not agree with the images.
        material: Name of the implant's material; None keeps plain path lengths (the paper's DRR).
        deformation: How the implant bends: "ffd" by groups of control points (the paper's model), "modes" by groups
            along the implant's softest elastic modes, "fe" as an elastic body loaded at its holes, "rigid" not at all,
            such as a joint component or a screw; "auto" is "fe" where the implant's stiffness is known, else "modes".
        pitch_mm: Lattice pitch of the implant's point cloud, mm.
        grid_shape: Control points along the principal axes, shortest axis first; grown where the implant needs more.
        grid_grows: If False, the grid has exactly that shape, and an implant longer than its control points is refused.
        grid_spacing_mm: Spacing of the control points, mm.
        beta: Weight of the diffusion penalty (eq. 5).
        stiffness: Weight of the elastic energy of the implant's own material in stages of groups, as its mean density
            over Young's modulus. That is half a squared strain: 30 charges 1e-5 of GC for strains of 1e-3, where steel
            yields, and 1e-3 for strains of 1e-2.
        load_weight: Loss for a load of 1 kN along an elastic mode, in stages of modes; it grows with the load's square.
        hold_force_n: Expected force along each axis at a hole, standard deviation, N; for finite elements.
        hold_moment_nmm: Expected moment about each axis, N mm. Screws of plates whose highest stresses are a fifth to
            four fifths of the yield stress carry 180 N and 1400 N mm, root mean square of 40 simulations
            (`random_case`).
        hold_unused: Ratio of expected loads at holes without a screw to those with one, if screws are known.
        hold_weight: Loss for a load of one standard deviation; it grows with the load's square. None: the images' loss
            per standard deviation, estimated in stages with the step "weigh".
        prior_weight: Loss for a parameter of the intensity model one standard deviation from its most likely value;
            it grows with the square.
        youngs_modulus_gpa: Young's modulus of the implant, GPa. The default is that of steel; only its square times
            `load_weight` matters, and only in order of magnitude.
        scatter: Initial scatter, as a fraction of the measured signal about a pixel.
        scatter_mm: How widely scatter is spread, standard deviation in mm at the detector.
        blur_px: Initial standard deviation of the detector's blur, pixels.
        background_mm: Smoothness of the estimated background, standard deviation in mm at the detector.
        background_material: Material of the background, which determines how it hardens the beam.
        find_screws: Search for screws in the implant's holes if no components are given.
        screw_materials: Possible materials of found screws, besides the implant's own.
        follow_radius_mm: A component follows the implant's nodes within this distance of its head.
        seed: Seed of every random number.
        backend: Projector: "auto", "cpp", "triton" or "torch".
        view_motion: Estimate motions of the views relative to the geometry: "off", "on", or "auto" (if the images show
            motion).
        view_motion_mm: Expected motion of views, standard deviation along each axis, mm; the same by rotation.
        undo_stages: Undo a stage that explains the images worse, moves the implant far away or strains it by 2 %.
        device: Where files are registered: "cpu", "cuda", "cuda:1", ...; in Python the data's own device decides.
    """

    preset: PresetName = "gauss-newton"
    stages: tuple[Stage, ...] = ()
    start: StartName = "auto"
    material: str | None = None
    deformation: DeformationName = "modes"
    pitch_mm: float = Field(0.25, gt=0)
    grid_shape: tuple[int, int, int] = (6, 6, 10)
    grid_grows: bool = True
    grid_spacing_mm: tuple[float, float, float] = (8.75, 8.75, 17.5)
    beta: float = Field(1e-4, ge=0)
    stiffness: float = Field(30.0, ge=0)
    load_weight: float = Field(3e-9, ge=0)
    hold_force_n: float = Field(200.0, gt=0)
    hold_moment_nmm: float = Field(1500.0, gt=0)
    hold_unused: float = Field(0.05, gt=0, le=1)
    hold_weight: float | None = Field(None, ge=0)
    prior_weight: float = Field(5e-4, ge=0)
    youngs_modulus_gpa: float = Field(200.0, gt=0)
    scatter: float = Field(0.08, ge=0, lt=1)
    scatter_mm: float = Field(25.0, gt=0)
    blur_px: float = Field(0.7, ge=0)
    background_mm: float = Field(2.5, gt=0)
    background_material: str = "soft_tissue"
    find_screws: bool = True
    screw_materials: tuple[str, ...] = ("steel", "titanium")
    follow_radius_mm: float = Field(8.0, gt=0)
    seed: int = 0
    backend: str = "auto"
    device: str = "cpu"
    view_motion: Literal["off", "on", "auto"] = "auto"
    view_motion_mm: float = Field(0.2, gt=0)
    undo_stages: bool = True

    @model_validator(mode="before")
    @classmethod
    def _defaults_of_preset(cls, given: Any) -> Any:
        if isinstance(given, Mapping) and given.get("preset") == "paper":
            return {**PAPER, **given}
        return given

    @field_validator("stages")
    @classmethod
    def _groups_only_split(cls, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
        counts = [stage.groups for stage in stages]
        if counts != sorted(counts):
            raise ValueError(f"groups only split: their number must not fall from stage to stage, got {counts}")
        return stages

    @property
    def bending_prior(self) -> BendingPrior:
        """Penalties on bending."""
        return BendingPrior(self.beta, self.stiffness, self.load_weight, self.youngs_modulus_gpa)

    def schedule(self) -> tuple[Stage, ...]:
        """The stages that will run."""
        return self.stages or preset_stages(self.preset, self.deformation)
