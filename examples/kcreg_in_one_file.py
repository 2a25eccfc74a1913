"""FFD-KC-Reg in one file: the method of Cao et al. (SPIE 2020, doi 10.1117/12.2549768) on torch, kornia, numpy and cma.

A known implant is bent until its simulated radiographs match a few measured ones. The parts stand below in the order of
the paper: the point cloud, the free-form deformation (eq. 1-3), groups of control points, the DRR, gradient correlation
(eq. 4), the diffusion penalty (eq. 5), and the search from 1 to 10 groups by CMA-ES or Adam. It does not import
torchkcreg; docs/one_file.md walks through it.

    torchkcreg demo --out demo
    python examples/kcreg_in_one_file.py demo/case --screws

reads implant.stl, geometry.json and projections.npz of a folder, and prints the error where it holds beads with their
true positions. Lengths are in mm, points (N, 3), images (V, rows, cols), projection matrices (V, 3, 4).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cma
import kornia
import numpy as np
import torch
from torch import Tensor

SPACING = (8.75, 8.75, 25.0)  # of the control points, mm: section 2.4
BETA = 1e-4  # weight of the penalty
RADIUS = 30.0  # mm: parameters of a rotation are its angle times this


# The implant: a point cloud (section 2.2). Each node stands for a cube of metal.


def read_stl(path: Path) -> np.ndarray:
    """Triangles (T, 3, 3) of a binary STL file, mm."""
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(path.read_bytes()[84:], kind)["corners"].astype(float)


def nodes_inside(triangles: np.ndarray, pitch: float) -> Tensor:
    """Points (N, 3) of a lattice that lie inside a closed surface, by the parity of crossings along z."""
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    # Columns off the mesh's own edges, which they would cross twice or not at all.
    x, y, z = (np.arange(a + pitch * s, b, pitch) for a, b, s in zip(low, high, (0.4987, 0.5023, 0.5)))
    columns = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    crossings = [[] for _ in columns]
    for a, b, c in triangles:
        edges = np.stack([b - a, c - a], -1)[:2]
        if abs(np.linalg.det(edges)) < 1e-12:
            continue  # seen edge on
        s, t = np.linalg.solve(edges, (columns - a[:2]).T)
        for column in np.nonzero((s >= 0) & (t >= 0) & (s + t <= 1))[0]:
            crossings[column].append(a[2] + s[column] * (b - a)[2] + t[column] * (c - a)[2])
    inside = [np.searchsorted(np.sort(found), z) % 2 == 1 for found in crossings]
    points = [(*column, height) for column, heights in zip(columns, inside) for height in z[heights]]
    return torch.tensor(points)


def nodes_of_screw(start: np.ndarray, end: np.ndarray, radius: float, pitch: float) -> Tensor:
    """Points (N, 3) of a lattice inside a cylinder."""
    length = np.linalg.norm(end - start)
    axis = (end - start) / length
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    across, along = np.arange(-radius, radius, pitch) + pitch / 2, np.arange(0, length, pitch) + pitch / 2
    u, v, w = (g.ravel() for g in np.meshgrid(across, across, along, indexing="ij"))
    local = np.stack([u, v, w], -1)[u**2 + v**2 < radius**2]
    return torch.tensor(start + local @ np.stack([side, np.cross(axis, side), axis]))


# Free-form deformation (eq. 1-3): control points move, and cubic B-splines carry their displacements to the nodes.


def bspline(eta: Tensor) -> Tensor:
    """B_0 ... B_3 on a new last axis (eq. 3)."""
    middle = 3 * eta**3 - 6 * eta**2 + 4, -3 * eta**3 + 3 * eta**2 + 3 * eta + 1
    return torch.stack([(1 - eta) ** 3, *middle, eta**3], -1) / 6


class Grid:
    """Control points around the implant, and how much each of them moves each node.

    Args:
        points: Nodes (N, 3) of the undeformed implant.
        spacing: Of the control points along x, y, z, mm.
    """

    def __init__(self, points: Tensor, spacing: tuple[float, float, float] = SPACING) -> None:
        self.spacing = torch.tensor(spacing, dtype=points.dtype)
        cells = ((points.amax(0) - points.amin(0)) / self.spacing).floor().long() + 1
        middle = (points.amax(0) + points.amin(0)) / 2
        self.shape = tuple((cells + 3).tolist())  # a spline needs one control point before and two after its cell
        self.origin = middle - self.spacing * (cells / 2 + 1)
        index = torch.stack(torch.meshgrid(*(torch.arange(n) for n in self.shape), indexing="ij"), -1)
        self.positions = (self.origin + index * self.spacing).reshape(-1, 3)

    def weights(self, points: Tensor) -> Tensor:
        """B_l B_m B_n of each control point at each point, (N, C): displacements are weights @ phi (eq. 2)."""
        place = (points - self.origin) / self.spacing
        first = place.floor().long() - 1  # c of eq. 2b
        basis = bspline(place - place.floor())  # (N, axis, 4)
        nx, ny, nz = self.shape
        l, m, n = torch.meshgrid(*[torch.arange(4)] * 3, indexing="ij")
        # Beyond the grid the outermost control points go on.
        x, y, z = ((first[:, a, None] + o.flatten()).clamp(0, self.shape[a] - 1) for a, o in enumerate((l, m, n)))
        value = basis[:, 0, l.flatten()] * basis[:, 1, m.flatten()] * basis[:, 2, n.flatten()]
        return torch.zeros(len(points), nx * ny * nz, dtype=points.dtype).scatter_add(1, (x * ny + y) * nz + z, value)


def rotations(vectors: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians."""
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    return torch.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3)))


