"""Time and accuracy of the voxel projector compared with RTK (itk-rtk) and mbirtorch, on one machine.

    python benchmarks/voxel_projector.py [--threads 1 2] [--rounds 3] [--out benchmarks/results]

60 views of 256 x 256 pixels, 128^3 voxels of 1 mm, float32. The libraries run in turn, in a process for each number of
threads, and the best of the rounds is reported. Libraries that are not installed are left out with a message. The
phantom consists of ellipsoids. Errors: forward projection of the voxelised phantom, against analytic chords through
pixel centres and averaged over pixels; back-projection, its deviation from the adjoint, `<A x, y> / <x, B y> - 1`; FDK,
the error in the phantom's flat parts. Writes voxel_projector.md and voxel_projector.png.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np
import torch
from common import present, processor, timed, write_report
from torch import Tensor

from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, circular_geometry
from torchkcreg.projector import backproject, project_volume
from torchkcreg.reconstruction.fdk import fdk

SAD, SDD, VIEWS, PIXELS, VOXELS = 404.0, 538.0, 60, 256, 128
PIXEL_MM = 300 / PIXELS
ELLIPSOIDS = (  # centre and half axes in mm, attenuation in 1/mm
    ((0.0, 0.0, 0.0), (50.0, 42.0, 46.0), 0.02),
    ((18.0, 6.0, -8.0), (14.0, 10.0, 20.0), 0.02),
    ((-20.0, -10.0, 12.0), (11.0, 12.0, 9.0), -0.01),
)
TILT_DEG = 0.5  # rotation of the detector in its plane, for the rows called "tilted"

Operations = dict[str, Callable[[], Tensor]]


def scene() -> tuple[ConeBeamGeometry, VolumeGrid]:
    angles = [360.0 / VIEWS * view for view in range(VIEWS)]
    geometry = circular_geometry(
        angles, sad=SAD, sdd=SDD, det_shape=(PIXELS, PIXELS), pixel_spacing=(PIXEL_MM, PIXEL_MM)
    )
    return geometry, VolumeGrid.centered((VOXELS,) * 3, 1.0)


def tilted(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    """The geometry with its detector rotated by `TILT_DEG` in its plane."""
    angle, middle = torch.tensor(TILT_DEG).deg2rad(), (PIXELS - 1) / 2
    turn = torch.eye(3, dtype=torch.float64)
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    turn[:2, 2] = middle - turn[:2, :2].sum(1) * middle
    return ConeBeamGeometry(turn @ geometry.projection_matrices, geometry.det_shape, geometry.pixel_spacing)


def voxelised(grid: VolumeGrid, finer: int = 4) -> Tensor:
    """Mean of the phantom in each voxel."""
    volume = torch.zeros(grid.shape)
    line = (torch.arange(finer) + 0.5) / finer - 0.5
    points = grid.points()
    for center, axes, value in ELLIPSOIDS:
        for shift in torch.cartesian_prod(line, line, line):
            inside = ((points + shift - torch.tensor(center)) / torch.tensor(axes)).square().sum(-1) < 1
            volume += inside * (value / finer**3)
    return volume


def chords(geometry: ConeBeamGeometry, finer: int = 1) -> Tensor:
    """Line integrals through pixel centres, or averaged over finer x finer rays per pixel."""
    fine = geometry.refined(finer)
    images = []
    for view in range(VIEWS):
        single_view = fine.select([view])
        rays, source, total = single_view.rays()[0], single_view.source_positions[0], 0
        for center, axes, value in ELLIPSOIDS:
            half = torch.tensor(axes).double()
            along, start = rays / half, (source - torch.tensor(center)) / half
            a, b = along.square().sum(-1), (along * start).sum(-1)
            root = (b * b - a * (start.square().sum() - 1)).clamp(min=0).sqrt()
            total = total + value * 2 * root / a * rays.norm(dim=-1)
        images.append(torch.nn.functional.avg_pool2d(total[None], finer)[0])
    return torch.stack(images).float()


def ours(geometry: ConeBeamGeometry, volume: Tensor, images: Tensor, threads: int) -> Operations:
    grid = VolumeGrid.centered(tuple(volume.shape), 1.0)
    matrices = geometry.projection_matrices
    return {
        "forward": lambda: project_volume(volume, grid, matrices, geometry.det_shape),
        "back": lambda: backproject(images, grid, matrices),
        "FDK": lambda: fdk(images, geometry, grid),
    }


def rtk(geometry: ConeBeamGeometry, volume: Tensor, images: Tensor, threads: int) -> Operations:
    """RTK rotates about y: its x, y, z are our y, z, x."""
    import itk
    from itk import RTK

    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(threads)
    itk.MultiThreaderBase.SetGlobalMaximumNumberOfThreads(threads)
    circle = RTK.ThreeDCircularProjectionGeometry.New()
    for angle in geometry.angles_deg or ():
        circle.AddProjection(SAD, SDD, angle)

    def image(values: np.ndarray, step: tuple[float, float, float]):
        made = itk.image_from_array(np.ascontiguousarray(values))
        made.SetSpacing(step)
        centred = [-(n - 1) / 2 * d for n, d in zip(values.shape[::-1], step)]
        made.SetOrigin([centred[0], centred[1], 0.0 if values.shape[0] == VIEWS else centred[2]])
        return made

    kind, voxel, pixel = itk.Image[itk.F, 3], (1.0, 1.0, 1.0), (PIXEL_MM, PIXEL_MM, 1.0)
    solid, stack = image(volume.permute(2, 0, 1).numpy(), voxel), image(images.numpy(), pixel)
    no_solid = np.zeros((VOXELS,) * 3, dtype=np.float32)
    no_stack = np.zeros(images.shape, dtype=np.float32)

    def run(make, zeros: np.ndarray, step: tuple[float, float, float], second, turn_back: bool) -> Tensor:
        method = make.New()
        method.SetNumberOfWorkUnits(threads)
        method.SetInput(0, image(zeros, step))  # a new image each time, since the filters work in place
        method.SetInput(1, second)
        method.SetGeometry(circle)
        method.Update()
        values = torch.from_numpy(itk.array_from_image(method.GetOutput()))
        return values.permute(1, 2, 0) if turn_back else values

    return {
        "forward": lambda: run(RTK.JosephForwardProjectionImageFilter[kind, kind], no_stack, pixel, solid, False),
        "back": lambda: run(RTK.JosephBackProjectionImageFilter[kind, kind], no_solid, voxel, stack, True),
        "FDK": lambda: run(RTK.FDKConeBeamReconstructionFilter[kind], no_solid, voxel, stack, True),
    }


def mbirtorch(geometry: ConeBeamGeometry, volume: Tensor, images: Tensor, threads: int) -> Operations:
    """mbirtorch orders volumes (row, column, slice); its channels and angles run in the opposite direction."""
    from mbirtorch import ConeBeamModel

    angles = np.deg2rad(90 - np.array(geometry.angles_deg))
    model = ConeBeamModel((VIEWS, PIXELS, PIXELS), angles, SDD, SAD)
    model.set_params(delta_det_channel=PIXEL_MM, delta_det_row=PIXEL_MM, delta_voxel=1.0, use_ror_mask=False)
    model.set_params(recon_shape=(VOXELS,) * 3, verbose=0)
    solid, stack = volume.permute(1, 2, 0).contiguous(), images.flip(2).contiguous()
    return {
        "forward": lambda: torch.as_tensor(model.forward_project(solid)).flip(2),
        "back": lambda: torch.as_tensor(model.back_project(stack)).permute(2, 0, 1),
    }


LIBRARIES = {"torchkcreg": ours, "itk-rtk": rtk, "mbirtorch": mbirtorch}


def error_of(operation: str, result: Tensor, forward: Tensor, volume: Tensor, images: Tensor, mean: Tensor) -> str:
    """Error of a result in per cent, as shown in the table."""
    if operation == "forward":
        # Rays through at least 10 mm, without an ellipsoid's edge within four pixels (there the pixel average matters).
        rims = torch.nn.functional.max_pool2d((images - mean).abs()[:, None], 9, 1, 4)[:, 0] > 0.01
        deep = (images > 0.2) & ~rims
        errors = [
            float((result - truth)[part].norm() / truth[part].norm())
            for truth, part in ((images, slice(None)), (mean, slice(None)), (mean, deep))
        ]
        return " / ".join(f"{100 * error:.3f}" for error in errors)
    if operation == "back":
        defect = float((forward.double() * images).sum() / (volume.double() * result).sum() - 1)
        return f"{100 * abs(defect):.5f}"
    whole = torch.nn.functional.max_pool3d
    flat = (-whole(-volume[None], 7, 1, 3) == whole(volume[None], 7, 1, 3))[0] & (volume > 0)
    flat[: VOXELS // 4], flat[-VOXELS // 4 :] = False, False  # FDK is not exact far from the plane of the source
    return f"{100 * float((result - volume)[flat].norm() / volume[flat].norm()):.2f}"


def measure(threads: int, rounds: int, names: list[str]) -> list[tuple[str, str, int, float, str]]:
    """Table rows (operation, library, threads, best seconds, error in per cent)."""
    torch.set_num_threads(threads)
    geometry, grid = scene()
    volume, images, mean = voxelised(grid), chords(geometry), chords(geometry, 4)
    made = {name: LIBRARIES[name](geometry, volume, images, threads) for name in names}
    leaning = ours(tilted(geometry), volume, images, threads)
    made["torchkcreg, tilted"] = {name: leaning[name] for name in ("forward", "back")}
    order = ("forward", "back", "FDK")
    best, results = timed({(n, step): made[n][step] for step in order for n in made if step in made[n]}, rounds)
    rows = []
    for step in order:
        for name in made:
            if (name, step) in results:
                truth = chords(tilted(geometry)) if "tilted" in name else images
                averaged = chords(tilted(geometry), 4) if "tilted" in name else mean
                back_truth = images if step == "back" else truth
                error = error_of(step, results[name, step], results[name, "forward"], volume, back_truth, averaged)
                rows.append((step, name, threads, best[name, step], error))
    return rows


def table(rows: list[tuple[str, str, int, float, str]], names: list[str], left_out: list[str]) -> str:
    versions = [f"{name} {metadata.version(name)}" for name in ("torch", *names[1:])]
    times = {(step, name, threads): seconds for step, name, threads, seconds, _ in rows}
    lines = [
        "# Voxel projector",
        "",
        f"{VIEWS} views of {PIXELS} x {PIXELS}, {VOXELS}^3 voxels of 1 mm, float32; best of some rounds, interleaved. "
        f"{processor()}; {', '.join(versions)}." + "".join(f" {name} is not installed." for name in left_out),
        "",
        "| operation | library | threads | seconds | of torchkcreg's time | error, % |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for step, name, threads, seconds, error in rows:
        ratio = seconds / times[step, "torchkcreg", threads]
        lines.append(f"| {step} | {name} | {threads} | {seconds:.3f} | {ratio:.1f} | {error} |")
    lines += [
        "",
        "Errors: forward, RMS against an ellipsoid phantom's chords through pixel centres / averaged over pixels / the "
        "latter away from edges (voxels blur edges); back, deviation from the adjoint of forward; FDK, RMS in the flat "
        "parts near the plane of the source. Tilted: the detector rotated by "
        f"{TILT_DEG} degrees in its plane, so that its columns are not parallel to the voxels'.",
        "",
    ]
    return "\n".join(lines)


def draw(rows: list[tuple[str, str, int, float, str]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    threads = sorted({row[2] for row in rows})
    names = list(dict.fromkeys(row[1] for row in rows))
    figure, panels = plt.subplots(1, len(threads), figsize=(5 * len(threads), 3.6), sharey=True, squeeze=False)
    for panel, count in zip(panels[0], threads):
        for k, name in enumerate(names):
            chosen = [(row[0], row[3]) for row in rows if row[1] == name and row[2] == count]
            places = [("forward", "back", "FDK").index(step) + 0.2 * (k - (len(names) - 1) / 2) for step, _ in chosen]
            bars = panel.bar(places, [seconds for _, seconds in chosen], 0.19, label=name)
            panel.bar_label(bars, fmt="%.2f", fontsize=7)
        panel.set(xticks=range(3), xticklabels=("forward", "back", "FDK"), yscale="log")
        panel.set_title(f"{count} thread" + "s" * (count > 1))
        panel.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("seconds")
    panels[0, -1].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args(arguments)
    modules = {"itk-rtk": "itk.RTKPython", "mbirtorch": "mbirtorch", "torchkcreg": "torchkcreg"}
    names, left_out = present({name: modules[name] for name in LIBRARIES})
    rows = []
    for threads in options.threads:  # a process each: ITK makes its pool of threads once
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows += pool.apply(measure, (threads, options.rounds, names))
    text = table(rows, names, left_out)
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    write_report(options.out / "voxel_projector.md", text)
    draw(rows, options.out / "voxel_projector.png")


if __name__ == "__main__":
    main()
