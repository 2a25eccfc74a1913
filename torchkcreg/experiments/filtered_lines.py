"""What filtered back-projection takes of a scan's files: all of it, or some views as they are asked for."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchkcreg.physics import material
from torchkcreg.progress import progress_bar
from torchkcreg.reconstruction import BeamModel, component_path_lengths, inpainted, path_lengths_through, prepare

from .reconstruction_inputs import ReconstructionInputs
from .reconstruction_options import ReconstructionOptions


def line_integrals(inputs: ReconstructionInputs, options: ReconstructionOptions) -> Tensor:
    """What FDK takes: line integrals, around known metal, or path lengths where the object is of one material alone."""
    alone = options.single_material
    beam = inputs.beam.without_metals() if alone is None else BeamModel.monoenergetic([])
    lines = prepare(inputs.transmission, inputs.geometry, beam, scatter=inputs.scatter, mask=inputs.mask).line_integrals
    if alone is not None:
        return path_lengths_through(torch.exp(-lines), material(alone), inputs.spectrum)
    if not inputs.components:
        return lines
    metal = component_path_lengths(inputs.components, inputs.geometry, backend=options.backend)
    return inpainted(lines, metal, mask=inputs.mask)


def counted(lines: Tensor) -> Callable[[list[int]], Tensor]:
    """Views (V, rows, cols) as they are asked for, with a bar that shows how many there were."""
    bar = progress_bar(total=len(lines), desc="views")

    def read(views: list[int]) -> Tensor:
        bar.update(len(views))
        return lines[views]

    return read


def streamed(inputs: ReconstructionInputs, options: ReconstructionOptions) -> Callable[[list[int]], Tensor]:
    """The same of views as they are asked for, with a bar that shows how many there were."""
    bar = progress_bar(total=inputs.geometry.num_views, desc="views")

    def read(views: list[int]) -> Tensor:
        lines = line_integrals(inputs.of_views(views), options)
        bar.update(len(views))
        return lines

    return read