# Groups: nearby control points move together, rigidly, and the number of groups grows (section 2.3).


def planes_of_groups(planes: int, groups: int) -> list[range]:
    """Control-point planes along the plate's axis, cut into groups: the largest is halved until there are enough."""
    parts = [range(planes)]
    while len(parts) < groups:
        i = max(range(len(parts)), key=lambda k: len(parts[k]))
        half = (parts[i].start + parts[i].stop) // 2
        parts[i : i + 1] = [range(parts[i].start, half), range(half, parts[i].stop)]
    return parts


class Groups:
    """Which group each control point belongs to, along the longest axis, and the groups' centres."""

    def __init__(self, grid: Grid, groups: int) -> None:
        self.grid = grid
        axis = int(torch.tensor(grid.shape).argmax())
        plane = ((grid.positions - grid.origin) / grid.spacing).round().long()[:, axis]
        parts = planes_of_groups(grid.shape[axis], groups)
        label = torch.tensor([g for g, part in enumerate(parts) for _ in part])
        self.labels = label[plane]
        self.centers = torch.stack([grid.positions[self.labels == g].mean(0) for g in range(len(parts))])

    def control_points(self, steps: Tensor) -> Tensor:
        """Phi (K, C, 3) of the groups' motions (K, G, 6), mm: phi_c = (R_g - I)(c - c_g) + t_g."""
        turn = rotations(steps[..., :3] / RADIUS) - torch.eye(3, dtype=steps.dtype)
        arm = self.grid.positions - self.centers[self.labels]
        return (turn[:, self.labels] @ arm[..., None])[..., 0] + steps[:, self.labels, 3:]

    def rigid(self, points: Tensor, steps: Tensor) -> Tensor:
        """Points (K, N, 3) turned about the centre of the one group, and shifted, by motions (K, 1, 6)."""
        arm = points - self.centers[0]
        return self.centers[0] + arm @ rotations(steps[:, 0, :3] / RADIUS).mT + steps[:, :, 3:]

    def split_from(self, parent: Groups, steps: Tensor) -> Tensor:
        """Motions (G, 6) that continue those of coarser groups (P, 6): a split changes nothing at first."""
        owner = torch.stack([parent.labels[self.labels == g][0] for g in range(len(self.centers))])
        turn = rotations(steps[owner, :3] / RADIUS) - torch.eye(3, dtype=steps.dtype)
        arm = self.centers - parent.centers[owner]
        return torch.cat([steps[owner, :3], (turn @ arm[..., None])[..., 0] + steps[owner, 3:]], -1)


# The DRR: each node casts its metal onto the detector as a rectangle of path length, mm.


