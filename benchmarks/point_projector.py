"""Time and accuracy of the point-cloud projector compared with nanodrr and DiffDRR, on one machine.

    python benchmarks/point_projector.py [--threads 2] [--rounds 3] [--binning 2] [--out benchmarks/results]

The ten-hole plate in the paper's three views; all libraries render the same pixels. torchkcreg renders nodes; the
calculation of their footprints is part of its time, though a registration does it once. The other libraries render
voxels of the size of the nodes' lattice, each with its share of metal, with one ray per pixel; nanodrr is also run with
the average of several rays. Libraries that sample rays take the fewest samples that are as accurate as many: a third
table shows their time and error for each number. Rays are rendered in as few parts as the memory allows.

torchkcreg's backward pass gives the gradient with respect to every node; the others' only with respect to the pose,
which is less work. Errors are relative to the exact chords, averaged over pixels. A second table shows how the
projector's speed depends on the number of nodes, views, candidates and threads. Libraries that are not installed are
left out with a message; TIGRE, LEAP and ASTRA project cone beams on GPUs only and have no rows. Writes
point_projector.md and point_projector.png.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import torch
from common import present, processor, timed, write_report
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.projector import PointCloudProjector, cell_footprint, project_mesh
from torchkcreg.simulation import locking_plate

PITCH = 0.25
RAYS_AT_ONCE = 4096  # for Siddon's method, which stores every plane that a ray crosses
FINER = 3
SAMPLES_AT_ONCE = 8_000_000  # bounds the memory for the gradient
SAMPLE_NUMBERS = (10, 15, 25, 50, 100, 200, 400)  # along the part of a ray inside the volume
AS_ACCURATE = 1.05  # times the error with the most samples
Steps = dict[str, Callable[[], Tensor]]


class Scene:
    """A plate, its nodes, voxels and views, and the exact images."""

    def __init__(self, binning: int) -> None:
        self.mesh = locking_plate()
        self.cloud = ImplantPointCloud.from_mesh(self.mesh, pitch=PITCH)
        scanner = MultisourceScanner()
        self.geometry = scanner.geometry().select(scanner.paper_views("3")).bin(binning)
        self.truth = project_mesh(
            torch.tensor(self.mesh.vertices),
            torch.tensor(self.mesh.faces),
            self.geometry.projection_matrices,
            self.geometry.det_shape,
        )
        generator = torch.Generator().manual_seed(0)
        self.upstream = torch.rand(self.truth.shape, generator=generator)

    def error(self, images: Tensor) -> float:
        """Root mean square error relative to the root mean square of the truth, per cent."""
        return 100 * float((images.double() - self.truth).norm() / self.truth.norm())

    def voxels(self) -> tuple[Tensor, Tensor]:
        """Share of metal (x, y, z) in the lattice's cells, and the affine matrix (4, 4) from cell indices to mm."""
        points = self.cloud.points.double()
        steps = self.cloud.cell.double().diagonal()
        index = ((points - points.amin(0)) / steps).round().long()
        volume = torch.zeros(*(index.amax(0) + 1 + 2).tolist())
        shares = (self.cloud.volumes.double() / steps.prod()).float()
        volume.index_put_(tuple((index + 1).T), shares, accumulate=True)
        affine = torch.diag(torch.cat([steps, steps.new_ones(1)]))
        affine[:3, 3] = points.amin(0) - steps
        return volume, affine


def ours(scene: Scene) -> Steps:
    projector, cloud = PointCloudProjector(scene.geometry), scene.cloud
    points = cloud.points.clone().requires_grad_(True)

    def images() -> Tensor:
        footprint = cell_footprint(cloud.points, cloud.cell, scene.geometry.projection_matrices)
        return projector(points, cloud.volumes, footprint=footprint)

    return both(images, points, scene.upstream)


def mesh(scene: Scene) -> Steps:
    vertices = torch.tensor(scene.mesh.vertices, requires_grad=True)
    faces, geometry = torch.tensor(scene.mesh.faces), scene.geometry
    render = lambda: project_mesh(vertices, faces, geometry.projection_matrices, geometry.det_shape)  # noqa: E731
    return both(render, vertices, scene.upstream.double())


