"""Shape errors: an estimated implant against a reference of its true shape, before and after rigid alignment."""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict, dataclass
from typing import Literal

import torch
import trimesh
from torch import Tensor

from torchkcreg.geometry import invert_rigid, rigid_matrix, transform_points, vector_from_rotation
from torchkcreg.implant import ImplantPointCloud

from .alignment import align_to_surface, principal_motions, rigid_coherent_point_drift, thinned
from .distances import (
    fills_volume,
    finite_cloud,
    nearest_node_distances,
    nearest_node_floor,
    node_spacing,
    outermost_nodes,
    surface_distances,
)
from .statistics import DistanceStatistics, distance_statistics

ReferenceKind = Literal["volume", "surface"]
_NODES, _SURFACE_SAMPLES = 50_000, 10_000
_LATTICE_TURN = (0.41, -0.73, 0.57)
_WRONG_UNIT = 50.0
_SAME_SIZE = 1.25
_ELSEWHERE = 0.05  # of the implant's size: with a larger RMS distance, a reference is in another frame


@dataclass(frozen=True, eq=False)
class ShapeEvaluation:
    """Errors of an estimated implant against a reference, all lengths in mm.

    Attributes:
        reference: Kind of the reference: "mesh", "volume" or "surface". The last two are point clouds.
        nodes_before: Distances from each node of the estimate to the nearest node of the reference, before alignment;
            None for a surface scan. All values before the alignment are None if the reference is in another frame.
        nodes_after: The same after the alignment.
        node_floor: Mean and RMS distance between the nodes of two perfect lattices; None if `nodes_after` is None.
        surface_before: Distances from the estimate's surface to that of the reference before the alignment. With a
            surface scan, distances from its points to the estimate's surface. None for a cloud of nodes.
        surface_after: The same after the alignment.
        alignment: Rigid motion (4, 4) from the reference to the estimate.
        shift_mm: Displacement of the reference's centroid by the alignment.
        angle_deg: Rotation angle of the alignment.
        points: Points (n, 3) of the errors, on the estimate in the world.
        errors: Distances (n,) after the alignment, from the surface or, without a surface, from the nearest node.
        errors_before: The same at the same points before the alignment, if known.
    """

    reference: str
    nodes_before: DistanceStatistics | None
    nodes_after: DistanceStatistics | None
    node_floor: tuple[float, float] | None
    surface_before: DistanceStatistics | None
    surface_after: DistanceStatistics | None
    alignment: Tensor
    shift_mm: float
    angle_deg: float
    points: Tensor
    errors: Tensor
    errors_before: Tensor | None

    def to_dict(self) -> dict[str, object]:
        """The evaluation as plain data, without the errors of single points and without values that are None."""
        names = ("nodes_before", "nodes_after", "surface_before", "surface_after")
        statistics = {name: asdict(value) for name in names if (value := getattr(self, name)) is not None}
        floor = {} if self.node_floor is None else {"node_floor_mm": dict(zip(("mean", "rms"), self.node_floor))}
        motion = {"alignment": self.alignment.tolist(), "shift_mm": self.shift_mm, "angle_deg": self.angle_deg}
        return {"reference": self.reference, **statistics, **floor, **motion}

    def __str__(self) -> str:
        lines = [f"{'error in mm':34s} {'mean':>7s} {'RMSE':>7s} {'largest':>8s} {'FWHM':>7s}"]
        for name, measure in (("surface", "node to surface"), ("nodes", "node to nearest node")):
            for when in ("before", "after"):
                statistics: DistanceStatistics | None = getattr(self, f"{name}_{when}")
                if statistics is not None:
                    lines.append(
                        f"{f'{measure}, {when} CPD':34s} {statistics.mean_mm:7.3f} {statistics.rmse_mm:7.3f} "
                        f"{statistics.max_mm:8.3f} {statistics.fwhm_mm:7.3f}"
                    )
        if self.node_floor is not None:
            lines.append(f"{'floor between perfect lattices':34s} {self.node_floor[0]:7.3f} {self.node_floor[1]:7.3f}")
        lines.append(f"the alignment moved the reference by {self.shift_mm:.3f} mm and {self.angle_deg:.3f} degrees")
        return "\n".join(lines)