def project(points: Tensor, volume: float, matrices: Tensor, det_shape: tuple[int, int]) -> Tensor:
    """Path lengths (K, V, rows, cols), mm, of candidates' nodes (K, N, 3), each a cube of `volume` mm^3.

    A node's image integrates to its volume times the magnification: at pixel (u, v) of P = [M | m] it has the amplitude
    volume |det M| |M^-1 (u, v, 1)| / depth^2. Its shape is a box as wide as the cube's shadow, averaged over pixels.
    """
    (rows, cols), linear = det_shape, matrices[:, :, :3]
    homogeneous = torch.einsum("vij,knj->kvni", linear, points) + matrices[:, None, :, 3]
    depth = homogeneous[..., 2]
    centre = homogeneous[..., :2] / depth[..., None]  # u, v
    pixel = torch.cat([centre, torch.ones_like(centre[..., :1])], -1)
    ray = torch.einsum("vij,kvnj->kvni", torch.linalg.inv(linear), pixel)
    amplitude = volume * torch.linalg.det(linear).abs()[:, None] * ray.norm(dim=-1) / depth**2
    slope = linear[:, None, :2] - centre[..., None] * linear[:, None, 2:]  # d(u, v)/dx times the depth
    width = volume ** (1 / 3) * slope.norm(dim=-1) / depth[..., None]
    taps = int(width.max().ceil()) + 1
    first = (centre - width / 2 + 0.5).floor().detach()
    pixel = first[..., None] + torch.arange(taps, dtype=points.dtype)  # (K, V, N, 2, taps)
    upper, lower = ((pixel + e - centre[..., None]) / width[..., None] for e in (0.5, -0.5))
    share = upper.clamp(-0.5, 0.5) - lower.clamp(-0.5, 0.5)
    u, v = pixel[..., 0, None, :].long(), pixel[..., 1, :, None].long()
    value = amplitude[..., None, None] * share[..., 1, :, None] * share[..., 0, None, :]
    seen = (u >= 0) & (u < cols) & (v >= 0) & (v < rows)
    index = (v.clamp(0, rows - 1) * cols + u.clamp(0, cols - 1)).flatten(2)
    images = torch.zeros(*index.shape[:2], rows * cols, dtype=points.dtype)
    return images.scatter_add(2, index, (value * seen).flatten(2)).unflatten(2, det_shape)


# Similarity and penalty (eq. 4, 5).


def gradient_correlation(moving: Tensor, fixed: Tensor) -> Tensor:
    """GC (K, V) of rendered images (K, V, rows, cols) and measured ones (V, rows, cols) (eq. 4)."""

    def unit(images: Tensor) -> Tensor:
        gradient = kornia.filters.spatial_gradient(images, mode="sobel").flatten(-2)
        centred = gradient - gradient.mean(-1, keepdim=True)
        return centred / centred.norm(dim=-1, keepdim=True).clamp_min(1e-12)

    return (unit(moving) * unit(fixed[None])).sum(-1).mean(-1)


def diffusion_penalty(phi: Tensor, grid: Grid) -> Tensor:
    """R (K,) of control-point displacements (K, C, 3): mean squared slope, times a cell's volume (eq. 5)."""
    field = phi.unflatten(1, grid.shape)
    squares = [(field.diff(dim=1 + a) / grid.spacing[a]).square().flatten(1).sum(1) for a in range(3)]
    return sum(squares) * grid.spacing.prod() / grid.positions.shape[0]


# The registration: minimise -GC + beta R, first over T_global, then over T_local of ever more groups.


