"""What a reconstruction from files is asked for: the files, and the options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from torchkcreg.options import Config


@dataclass(frozen=True)
class ReconstructionFiles:
    """The files of a reconstruction; what is not given comes from the run.

    Attributes:
        run: Folder of a finished registration: the implant in its place.
        geometry: Projection matrices.
        projections: Intensities or line integrals of all views.
        spectrum: Detected spectrum.
        components: Screws to take instead of the run's.
        open_beam: Unattenuated intensity where the projections' file does not say it.
        initial: Volume to start PWLS from.
    """

    run: Path | None = None
    geometry: Path | None = None
    projections: Path | None = None
    spectrum: Path | None = None
    components: Path | None = None
    open_beam: float | None = None
    initial: Path | None = None


class ReconstructionOptions(Config):
    """Options of a reconstruction; unknown keys are refused.

    Attributes:
        method: "fdk"; "pwls"; "kcrec", PWLS of what the registered implant leaves.
        spacing_mm: Edge of a voxel.
        size_mm: Size (x, y, z) of the volume; the field of view if None.
        center_mm: Its middle (x, y, z), where a size is given.
        refine: Voxels near known metal are divided into so many along each edge ("kcrec"); 1: none are.
        refine_within_mm: How near.
        preset: "momentum" or "paper" (500 iterations of 20 subsets).
        iterations: Overrides the preset's.
        subsets: Overrides the preset's.
        beta: Weight of the roughness.
        passes: Of the iterative methods; from the second on, mineral's hardening and the scatter in the metal's shadow
            are known from the pass before. None: two of "kcrec", which needs both, one of "pwls".
        window: Of the ramp.
        scatter: "auto" fits a smooth one to the air around the object; "run" is what the registration found, of both
            kinds; "none"; or its fraction of the primary.
        scatter_sigma_mm: How broad a given fraction's scatter is.
        monoenergetic: One energy, as in the paper, even where a spectrum is known.
        beam: "given" is the spectrum of the file and the materials of the run, or a likely one; "run" is the same, as
            hard as the registration found it; "estimate" is what the
            metal's shadow tells of a spectrum, or an implant's material, that nobody knows (methods with components).
        soft_tissue: Attenuation over water of what most of the object is, where an estimated beam may rest on that: 1
            in a water bath.
        stream: Views are read some at a time, of scans that are larger than memory; iterative methods keep what they
            make of them in files in the folder, for as long as they run.
        material: The implant's, where the registration had none.
        single_material: What the object is of, where it is of one material alone, such as an implant on a bench: "fdk"
            gives the share of it in each voxel, without beam hardening.
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

    @property
    def is_filtered(self) -> bool:
        """Whether it is a filtered back-projection, without iterations."""
        return self.method in ("fdk", "kcmar")

    @property
    def num_passes(self) -> int:
        """Passes that are made."""
        if self.passes is not None:
            return self.passes
        return 2 if self.method == "kcrec" else 1