def evaluate_shape(
    estimate: trimesh.Trimesh,
    nodes: Tensor,
    reference: trimesh.Trimesh | Tensor,
    *,
    pitch_mm: float = 0.25,
    reference_kind: ReferenceKind | None = None,
) -> ShapeEvaluation:
    """Errors of an estimated, deformed implant against its true shape (fig. 4B of Cao et al. 2020).

    "The rigid coherent point drift (CPD) algorithm was applied to map the reference point cloud onto the one estimated
    by registration. RMSEs were computed between the closest nodes" (section 2.4). CPD uses some hundred points of
    each cloud; point-to-plane least squares on the surface refines the result. Errors before the alignment include pose
    and shape, errors after it shape alone. Distances between nodes have a floor of about half a pitch, see
    `nearest_node_floor`; distances to the surface have none.

    Args:
        estimate: The deformed implant's surface in the world, mm.
        nodes: The deformed implant's nodes (N, 3) in the world, mm.
        reference: The true surface, or points (M, 3): nodes of a volume, as in the paper, or a scan of the surface.
        pitch_mm: Pitch of the nodes that fill a reference surface.
        reference_kind: Kind of reference points, "volume" or "surface"; decided by `fills_volume` if None.

    Raises:
        ValueError: A cloud or a mesh is empty or not finite, or the reference is so much larger or smaller that it
            cannot be in mm.
    """
    nodes = finite_cloud(nodes, "nodes")
    true = _reference(reference, pitch_mm, reference_kind, nodes)
    fixed = _surface_samples(estimate) if true.kind == "surface" else nodes
    start = _start(true.points, fixed)
    alignment = _alignment(true, fixed, estimate, start)
    centre = true.points.mean(0)
    elsewhere = not torch.equal(start, torch.eye(4, dtype=torch.float64))
    before = _Errors(None, None) if elsewhere else _errors(true, estimate, nodes, start)
    after = _errors(true, estimate, nodes, alignment)
    error_points, errors = after.surface or after.nodes or (nodes, nodes[:, 0])  # at least one of them is there
    earlier = before.surface or before.nodes
    return ShapeEvaluation(
        reference=true.kind,
        nodes_before=before.statistics("nodes"),
        nodes_after=after.statistics("nodes"),
        node_floor=nearest_node_floor(node_spacing(true.points) if true.mesh is None else pitch_mm)
        if after.nodes
        else None,
        surface_before=before.statistics("surface"),
        surface_after=after.statistics("surface"),
        alignment=alignment,
        shift_mm=float((transform_points(alignment, centre[None]) - centre).norm()),
        angle_deg=math.degrees(float(vector_from_rotation(alignment[:3, :3]).norm())),
        points=error_points,
        errors=errors,
        errors_before=earlier[1] if earlier else None,
    )


@dataclass(frozen=True, eq=False)
class _Reference:
    """A true shape: its kind, its points, points of its outline, and its surface if known."""

    kind: str
    points: Tensor
    outline: Tensor
    mesh: trimesh.Trimesh | None = None


@dataclass(frozen=True, eq=False)
class _Errors:
    """Points on or near the estimate and their distances, for each measure."""

    nodes: tuple[Tensor, Tensor] | None
    surface: tuple[Tensor, Tensor] | None

    def statistics(self, measure: str) -> DistanceStatistics | None:
        errors: tuple[Tensor, Tensor] | None = getattr(self, measure)
        return None if errors is None else distance_statistics(errors[1])