def register(points: Tensor, volume: float, lines: Tensor, matrices: Tensor, args: argparse.Namespace):
    """The function that carries points (N, 3) of the undeformed implant to where the registration finds them."""
    grid = Grid(points)
    weights, whole = grid.weights(points), Groups(grid, 1)
    still = torch.zeros(1, 1, 6, dtype=points.dtype)

    def similarity(turn_and_shift: Tensor, phi: Tensor) -> Tensor:
        moved = whole.rigid(points, turn_and_shift) + weights @ phi  # eq. 1
        return gradient_correlation(project(moved, volume, matrices, lines.shape[1:]), lines).mean(1)

    minimise = by_cma if args.optimizer == "cma" else by_adam
    pose = minimise(lambda steps: -similarity(steps, whole.control_points(still)), still[0], args)
    print(f"T_global: GC {float(similarity(pose[None], whole.control_points(still))):.4f}", flush=True)
    groups, best = whole, still[0]
    for count in args.groups:
        finer = Groups(grid, count)
        groups, best = finer, finer.split_from(groups, best)

        def loss(steps: Tensor, groups: Groups = groups) -> Tensor:
            phi = groups.control_points(steps)
            return -similarity(pose.expand(len(steps), -1, -1), phi) + BETA * diffusion_penalty(phi, grid)

        best = minimise(loss, best, args)
        phi = groups.control_points(best[None])
        print(f"{count:2d} groups: GC {float(similarity(pose[None], phi)):.4f}", flush=True)
    return lambda x: (whole.rigid(x, pose[None]) + grid.weights(x) @ phi)[0]


def by_cma(loss, start: Tensor, args: argparse.Namespace) -> Tensor:
    """CMA-ES with a population of 40 and at most 400 iterations (section 2.3)."""
    options = {"popsize": 40, "maxiter": args.iterations or 400, "tolfun": 1e-6, "verbose": -9, "seed": 1}
    search = cma.CMAEvolutionStrategy(start.flatten().tolist(), 0.5, options)
    while not search.stop():
        candidates = search.ask()
        with torch.no_grad():
            values = loss(torch.tensor(np.array(candidates), dtype=start.dtype).unflatten(1, start.shape))
        search.tell(candidates, values.tolist())
    return torch.tensor(search.result.xbest, dtype=start.dtype).reshape(start.shape)


def by_adam(loss, start: Tensor, args: argparse.Namespace) -> Tensor:
    """Adam with steps of 0.05 mm."""
    steps = torch.nn.Parameter(start.clone())
    optimizer = torch.optim.Adam([steps], lr=0.05)
    for _ in range(args.iterations or 150):
        optimizer.zero_grad()
        loss(steps[None]).sum().backward()
        optimizer.step()
    return steps.detach()


def main() -> None:
    """Register the implant of a folder, and compare with the truth where the folder has it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", type=Path)
    parser.add_argument("--optimizer", choices=("adam", "cma"), default="adam")
    parser.add_argument("--groups", type=int, nargs="+", default=[2, 4, 6, 8, 10])
    parser.add_argument("--pitch", type=float, default=1.0, help="between nodes, mm")
    parser.add_argument("--bin", type=int, default=2, help="pixels averaged along each side")
    parser.add_argument("--iterations", type=int, help="a level; 150 of Adam, 400 of CMA-ES")
    parser.add_argument("--screws", action="store_true", help="add the cylinders of screws.json to the point cloud")
    args = parser.parse_args()
    points = nodes_inside(read_stl(args.case / "implant.stl"), args.pitch)
    if args.screws:
        screws = json.loads((args.case / "screws.json").read_text())["screws"]
        ends = [(np.array(s["from"]), np.array(s["to"]), s["radius"]) for s in screws]
        points = torch.cat([points, *(nodes_of_screw(*screw, args.pitch) for screw in ends)])
    views = json.loads((args.case / "geometry.json").read_text())["views"]
    scan = np.load(args.case / "projections.npz")
    intensity = torch.tensor(scan["intensity"].astype(float))
    lines = -torch.log(intensity.clamp_min(1) / float(scan["open_beam"]))
    lines = torch.nn.functional.avg_pool2d(lines, args.bin)
    matrices = torch.tensor([view["projection_matrix"] for view in views]).double()
    matrices[:, :2] = (matrices[:, :2] + 0.5 * matrices[:, 2:]) / args.bin - 0.5 * matrices[:, 2:]  # of binned pixels
    warp = register(points, args.pitch**3, lines, matrices, args)
    if (args.case / "beads_after.csv").exists():
        files = [args.case / f"beads_{when}.csv" for when in ("before", "after")]
        before, after = (torch.tensor(np.loadtxt(f, delimiter=",", skiprows=1, usecols=(0, 1, 2))) for f in files)
        for name, at in (("start", before), ("registered", warp(before))):
            print(f"beads, {name}: {(at - after).square().sum(-1).mean().sqrt():.3f} mm off (RMS)")


if __name__ == "__main__":
    main()
