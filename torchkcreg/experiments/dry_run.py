"""What a registration would start from: everything read and checked, where the implant lies, a picture of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry
from torchkcreg.io import write_figure

from .figures import draw_start
from .inputs import RegistrationFiles, read_inputs
from .register_files import prepared_trainer, resolve_config


def dry_run(files: RegistrationFiles, picture: Path | None, *, overrides: dict[str, Any] | None = None) -> list[str]:
    """Lines for people about a registration that is not run: what was read, and the implant in each view at the start.

    Args:
        files: what would be registered to what.
        picture: PNG to write, the implant at its start over the views; none if None.
        overrides: options that override those of ``files.config``.

    Raises:
        ValueError, FileNotFoundError: as the registration itself would.
    """
    config = resolve_config(files.config, overrides or {})
    inputs = read_inputs(files, config)
    trainer = prepared_trainer(inputs, config)
    scene, data = trainer.scene, trainer.data
    lines = []
    for implant, assembly in zip(inputs.implants, scene, strict=True):
        nodes = assembly.nodes(1).reshape(-1, 3).detach().cpu().double()
        size = " x ".join(f"{x:.1f}" for x in (nodes.amax(0) - nodes.amin(0)).tolist())
        middle = ", ".join(f"{x:.1f}" for x in ((nodes.amax(0) + nodes.amin(0)) / 2).tolist())
        material = config.material or "path length alone"
        lines.append(f"{implant.name}: {len(nodes)} nodes, {size} mm about ({middle}) in the world, {material}")
        lines += [f"  {line}" for line in _in_views(nodes, data.geometry.cpu())]
    lines.append(f"{len(trainer.stages)} stages; nothing was registered")
    if picture is not None:
        write_figure(picture, draw_start(scene.cpu(), data.to("cpu")))
        lines.append(f"picture {picture}")
    return lines


def _in_views(nodes: Tensor, geometry: ConeBeamGeometry) -> list[str]:
    """Where nodes (N, 3) lie in each view, a line each."""
    uv, depth = geometry.project(nodes)
    rows, cols = geometry.det_shape
    inside = ((uv > -0.5) & (uv < uv.new_tensor([cols - 0.5, rows - 0.5]))).all(-1).double().mean(-1)
    low, high = uv.amin(1), uv.amax(1)
    magnified = geometry.detector_distances / depth.median(-1).values
    lines = []
    for view in range(geometry.num_views):
        angle = "" if geometry.angles_deg is None else f" ({geometry.angles_deg[view]:g} degrees)"
        span = [f"{float(low[view, k]):.0f} to {float(high[view, k]):.0f}" for k in (0, 1)]
        lines.append(
            f"view {view}{angle}: columns {span[0]} of {cols}, rows {span[1]} of {rows}, "
            f"{100 * float(inside[view]):.0f} % within the image, magnified {float(magnified[view]):.2f} times"
        )
    return lines
