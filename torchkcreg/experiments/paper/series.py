"""Pictures of a series of registrations: the model over a projection of each, and how the implant bent in each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from torchkcreg.evaluation import displacement_map
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_geometry, read_mesh, read_projections, write_figure
from torchkcreg.projector import project_mesh
from torchkcreg.registration import RegistrationResult
from torchkcreg.visualization import overlay_figure, series_figure

_PITCH_MM = 0.8


def draw_series(out: Path, case: Path, results: Mapping[str, RegistrationResult], view: int) -> list[Path]:
    """Figures 3A and 3B of Cao et al. 2020: ``overlay.png`` and ``displacement.png``.

    Args:
        out: Folder.
        case: Of the images, `NAME.npz` for each result.
        results: By the name of their configuration.
        view: Number of the view over which the models are laid.
    """
    geometry, mesh = read_geometry(case / "geometry.json").select([view]), read_mesh(case / "implant.stl")
    images, shadows, bent = [], [], {}
    cloud = ImplantPointCloud.from_mesh(mesh, _PITCH_MM, dtype=torch.float64)
    for name, result in results.items():
        images.append(read_projections(case / f"{name}.npz", views=[view]).line_integrals[0])
        deformed = result.deformed(mesh)
        vertices, faces = (torch.from_numpy(np.array(a)) for a in (deformed.vertices, deformed.faces))
        shadows.append(project_mesh(vertices, faces, geometry.projection_matrices, geometry.det_shape)[0].float())
        bent[name] = displacement_map(cloud.points, result.warp(cloud.points), weights=cloud.volumes)
    spacing = geometry.pixel_spacing
    overlay = overlay_figure(
        torch.stack(images), torch.stack(shadows), view_labels=list(results), pixel_spacing=spacing
    )
    write_figure(out / "overlay.png", overlay)
    panels = {name: (one.undeformed, one.vectors) for name, one in bent.items()}
    write_figure(out / "displacement.png", series_figure(panels, label="displacement against the distal end (mm)"))
    return [out / "overlay.png", out / "displacement.png"]
