"""What a run folder holds, in a few lines for people."""

from __future__ import annotations

from pathlib import Path

from torchkcreg.deformation import FiniteElementDeformation, FreeFormDeformation
from torchkcreg.io import RunFolder, read_json
from torchkcreg.registration import RegisteredImplant


def describe_run(path: Path) -> str:
    """A registration: its verdict, what was measured, and how long it took."""
    run = RunFolder(path)
    result = run.read_result()
    metrics = read_json(path / "metrics.json", "metrics") if (path / "metrics.json").is_file() else {}
    sizes = "; ".join(_size(implant) for implant in result.implants)
    lines = [
        f"run, {result.status}, {sizes}, {len(result.history)} iterations",
        "  gradient correlation of each view: " + " ".join(f"{gc:.3f}" for gc in result.gc.tolist()),
    ]
    if isinstance(metrics.get("node_std_mm"), float):
        lines.append(f"  expected error of the nodes: {metrics['node_std_mm']:.3f} mm (RMS)")
    if {"mean_motion_mm", "largest_motion_mm"} <= metrics.keys():
        lines.append(
            f"  motion of the nodes: mean {metrics['mean_motion_mm']:.3f} mm, largest "
            f"{metrics['largest_motion_mm']:.3f} mm"
        )
    if isinstance(metrics.get("seconds"), (int, float)):
        lines.append(f"  took {metrics['seconds']:.0f} s")
    lines += [f"  {name}: {value:.3g}" for name, value in result.intensity.items()]
    return "\n".join([*lines, *(f"  warning: {text}" for text in result.warnings)])


def _size(implant: RegisteredImplant) -> str:
    deformation = implant.deformation
    if isinstance(deformation, FiniteElementDeformation):
        element = deformation.superelement
        return f"{implant.name}: elastic body held at {len(element.holds)} places, {element.num_amounts} ways to bend"
    if not isinstance(deformation, FreeFormDeformation):
        return f"{implant.name}: {deformation.model} deformation"
    shape = " x ".join(str(n) for n in deformation.grid.shape)
    groups = deformation.num_groups
    return f"{implant.name}: {shape} control points in {groups} group{'s' * (groups > 1)}"
