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
_ELSEWHERE = 0.05  # of the implant's size: farther off on average, a reference stands in another frame


@dataclass(frozen=True, eq=False)
class ShapeEvaluation:
    """Errors of an estimated implant against a reference, all lengths in mm.

    Attributes:
        reference: "mesh", "volume" or "surface": what the reference is, the last two as point clouds.
        nodes_before: from each node of the estimate to the nearest one of the reference; None for a cloud that covers
            the surface only. Before the alignment there is nothing where the reference stands in another frame.
        nodes_after: the same after the alignment.
        node_floor: mean and RMS distance of the nodes of two perfect lattices; None where the nodes are.
        surface_before: from the estimate's surface to that of the reference; with a surface scan, from its points to
            the estimate's surface; None for a cloud of nodes, which has no surface.
        surface_after: the same after the alignment.
        alignment: rigid motion (4, 4) that lays the reference onto the estimate.
        shift_mm: how far that moves the reference's centre.
        angle_deg: by how much it turns it.
        points: where the errors are (n, 3), on the estimate in the world.
        errors: distances (n,) after the alignment: from the surface, or from the nearest node where there is none.
        errors_before: the same before it, at the same points, where they are known.
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
        """The evaluation as plain data, without the single errors; what there is not is left out."""
        names = ("nodes_before", "nodes_after", "surface_before", "surface_after")
        statistics = {name: asdict(value) for name in names if (value := getattr(self, name)) is not None}
        floor = {} if self.node_floor is None else {"node_floor_mm": dict(zip(("mean", "rms"), self.node_floor))}
        motion = {"alignment": self.alignment.tolist(), "shift_mm": self.shift_mm, "angle_deg": self.angle_deg}
        return {"reference": self.reference, **statistics, **floor, **motion}

    def __str__(self) -> str:
        lines = [f"{'error in mm':34s} {'mean':>7s} {'RMSE':>7s} {'largest':>8s} {'FWHM':>7s}"]
        for name, what in (("surface", "node to surface"), ("nodes", "node to nearest node")):
            for when in ("before", "after"):
                found: DistanceStatistics | None = getattr(self, f"{name}_{when}")
                if found is not None:
                    lines.append(
                        f"{f'{what}, {when} CPD':34s} {found.mean_mm:7.3f} {found.rmse_mm:7.3f} "
                        f"{found.max_mm:8.3f} {found.fwhm_mm:7.3f}"
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
    by registration. RMSEs were computed between the closest nodes" (section 2.4). CPD works on some hundred points of
    each cloud; point-to-plane least squares on the surface goes on from there. Before the alignment the
    errors are those of pose and shape, after it those of shape alone. Distances between nodes have a floor that half
    a pitch sets, `nearest_node_floor`; distances to the surface have none.

    Args:
        estimate: the deformed implant's surface in the world, mm.
        nodes: the deformed implant's nodes (N, 3).
        reference: the true surface, or points (M, 3): nodes of a volume, as the paper has, or a scan of the surface.
        pitch_mm: of the nodes that a reference surface is filled with.
        reference_kind: what points are, "volume" or "surface"; found out by `fills_volume` when None.

    Raises:
        ValueError: a cloud or a mesh is empty or not finite, or the reference is so much larger or smaller that it
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
    where, errors = after.surface or after.nodes or (nodes, nodes[:, 0])  # there is one or the other
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
        points=where,
        errors=errors,
        errors_before=earlier[1] if earlier else None,
    )


@dataclass(frozen=True, eq=False)
class _Reference:
    """A true shape: its kind, its points, those of them that outline it, and its surface where that is known."""

    kind: str
    points: Tensor
    outline: Tensor
    mesh: trimesh.Trimesh | None = None


@dataclass(frozen=True, eq=False)
class _Errors:
    """Points of the estimate or near it, and their distances, for each measure."""

    nodes: tuple[Tensor, Tensor] | None
    surface: tuple[Tensor, Tensor] | None

    def statistics(self, measure: str) -> DistanceStatistics | None:
        found: tuple[Tensor, Tensor] | None = getattr(self, measure)
        return None if found is None else distance_statistics(found[1])


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
    """Nodes (M, 3) of a surface on a lattice that is parallel to nothing.

    The estimate's nodes come from a lattice too. Were both parallel, nodes of a shifted shape could coincide.
    """
    turn = rigid_matrix(torch.tensor(_LATTICE_TURN, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    turned = mesh.copy()
    turned.apply_transform(turn.numpy())
    return transform_points(turn.mT, ImplantPointCloud.from_mesh(turned, pitch_mm, dtype=torch.float64).points)


def _check_size(nodes: Tensor, points: Tensor) -> None:
    own, other = (float((p.amax(0) - p.amin(0)).norm()) for p in (nodes, points))
    if not own / _WRONG_UNIT < other < own * _WRONG_UNIT:
        raise ValueError(
            f"the reference is {other:.4g} mm from corner to corner and the implant {own:.4g} mm: "
            "both must be in mm (is the reference in metres?)"
        )
    if not own / _SAME_SIZE < other < own * _SAME_SIZE:
        warnings.warn(
            f"the reference is {other:.4g} mm from corner to corner and the implant {own:.4g} mm: "
            "are they the same part, and all of it?",
            stacklevel=4,
        )


def _surface_samples(mesh: trimesh.Trimesh) -> Tensor:
    points, _ = trimesh.sample.sample_surface(mesh, _SURFACE_SAMPLES, seed=0)
    return torch.tensor(points, dtype=torch.float64)


def _start(points: Tensor, fixed: Tensor) -> Tensor:
    """Where to start aligning the reference's points: as they are, or by principal axes if they are elsewhere."""
    given = torch.eye(4, dtype=torch.float64)
    points, target = thinned(points, 2000), thinned(fixed, 20_000)
    size = float((fixed.amax(0) - fixed.amin(0)).norm())

    def misfit(motion: Tensor) -> float:
        return float(nearest_node_distances(transform_points(motion, points), target).square().mean().sqrt())

    if misfit(given) < _ELSEWHERE * size:
        return given
    warnings.warn(
        "the reference stands in another frame than the implant: there are no errors before the alignment, and that "
        "starts from the principal axes (which may turn a symmetric implant round)",
        stacklevel=3,
    )
    return min(principal_motions(points, target), key=misfit)


def _alignment(true: _Reference, fixed: Tensor, estimate: trimesh.Trimesh, start: Tensor) -> Tensor:
    """The rigid motion (4, 4) that lays the reference onto the estimate."""
    drift = rigid_coherent_point_drift(transform_points(start, true.points), fixed) @ start
    outline = transform_points(drift, true.outline)
    return align_to_surface(outline, estimate, inset=true.kind == "volume") @ drift


def _errors(true: _Reference, estimate: trimesh.Trimesh, nodes: Tensor, alignment: Tensor) -> _Errors:
    """Errors with the reference moved by ``alignment``."""
    if true.kind == "surface":
        moved = transform_points(alignment, thinned(true.points, _SURFACE_SAMPLES))
        return _Errors(None, (moved, surface_distances(moved, estimate)))
    back = invert_rigid(alignment)
    some = thinned(nodes, _NODES)
    to_nodes = some, nearest_node_distances(transform_points(back, some), true.points)
    if true.mesh is None:
        return _Errors(to_nodes, None)
    samples = _surface_samples(estimate)
    return _Errors(to_nodes, (samples, surface_distances(transform_points(back, samples), true.mesh)))