def _reference(
    reference: trimesh.Trimesh | Tensor, pitch_mm: float, kind: ReferenceKind | None, nodes: Tensor
) -> _Reference:
    if isinstance(reference, trimesh.Trimesh):
        _check_size(nodes, finite_cloud(torch.tensor(reference.vertices), "reference"))
        points = _turned_lattice(reference, pitch_mm)
        return _Reference("mesh", points, _surface_samples(reference), reference)
    points = finite_cloud(reference, "reference")
    _check_size(nodes, points)
    kind = kind or ("volume" if fills_volume(points) else "surface")
    return _Reference(kind, points, outermost_nodes(points) if kind == "volume" else points)


def _turned_lattice(mesh: trimesh.Trimesh, pitch_mm: float) -> Tensor:
    """Nodes (M, 3) that fill a surface, on an obliquely turned lattice.

    The estimate's nodes are on a lattice too. If both were parallel, nodes of a shifted shape could coincide.
    """
    turn = rigid_matrix(torch.tensor(_LATTICE_TURN, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    turned = mesh.copy()
    turned.apply_transform(turn.numpy())
    return transform_points(turn.mT, ImplantPointCloud.from_mesh(turned, pitch_mm, dtype=torch.float64).points)


def _check_size(nodes: Tensor, points: Tensor) -> None:
    implant_size, reference_size = (float((p.amax(0) - p.amin(0)).norm()) for p in (nodes, points))
    if not implant_size / _WRONG_UNIT < reference_size < implant_size * _WRONG_UNIT:
        raise ValueError(
            f"the reference is {reference_size:.4g} mm from corner to corner and the implant {implant_size:.4g} mm: "
            "both must be in mm (is the reference in metres?)"
        )
    if not implant_size / _SAME_SIZE < reference_size < implant_size * _SAME_SIZE:
        warnings.warn(
            f"the reference is {reference_size:.4g} mm from corner to corner and the implant {implant_size:.4g} mm: "
            "are they the same part, and all of it?",
            stacklevel=4,
        )


def _surface_samples(mesh: trimesh.Trimesh) -> Tensor:
    points, _ = trimesh.sample.sample_surface(mesh, _SURFACE_SAMPLES, seed=0)
    return torch.tensor(points, dtype=torch.float64)


def _start(points: Tensor, fixed: Tensor) -> Tensor:
    """Start (4, 4) of the alignment: identity, or alignment of the principal axes if the reference is elsewhere."""
    given = torch.eye(4, dtype=torch.float64)
    points, target = thinned(points, 2000), thinned(fixed, 20_000)
    size = float((fixed.amax(0) - fixed.amin(0)).norm())

    def misfit(motion: Tensor) -> float:
        return float(nearest_node_distances(transform_points(motion, points), target).square().mean().sqrt())

    if misfit(given) < _ELSEWHERE * size:
        return given
    warnings.warn(
        "the reference is in another frame than the implant: no errors before the alignment are given, and the "
        "alignment starts from the principal axes (a symmetric implant may be turned round)",
        stacklevel=3,
    )
    return min(principal_motions(points, target), key=misfit)


def _alignment(true: _Reference, fixed: Tensor, estimate: trimesh.Trimesh, start: Tensor) -> Tensor:
    """Rigid motion (4, 4) from the reference to the estimate."""
    drift = rigid_coherent_point_drift(transform_points(start, true.points), fixed) @ start
    outline = transform_points(drift, true.outline)
    return align_to_surface(outline, estimate, inset=true.kind == "volume") @ drift


def _errors(true: _Reference, estimate: trimesh.Trimesh, nodes: Tensor, alignment: Tensor) -> _Errors:
    """Errors after the reference is moved by `alignment`."""
    if true.kind == "surface":
        moved = transform_points(alignment, thinned(true.points, _SURFACE_SAMPLES))
        return _Errors(None, (moved, surface_distances(moved, estimate)))
    back = invert_rigid(alignment)
    sample = thinned(nodes, _NODES)
    to_nodes = sample, nearest_node_distances(transform_points(back, sample), true.points)
    if true.mesh is None:
        return _Errors(to_nodes, None)
    samples = _surface_samples(estimate)
    return _Errors(to_nodes, (samples, surface_distances(transform_points(back, samples), true.mesh)))
