"""An implant as an elastic body: beam theory, balance, and what turning it must not change."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import ElasticBody, Hexahedra, edge_for, num_shells, stiffness_matrix, von_mises
from torchkcreg.mechanics.bodies import body_volumes
from torchkcreg.physics import elastic_constants

STEEL = elastic_constants("steel")
E, G = STEEL.youngs_modulus, STEEL.lame[1]
WIDE, THICK, LONG = 10.0, 4.0, 120.0
HELD = 8.0  # of each end


class Bar:
    """A bar of 10 x 4 x 120 mm, turned somehow, and loads on its ends in its own axes."""

    def __init__(self, degrees: float, pitch: float = 0.25) -> None:
        turn = trimesh.transformations.rotation_matrix(math.radians(degrees), [1.0, 0.5, 0.2])
        mesh = trimesh.creation.box((WIDE, THICK, LONG)).apply_transform(turn)
        self.turn = torch.from_numpy(turn[:3, :3].copy())
        self.cloud = ImplantPointCloud.from_mesh(mesh, pitch)
        self.body = ElasticBody(self.cloud, STEEL)
        self.points = self.cloud.points.double()
        self.local = self.points @ self.turn

    def load(self, kind: str, axis: int) -> tuple[torch.Tensor, torch.Tensor]:
        """A force of 1 N along, or a moment of 1 N mm about, an axis on the upper end, and the opposite below."""
        where, forces = [], []
        for side in (-1.0, 1.0):
            end = side * self.local[:, 2] > LONG / 2 - HELD
            place, volume = self.local[end], self.cloud.volumes.double()[end]
            arm = place - (volume[:, None] * place).sum(0) / volume.sum()
            along = torch.eye(3, dtype=torch.float64)[axis].expand_as(place)
            force = (along if kind == "force" else torch.linalg.cross(along, arm)) * volume[:, None]
            whole = force.sum(0)[axis] if kind == "force" else torch.linalg.cross(arm, force).sum(0)[axis]
            where.append(self.points[end])
            forces.append(side * force / whole @ self.turn.T)
        return torch.cat(where), torch.cat(forces)

    def bent(self, kind: str, axis: int) -> torch.Tensor:
        """Displacements of the nodes in the bar's axes."""
        where, forces = self.load(kind, axis)
        return self.body.displacement(self.points, self.body.response([where], [forces]))[0] @ self.turn

    def rate(self, displacement: torch.Tensor, component: int, of: int) -> float:
        """By how much a component's slope along x, y (0, 1), or its mean (3), rises for a mm along the bar."""
        found = []
        for height in (-25.0, 25.0):
            near = (self.local[:, 2] - height).abs() < 4
            x, y, z = self.local[near].T.numpy()
            columns = np.stack([x, y, z - height, np.ones_like(x)], axis=-1)
            found.append(np.linalg.lstsq(columns, displacement[near][:, component].numpy(), rcond=None)[0][of])
        return abs(found[1] - found[0]) / 50


@pytest.fixture(scope="module", params=[0.0, 7.5])
def bar(request) -> Bar:
    return Bar(request.param)


def torsion_constant(wide: float, thick: float) -> float:
    """Of a rectangle, mm^4 (Saint-Venant)."""
    series = sum(math.tanh(n * math.pi * wide / 2 / thick) / n**5 for n in (1, 3, 5, 7))
    return wide * thick**3 / 3 * (1 - 192 * thick / (math.pi**5 * wide) * series)


