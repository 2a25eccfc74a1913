"""Compare `ElasticBody` with quadratic tetrahedra (scikit-fem on a Gmsh mesh) on the ten-hole plate.

    pip install scikit-fem gmsh
    python benchmarks/finite_elements.py        # takes a minute and a half

Both models are loaded by the same forces at the same holes. For each load this prints
* the relative difference of the displacements after rigid alignment,
* the bending or twisting moment that the superelement estimates from the tetrahedra's displacements, compared with the
  applied moment,
* the difference of the von Mises stress more than 3 mm from any hole, relative to the largest stress there.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import gmsh
import numpy as np
import skfem
import torch
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from skfem.helpers import eye, sym_grad, trace
from torch import Tensor

from torchkcreg.geometry import fit_rigid, transform_points
from torchkcreg.implant import ImplantPointCloud, find_holes
from torchkcreg.mechanics import CarriedLoad, ElasticBody, ExpectedLoads, Superelement, holds_of, von_mises
from torchkcreg.mechanics.hexahedra import interpolated
from torchkcreg.mechanics.holds import unit_loads
from torchkcreg.physics import elastic_constants
from torchkcreg.simulation import locking_plate

HOLES = (0, 2, 7, 9)
LOADS = {  # component of the load, its values at the four holes, component of the section load to compare
    "bending out of its plane": (1, (100.0, -100.0, -100.0, 100.0), 3),
    "bending in its plane": (0, (200.0, -200.0, -200.0, 200.0), 4),
    "torsion": (5, (-3000.0, 0.0, 0.0, 3000.0), 5),
}
AWAY_MM = 3.0


def tetrahedra(mesh: trimesh.Trimesh, size: float) -> skfem.MeshTet:
    """Tetrahedral mesh of the inside of a closed surface; `size` is the edge length in mm."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plate.stl"
        mesh.export(path)
        gmsh.merge(str(path))
        gmsh.model.mesh.classifySurfaces(np.radians(40), True, True, np.pi)
        gmsh.model.mesh.createGeometry()
        surfaces = [tag for _, tag in gmsh.model.getEntities(2)]
        gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop(surfaces)])
        gmsh.model.geo.synchronize()
        for option in ("MeshSizeMin", "MeshSizeMax"):
            gmsh.option.setNumber(f"Mesh.{option}", size)
        gmsh.model.mesh.generate(3)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        _, nodes = gmsh.model.mesh.getElementsByType(4)
    gmsh.finalize()
    number = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    number[tags] = np.arange(len(tags))
    cells = number[nodes].reshape(-1, 4)
    used, inverse = np.unique(cells, return_inverse=True)
    return skfem.MeshTet(coordinates.reshape(-1, 3)[used].T, inverse.reshape(-1, 4).T)