def rays(geometry: ConeBeamGeometry) -> tuple[Tensor, Tensor]:
    """Sources (V, 1, 3), and points (V, N, 3) behind the object on the rays through all pixels."""
    sources, directions = geometry.source_positions.float(), geometry.rays().flatten(1, 2).float()
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return sources[:, None], sources[:, None] + 600 * directions


def nanodrr(scene: Scene, samples: int, finer: int = 1) -> Steps:
    """The camera is at the world origin, so sources and ray ends are given in world coordinates."""
    from nanodrr.data import Subject
    from nanodrr.drr.renderer import render

    volume, affine = scene.voxels()
    data, to_world = volume.permute(2, 1, 0)[None, None].contiguous(), affine.float()
    subject = Subject(
        data,
        torch.zeros_like(data),
        to_world,
        affine.inverse().float(),
        Subject._make_voxel_to_grid(data.shape),
        torch.zeros(3),
        max_label=0,
        convert_to_mu=False,
    )
    sources, ends = rays(scene.geometry.refined(finer))
    pose = torch.eye(4)[None].requires_grad_(True)
    _, rows, cols = scene.truth.shape
    bands = next(
        n for n in range(1, rows + 1) if rows % n == 0 and rows * cols * finer**2 * samples / n <= SAMPLES_AT_ONCE
    )
    size, nothing = finer * (rows // bands), torch.eye(3)[None]

    def band(view: int, number: int) -> Tensor:
        part = slice(number * size * cols * finer, (number + 1) * size * cols * finer)
        source, end = sources[view : view + 1], ends[view : view + 1, part]
        length = torch.ones(1)
        image = render(subject, nothing, pose, length, size, cols * finer, n_samples=samples, src=source, tgt=end)
        return avg_pool2d(image[0], finer)[0]

    def forward() -> Tensor:
        with torch.no_grad():
            views = [torch.cat([band(view, number) for number in range(bands)]) for view in range(len(sources))]
        return torch.stack(views)

    def backward() -> Tensor:
        total = torch.zeros_like(pose)
        for view, upstream in enumerate(scene.upstream):
            for number, part in enumerate(upstream.chunk(bands)):
                total += torch.autograd.grad(band(view, number), pose, part)[0]
        return total

    return {"forward": forward, "and back": backward}


def diffdrr(scene: Scene, samples: int | None = None) -> Steps:
    """Siddon's exact method, or trilinear interpolation at a number of samples."""
    from diffdrr.renderers import Siddon, Trilinear

    volume, affine = scene.voxels()
    back = affine.inverse().float()
    sources, ends = rays(scene.geometry)
    pose = torch.eye(4).expand(len(sources), 4, 4).clone().requires_grad_(True)
    shape = scene.truth.shape
    renderer, more = (Siddon(), {}) if samples is None else (Trilinear(), {"n_points": samples})
    at_once = RAYS_AT_ONCE if samples is None else max(1, SAMPLES_AT_ONCE // (samples * len(sources)))

    def moved(points: Tensor) -> Tensor:
        to_voxels = back @ pose
        return points @ to_voxels[:, :3, :3].mT + to_voxels[:, None, :3, 3]

    def images() -> Tensor:
        parts = []
        for chunk in ends.split(at_once, dim=1):
            length = (chunk - sources).norm(dim=-1)[:, None]
            parts.append(renderer(volume, moved(sources), moved(chunk), length, **more)[:, 0])
        return torch.cat(parts, dim=1).reshape(shape)

    return both(images, pose, scene.upstream)


def both(images: Callable[[], Tensor], leaf: Tensor, upstream: Tensor) -> Steps:
    """Forward pass alone, without autograd, and forward and backward pass to the gradient of a leaf."""

    def forward() -> Tensor:
        with torch.no_grad():
            return images()

    return {"forward": forward, "and back": lambda: torch.autograd.grad(images(), leaf, upstream)[0]}


LIBRARIES = {
    "torchkcreg": (ours, "torchkcreg"),
    "torchkcreg, mesh": (mesh, "torchkcreg"),
    "nanodrr": (nanodrr, "nanodrr"),
    f"nanodrr, {FINER} x {FINER} rays": (lambda scene, samples: nanodrr(scene, samples, FINER), "nanodrr"),
    "DiffDRR": (diffdrr, "diffdrr"),
    "DiffDRR, trilinear": (diffdrr, "diffdrr"),
}
SAMPLED = {
    "nanodrr": "nanodrr",
    f"nanodrr, {FINER} x {FINER} rays": "nanodrr",
    "DiffDRR, trilinear": "DiffDRR, trilinear",
}


def sweep(scene: Scene, threads: int, names: list[str]) -> tuple[list[tuple[str, int, float, float]], dict[str, int]]:
    """Forward time and error of each sampling library for each number of samples, and the number to use."""
    torch.set_num_threads(threads)
    rows, chosen = [], {}
    for name in dict.fromkeys(SAMPLED[n] for n in names if n in SAMPLED):
        errors = {}
        for samples in SAMPLE_NUMBERS:
            times, images = timed({0: LIBRARIES[name][0](scene, samples)["forward"]}, 1)
            errors[samples] = scene.error(images[0])
            rows.append((name, samples, times[0], errors[samples]))
        limit = AS_ACCURATE * min(errors.values())
        chosen[name] = next(samples for samples, error in errors.items() if error <= limit)
    return rows, chosen


def measure(
    scene: Scene, threads: int, rounds: int, names: list[str], samples: dict[str, int]
) -> list[tuple[str, str, int, float, float]]:
    """Table rows (step, library, threads, best seconds, error in per cent)."""
    torch.set_num_threads(threads)
    numbers = {name: (samples[SAMPLED[name]],) if name in SAMPLED else () for name in names}
    made = {name: LIBRARIES[name][0](scene, *numbers[name]) for name in names}
    times, images = timed({(name, step): run for name, steps in made.items() for step, run in steps.items()}, rounds)
    errors = {name: scene.error(images[name, "forward"]) for name in names}
    return [(step, name, threads, seconds, errors[name]) for (name, step), seconds in times.items()]


def growth(scene: Scene, rounds: int) -> list[tuple[str, int, float]]:
    """Table rows (varied quantity, its value, million node-views per second) of the forward pass."""
    rows = []
    scanner, cloud = MultisourceScanner(), scene.cloud

    def rate(points: Tensor, nodes: Tensor, geometry: ConeBeamGeometry, cell: Tensor) -> float:
        projector, footprint = PointCloudProjector(geometry), cell_footprint(points, cell, geometry.projection_matrices)
        seconds = timed({0: lambda: projector(points, nodes, footprint=footprint)}, rounds)[0][0]
        return points.shape[:-1].numel() * len(geometry.projection_matrices) / seconds / 1e6

    for factor in (4, 3, 2, 1):
        coarse = cloud if factor == 1 else cloud.coarsened(factor)
        rows.append(("nodes", len(coarse.points), rate(coarse.points, coarse.volumes, scene.geometry, coarse.cell)))
    whole = scanner.geometry().bin(2)
    for views in (1, 3, 12, 50):
        chosen = whole.select(list(range(0, 200, 200 // views))[:views])
        rows.append(("views", views, rate(cloud.points, cloud.volumes, chosen, cloud.cell)))
    half = cloud.coarsened(2)
    for candidates in (1, 10, 40):
        points = half.points + 0.1 * torch.randn(candidates, 1, 3)
        rows.append(("candidates", candidates, rate(points, half.volumes, scene.geometry, half.cell)))
    for threads in (1, 2):
        torch.set_num_threads(threads)
        rows.append(("threads", threads, rate(cloud.points, cloud.volumes, scene.geometry, cloud.cell)))
    return rows


def roofline(scene: Scene, rate: float, rounds: int) -> str:
    """Compare a rate in million node-views per second with the floating-point rate of a matrix product."""
    geometry, cloud = scene.geometry, scene.cloud
    taps = cell_footprint(cloud.points, cloud.cell, geometry.projection_matrices).taps
    operations = 2 * (4 * taps**2 + 12) + taps**2  # per tap, four corners of the table; the projection; the image
    size = 2048
    left, right = torch.rand(2, size, size)
    best = 2 * size**3 / timed({0: lambda: left @ right}, rounds)[0][0] / 1e9
    reached = rate * operations / 1e3
    return (
        f"A node-view has {taps} x {taps} taps, {operations} floating-point operations: {reached:.0f} GFLOP/s, "
        f"{100 * reached / best:.0f} % of the {best:.0f} GFLOP/s of a product of {size} x {size} matrices."
    )


def table(
    scene: Scene,
    rows: list,
    grown: list,
    swept: list,
    samples: dict[str, int],
    names: list[str],
    left_out: list[str],
    limit: str,
) -> str:
    modules = dict.fromkeys(module for name, (_, module) in LIBRARIES.items() if name in names)
    versions = [f"{module} {metadata.version(module)}" for module in ("torch", *modules) if module != "torchkcreg"]
    times = {(step, name, threads): seconds for step, name, threads, seconds, _ in rows}
    shape = "{} x {}".format(*scene.geometry.det_shape)
    lines = [
        "# Point-cloud projector",
        "",
        f"{len(scene.cloud.points)} nodes on a lattice of {PITCH} mm, 3 views of {shape}; best of some rounds, "
        f"interleaved. {processor()}; {', '.join(versions)}."
        + "".join(f" {name} is not installed." for name in left_out),
        "",
        "| step | library | threads | seconds | of torchkcreg's time | error, % |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for step, name, threads, seconds, error in sorted(rows, key=lambda row: (row[0] != "forward", row[2])):
        ratio = seconds / times[step, "torchkcreg", threads]
        lines.append(f"| {step} | {name} | {threads} | {seconds:.4f} | {ratio:.1f} | {error:.2f} |")
    lines += [
        "",
        "Error: root mean square against the exact chords, averaged over pixels. Samples along a ray in the volume: "
        + ", ".join(f"{number} ({name})" for name, number in samples.items())
        + ", the fewest that are as accurate as the most accurate number (table below). torchkcreg's time contains "
        "its footprints. Back: gradient to all nodes or vertices (torchkcreg), to the poses (other libraries).",
        "",
        "| what grows | to | million node-views a second |",
        "| --- | --- | --- |",
        *(f"| {what} | {number} | {rate:.0f} |" for what, number, rate in grown),
        "",
        limit,
        "",
        "| library | samples | seconds, forward | error, % |",
        "| --- | --- | --- | --- |",
        *(f"| {name} | {number} | {seconds:.3f} | {error:.2f} |" for name, number, seconds, error in swept),
        "",
    ]
    return "\n".join(lines)


def draw(rows: list, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    most = max(row[2] for row in rows)
    chosen = [row for row in rows if row[2] == most]
    figure, axes = plt.subplots(figsize=(6, 3.8))
    for step, marker in (("forward", "o"), ("and back", "s")):
        points = [(error, seconds, name) for s, name, _, seconds, error in chosen if s == step]
        axes.scatter([p[0] for p in points], [p[1] for p in points], marker=marker, label=step)
        for error, seconds, name in points if step == "and back" else ():
            axes.annotate(
                name,
                (error, seconds),
                xytext=(6, -12 if name == "torchkcreg" else 4),
                textcoords="offset points",
                fontsize=8,
            )
    axes.set(xscale="symlog", yscale="log", xlabel="error, % RMS", ylabel=f"seconds, {most} threads")
    axes.set_xlim(left=-0.1, right=10 ** math.ceil(math.log10(max(row[4] for row in chosen)) + 0.5))
    axes.legend(frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[2])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--binning", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args(arguments)
    names, left_out = present({name: module for name, (_, module) in LIBRARIES.items()})
    scene = Scene(options.binning)
    swept, samples = sweep(scene, max(options.threads), names)
    rows = [row for threads in options.threads for row in measure(scene, threads, options.rounds, names, samples)]
    grown = growth(scene, options.rounds)
    limit = roofline(scene, grown[-1][2], options.rounds)
    text = table(scene, rows, grown, swept, samples, names, left_out, limit)
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    write_report(options.out / "point_projector.md", text)
    draw(rows, options.out / "point_projector.png")


if __name__ == "__main__":
    main()