def shear_of_torsion(x: float, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Across the width and through the thickness, N/mm^2, at a place of a section twisted by 1 N mm (Saint-Venant)."""
    across, through = torch.zeros_like(y), torch.zeros_like(y)
    for n in range(1, 60, 2):
        k, sign = n * math.pi / THICK, (-1) ** ((n - 1) // 2)
        inside, edge = math.cosh(k * x) / math.cosh(k * WIDE / 2), math.sinh(k * x) / math.cosh(k * WIDE / 2)
        across -= sign / n**2 * (1 - inside) * torch.sin(k * y)
        through += sign / n**2 * edge * torch.cos(k * y)
    scale = 8 * THICK / math.pi**2 / torsion_constant(WIDE, THICK)
    return scale * across, scale * through


def test_a_bar_bends_twists_and_stretches_as_beam_theory_says(bar: Bar) -> None:
    flat, edge = WIDE * THICK**3 / 12, THICK * WIDE**3 / 12
    assert bar.rate(bar.bent("moment", 0), 1, 2) * E * flat == pytest.approx(1.0, rel=0.01)
    assert bar.rate(bar.bent("moment", 1), 0, 2) * E * edge == pytest.approx(1.0, rel=0.01)
    assert bar.rate(bar.bent("moment", 2), 1, 0) * G * torsion_constant(WIDE, THICK) == pytest.approx(1.0, rel=0.01)
    assert bar.rate(bar.bent("force", 2), 2, 3) * E * WIDE * THICK == pytest.approx(1.0, rel=0.01)


def test_stresses_are_those_of_beam_theory(bar: Bar) -> None:
    nodal = bar.body.response(*([part] for part in bar.load("moment", 0)))
    middle = bar.points[bar.local[:, 2].abs() < 20]
    stress = bar.turn.T @ bar.body.stress(middle, nodal)[0] @ bar.turn
    expected = (middle @ bar.turn)[:, 1] / (WIDE * THICK**3 / 12)
    largest = float(expected.abs().max())
    sign = torch.sign((stress[:, 2, 2] * expected).sum())
    torch.testing.assert_close(sign * stress[:, 2, 2], expected, atol=0.07 * largest, rtol=0)
    torch.testing.assert_close(von_mises(stress), expected.abs(), atol=0.07 * largest, rtol=0)


def test_shear_of_a_twisted_bar_is_that_of_saint_venant(bar: Bar) -> None:
    nodal = bar.body.response(*([part] for part in bar.load("moment", 2)))
    y = torch.linspace(-THICK / 2, THICK / 2, 9, dtype=torch.float64)
    for x, bound in ((0.0, 0.02), (WIDE / 4, 0.03), (WIDE / 2, 0.15)):
        places = torch.stack([torch.full_like(y, x), y, torch.zeros_like(y)], dim=-1) @ bar.turn.T
        stress = bar.turn.T @ bar.body.stress(places, nodal)[0] @ bar.turn
        across, through = shear_of_torsion(x, y)
        sign = torch.sign((stress[:, 0, 2] * across + stress[:, 1, 2] * through).sum())
        largest = float(shear_of_torsion(0.0, y)[0].abs().max())
        for found, expected in ((stress[:, 0, 2], across), (stress[:, 1, 2], through)):
            torch.testing.assert_close(sign * found, expected, atol=bound * largest, rtol=0)


def test_the_body_does_not_move_as_a_whole_and_loads_left_over_are_carried_evenly(bar: Bar) -> None:
    share = bar.cloud.volumes.double()[:, None] / bar.cloud.volume
    for kind, axis in (("moment", 0), ("force", 2)):
        moved = bar.bent(kind, axis)
        size = float(moved.norm(dim=-1).max())
        assert float((share * moved).sum(0).norm()) < 0.01 * size
    end = bar.local[:, 2] > LONG / 2 - HELD
    alone = torch.zeros_like(bar.points[end])
    alone[:, 0] = 1.0
    assert bool(bar.body.response([bar.points[end]], [alone]).isfinite().all())


def test_the_response_is_reciprocal(bar: Bar) -> None:
    (one, first), (two, second) = bar.load("moment", 0), bar.load("force", 2)
    third = second.roll(1, -1)
    nodal = bar.body.response([one, two], [first, third])
    there = float((bar.body.displacement(two, nodal)[0] * third).sum())
    back = float((bar.body.displacement(one, nodal)[1] * first).sum())
    assert there == pytest.approx(back, rel=1e-4, abs=1e-12)


def test_the_stiffness_is_symmetric_and_lets_rigid_motions_pass() -> None:
    cloud = ImplantPointCloud.from_mesh(trimesh.creation.box((6.0, 3.0, 20.0)), 0.25)
    cubes = Hexahedra.around(cloud, edge_for(cloud))
    stiffness = stiffness_matrix(cubes, cloud, STEEL)
    assert abs(stiffness - stiffness.T).max() < 1e-9 * abs(stiffness).max()
    turn = torch.linalg.cross(torch.tensor([[0.3, -0.2, 0.9]]).double().expand_as(cubes.positions), cubes.positions)
    assert np.abs(stiffness @ (turn + 1.0).numpy().ravel()).max() < 1e-8 * abs(stiffness).max()


def test_displacements_go_on_beside_the_implant(bar: Bar) -> None:
    where, forces = bar.load("moment", 0)
    nodal = bar.body.response([where], [forces])
    on, beside = torch.tensor([[0.0, 0.0, 30.0]]).double(), torch.tensor([[0.0, 2.5, 30.0]]).double()
    ours, theirs = (bar.body.displacement(p @ bar.turn.T, nodal)[0] @ bar.turn for p in (on, beside))
    assert float((ours - theirs)[0, 1].abs()) < 0.02 * float(ours.norm())


def test_constants_are_known_of_alloys_alone() -> None:
    with pytest.raises(ValueError, match=r"elastic constants are available for .*steel.*, not for water"):
        elastic_constants("water")
    assert elastic_constants("316L") == STEEL


@pytest.mark.parametrize(
    ("wide", "thick", "pitch", "degrees"),
    [
        (13.5, 4.6, 0.25, 0.0),
        (13.5, 4.6, 0.25, 7.5),
        (11.0, 3.3, 0.25, 0.0),
        (11.0, 3.3, 0.5, 0.0),
        (6.0, 1.5, 0.25, 0.0),
    ],
)
def test_plates_that_the_cubes_do_not_tile_bend_as_beam_theory_says(monkeypatch, wide, thick, pitch, degrees) -> None:
    for name, value in (("WIDE", wide), ("THICK", thick)):
        monkeypatch.setitem(globals(), name, value)
    bar = Bar(degrees, pitch)
    assert bar.rate(bar.bent("moment", 0), 1, 2) * E * wide * thick**3 / 12 == pytest.approx(1.0, abs=0.001)
    assert bar.rate(bar.bent("moment", 1), 0, 2) * E * thick * wide**3 / 12 == pytest.approx(1.0, abs=0.001)
    assert bar.rate(bar.bent("force", 2), 2, 3) * E * wide * thick == pytest.approx(1.0, abs=0.001)
    middle = bar.points[bar.local[:, 2].abs() < 20]
    nodal = bar.body.response(*([part] for part in bar.load("force", 2)))
    tension = (bar.turn.T @ bar.body.stress(middle, nodal)[0] @ bar.turn)[:, 2, 2].abs() * wide * thick
    assert tension.tolist() == pytest.approx([1.0] * len(tension), abs=0.005)


@pytest.mark.parametrize("gap", [0.05, 0.3, 6.0])
def test_bodies_that_do_not_touch_are_not_glued_together(gap) -> None:
    plate = trimesh.creation.box((12, 2, 60))
    pair = trimesh.util.concatenate([plate, plate.copy().apply_translation([0, 2 + gap, 0])])
    assert num_shells(pair) == 2 and num_shells(plate) == 1
    with pytest.raises(ValueError, match="2 bodies that do not touch: register each"):
        ElasticBody(ImplantPointCloud.from_mesh(pair, 0.25, dtype=torch.float64), STEEL)


def test_a_hollow_implant_is_one_body() -> None:
    outer, inner = trimesh.creation.box((12, 6, 40)), trimesh.creation.box((6, 2, 20))
    inner.invert()
    hollow = trimesh.util.concatenate([outer, inner])
    assert num_shells(hollow) == 1
    assert len(body_volumes(ImplantPointCloud.from_mesh(hollow, 0.5))) == 1