class Tetrahedra:
    """A free elastic body meshed with quadratic tetrahedra."""

    def __init__(self, mesh: skfem.MeshTet, lame: tuple[float, float]) -> None:
        self.mesh, self.lame = mesh, lame
        self.basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()))
        lam, mu = lame

        @skfem.BilinearForm
        def stiffness(u, v, w):
            e = sym_grad(u)
            stress = lam * eye(trace(e), 3) + 2 * mu * e
            return np.einsum("ij...,ij...", stress, sym_grad(v))

        self.matrix = stiffness.assemble(self.basis).tocsc()

    def solved(self, points: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Solution under balanced forces (P, 3) at points (P, 3). Three vertices are pinned against rigid motion."""
        load_vector = self.values(points).T @ forces.T.ravel()
        low, high = (self.mesh.p[2].argmin(), self.mesh.p[2].argmax())
        side = np.abs(self.mesh.p[0] - self.mesh.p[0].max()).argmin()
        dofs = self.basis.nodal_dofs
        pinned = np.concatenate([dofs[:, low], dofs[:2, high], dofs[1:2, side]])
        return skfem.solve(*skfem.condense(self.matrix, load_vector, D=pinned), solver=lambda a, b: spsolve(a, b))

    def values(self, points: np.ndarray):
        """Matrix from the degrees of freedom to displacements (3 P,) at points, one component after the other.

        A point outside the mesh uses its nearest tetrahedron.
        """
        cells, number = self._cells(points), len(points)
        local = self.basis.mapping.invF(points.T[:, :, None], tind=cells)
        rows, cols, entries = [], [], []
        for k in range(self.basis.Nbfun):
            shape = np.asarray(self.basis.elem.gbasis(self.basis.mapping, local, k, tind=cells)[0])[..., 0]  # (3, P)
            rows.append(np.arange(3 * number))
            cols.append(np.tile(self.basis.element_dofs[k, cells], 3))
            entries.append(shape.ravel())
        place = np.concatenate(rows), np.concatenate(cols)
        return coo_array((np.concatenate(entries), place), shape=(3 * number, self.basis.N)).tocsr()

    def _cells(self, points: np.ndarray) -> np.ndarray:
        corners = self.mesh.p[:, self.mesh.t].transpose(2, 1, 0)  # (E, 4, 3)
        _, near = cKDTree(corners.mean(1)).query(points, k=24)
        edges = corners[:, 1:] - corners[:, :1]
        inverse = np.linalg.inv(edges)
        shares = np.einsum("pki,pkij->pkj", points[:, None] - corners[near, 0], inverse[near])
        least = np.minimum(shares.min(-1), 1 - shares.sum(-1))
        return near[np.arange(len(points)), least.argmax(1)]

    def displacement(self, points: np.ndarray, solution: np.ndarray) -> Tensor:
        """Displacements (P, 3) at points (P, 3)."""
        return torch.from_numpy((self.values(points) @ solution).reshape(3, -1).T.copy())

    def stress(self, solution: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres (E, 3) of the tetrahedra and the stresses (E, 3, 3) there."""
        middle = (np.full((3, 1), 0.25), np.ones(1))
        basis = skfem.Basis(self.mesh, self.basis.elem, quadrature=middle)
        gradient = basis.interpolate(solution).grad[..., 0]  # (3, 3, E)
        strain = 0.5 * (gradient + gradient.transpose(1, 0, 2))
        lam, mu = self.lame
        whole = lam * np.einsum("iie->e", strain) * np.eye(3)[..., None] + 2 * mu * strain
        return self.mesh.p[:, self.mesh.t].mean(1).T, whole.transpose(2, 0, 1)


def aligned(points: Tensor, moved: Tensor) -> Tensor:
    """Displacements (P, 3) without their rigid part."""
    small = 1e-3  # small enough for rotations to be linear
    changed = points + small * moved
    return (transform_points(torch.linalg.inv(fit_rigid(points, changed)), changed) - points) / small


def main() -> None:
    """Run the comparison and print its results."""
    plate, constants = locking_plate(), elastic_constants("steel")
    holes = find_holes(plate)
    start = time.perf_counter()
    fine = Tetrahedra(tetrahedra(plate, 1.5), constants.lame)
    print(f"{fine.mesh.nelements} tetrahedra, {fine.basis.N} degrees of freedom, {time.perf_counter() - start:.0f} s")
    cloud = ImplantPointCloud.from_mesh(plate, 0.25)
    holds = holds_of(cloud, holes)
    start = time.perf_counter()
    body = ElasticBody(cloud, constants)
    element = Superelement.of(cloud, constants, holds, negligible_mm=0.0)
    print(
        f"hexahedra: {body.hexahedra.num_nodes * 3} degrees of freedom, {time.perf_counter() - start:.1f} s (2 bodies)"
    )
    load_points, forces = unit_loads(cloud, holds)
    inside = cloud.coarsened(4).points.double()
    for name, (component, values, moment) in LOADS.items():
        chosen = [6 * hole + component for hole in HOLES]
        points = [load_points[c] for c in chosen]
        pushed = [v * forces[c] for v, c in zip(values, chosen, strict=True)]
        nodal = sum(body.response([p], [f]) for p, f in zip(points, pushed, strict=True))
        start = time.perf_counter()
        solution = fine.solved(torch.cat(points).numpy(), torch.cat(pushed).numpy())
        seconds = time.perf_counter() - start
        displacements = body.displacement(inside, nodal)[0], fine.displacement(inside.numpy(), solution)
        hexahedral, tetrahedral = (aligned(inside, u) for u in displacements)
        difference = float((hexahedral - tetrahedral).norm() / tetrahedral.norm())
        read = _read(element, inside, tetrahedral)
        middle = float(read.section_loads[len(read.heights) // 2, moment])
        true = values[-1] if component == 5 else values[0] * float(read.hold_heights[0] - read.hold_heights[HOLES[1]])
        places, stress = fine.stress(solution)
        far = _far_from_holes(places, holes)
        tetrahedra_stress = von_mises(torch.from_numpy(stress[far]))
        body_stress = von_mises(body.stress(torch.from_numpy(places[far]), nodal)[0])
        stress_error = (body_stress - tetrahedra_stress).abs() / tetrahedra_stress.max()
        print(
            f"{name}: displacement {difference:.2%}; estimated moment {middle:.0f} of {true:.0f} N mm "
            f"({abs(middle) / abs(true) - 1:+.2%}); stress 99 % within {float(stress_error.quantile(0.99)):.1%}, "
            f"largest {float(stress_error.max()):.1%}, of {float(tetrahedra_stress.max()):.0f} N/mm^2 ({seconds:.0f} s)"
        )


def _read(element: Superelement, points: Tensor, moved: Tensor) -> CarriedLoad:
    """Load that the superelement estimates from displacements (P, 3) of points; only `HOLES` carry load."""
    shares = torch.full((len(element.holds),), 1e-3, dtype=torch.float64)
    shares[list(HOLES)] = 1.0
    expected = ExpectedLoads.of(element, shares)
    flat = torch.stack([aligned(points, w) for w in _ways(element, points)]).flatten(1)
    noise = (1e-4) ** 2 * len(points)  # a tenth of a micrometre
    amounts = torch.linalg.solve(flat @ flat.T / noise + expected.precision, flat @ moved.flatten() / noise)
    return CarriedLoad.of(element, amounts, expected=expected)


def _ways(element: Superelement, points: Tensor) -> Tensor:
    return interpolated(element.hexahedra, element.nodal, *element.hexahedra.locate(points))


def _far_from_holes(places: np.ndarray, holes) -> np.ndarray:
    far = np.ones(len(places), dtype=bool)
    for hole in holes:
        away = places - hole.center
        across = np.linalg.norm(away - (away @ hole.axis)[:, None] * hole.axis, axis=1)
        far &= across > hole.radius + AWAY_MM
    return far


if __name__ == "__main__":
    main()
