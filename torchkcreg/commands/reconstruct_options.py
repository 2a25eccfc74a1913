"""Files and options of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from torchkcreg.options import Config


@dataclass(frozen=True)
class ReconstructionFiles:
    """Input files of a reconstruction; missing ones are taken from the run.

    Attributes:
        run: Folder of a finished registration, which gives the registered implant.
        geometry: Projection matrices.
        projections: Intensities or line integrals of all views.
        spectrum: Detected spectrum.
        components: Screws that replace those of the run.
        open_beam: Unattenuated intensity, if the projections' file does not give it.
        initial: Start volume of PWLS.
    """

    run: Path | None = None
    geometry: Path | None = None
    projections: Path | None = None
    spectrum: Path | None = None
    components: Path | None = None
    open_beam: float | None = None
    initial: Path | None = None


_ONLY_FOR = {
    ("window",): ("fdk", "kcmar"),
    ("preset", "iterations", "subsets", "beta", "passes"): ("pwls", "kcrec"),
    ("material", "soft_tissue"): ("kcmar", "kcrec"),
}


class ReconstructionOptions(Config):
    """Options of a reconstruction; unknown keys are refused.

    Attributes:
        method: "fdk"; "pwls"; "kcmar", FDK with the registered metal inpainted in the projections; "kcrec", PWLS of the
            background around the registered implant.
        spacing_mm: Voxel size.
        size_mm: Size (x, y, z) of the volume; the field of view if None.
        center_mm: Center (x, y, z) of the volume, if a size is given.
        refine: Number of parts along each edge into which voxels near known metal are divided ("kcrec"); 1: none.
        refine_within_mm: Distance from the metal within which voxels are divided.
        preset: "momentum" (50 iterations) or "paper" (500 iterations of 20 subsets).
        iterations: Number of iterations; the preset's if None.
        subsets: Number of ordered subsets; the preset's if None.
        beta: Weight of the roughness penalty.
        passes: Passes of the iterative methods. From the second on, beam hardening by bone mineral and scatter in the
            metal's shadow are corrected from the previous pass. None: two for "kcrec", which needs both; else one.
        window: Window of the ramp filter.
        scatter: "auto" fits smooth scatter to the air around the object; "run" takes both scatter terms of the
            registration; "none"; or the scatter as a fraction of the primary.
        scatter_sigma_mm: Width of the scatter, if its fraction is given.
        monoenergetic: Use one energy, as in the paper, even if a spectrum is given.
        beam: "given" uses the spectrum of the file, or a typical one, and the materials of the run; "run" uses the same
            with the hardness found by the registration; "estimate" fits spectrum and alloy to the metal's shadow
            (methods with components).
        soft_tissue: Attenuation of most of the object relative to water, which fixes the scale of an estimated beam: 1
            in a water bath.
        stream: Read a few views at a time, for scans larger than memory. Iterative methods keep intermediate data in
            files in the output folder while they run.
        material: Material of the implant, if the registration had none.
        single_material: Material of the object, if it consists of only one, such as an implant on a bench: "fdk" gives
            its fraction in each voxel, without beam hardening.
        backend: Projector: "auto", "cpp" or "torch".
    """

    method: Literal["fdk", "pwls", "kcrec", "kcmar"] = "fdk"
    spacing_mm: float = Field(0.8, gt=0)
    size_mm: tuple[float, float, float] | None = None
    center_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    refine: int = Field(1, ge=1, le=8)
    refine_within_mm: float = Field(5.0, gt=0)
    preset: Literal["momentum", "paper"] = "momentum"
    iterations: int | None = Field(None, ge=1)
    subsets: int | None = Field(None, ge=1)
    beta: float = Field(10.0, ge=0)
    passes: int | None = Field(None, ge=1)
    window: Literal["ram-lak", "shepp-logan", "cosine", "hamming", "hann"] = "hann"
    scatter: Literal["auto", "run", "none"] | float = "auto"
    scatter_sigma_mm: float = Field(40.0, gt=0)
    monoenergetic: bool = False
    beam: Literal["given", "run", "estimate"] = "given"
    soft_tissue: float | None = Field(None, gt=0.5, lt=2)
    stream: bool = False
    material: str | None = None
    single_material: str | None = None
    backend: Literal["auto", "cpp", "torch"] = "auto"

    @model_validator(mode="after")
    def _options_fit_the_method(self) -> ReconstructionOptions:
        for names, methods in _ONLY_FOR.items():
            if self.method in methods:
                continue
            idle = [name for name in names if getattr(self, name) != type(self).model_fields[name].default]
            if idle:
                raise ValueError(f"no effect on {self.method}, only on {', '.join(methods)}: {', '.join(idle)}")
        if self.center_mm != (0.0, 0.0, 0.0) and self.size_mm is None:
            raise ValueError("center_mm has no effect without size_mm: the volume is the whole field of view")
        return self

    @property
    def is_filtered(self) -> bool:
        """True if the method is a filtered back-projection, without iterations."""
        return self.method in ("fdk", "kcmar")

    @property
    def num_passes(self) -> int:
        """Number of passes."""
        if self.passes is not None:
            return self.passes
        return 2 if self.method == "kcrec" else 1
