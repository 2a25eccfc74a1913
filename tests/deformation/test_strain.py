"""The elastic energy at finite rotations."""

import pytest
import torch

from torchkcreg.deformation import strain_energy
from torchkcreg.geometry import rotation_from_vector

VOLUMES = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)


def test_rigid_turns_cost_nothing_however_large():
    turns = rotation_from_vector(torch.tensor([[3.0, 0, 0], [0, 1.0, -1.0], [0.2, 0.1, 0.0]], dtype=torch.float64))
    assert strain_energy(turns, VOLUMES, poisson=0.3) < 1e-25


def test_a_turn_after_a_deformation_changes_nothing():
    deformed = torch.eye(3) + 0.1 * torch.rand(3, 3, 3, dtype=torch.float64)
    turn = rotation_from_vector(torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64))
    expected = strain_energy(deformed, VOLUMES, poisson=0.3)
    assert torch.allclose(strain_energy(turn @ deformed, VOLUMES, poisson=0.3), expected)


@pytest.mark.parametrize("poisson", [0.0, 0.3])
def test_a_confined_stretch_costs_its_analytic_energy(poisson):
    gradient = torch.diag(torch.tensor([1.001, 1.0, 1.0], dtype=torch.float64)).expand(3, 3, 3)
    strain = (1.001**2 - 1) / 2
    expected = 0.5 * strain**2 * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    assert float(strain_energy(gradient, VOLUMES, poisson=poisson)) == pytest.approx(expected)


def test_a_bent_plate_costs_the_square_of_curvature_times_thickness_over_24():
    curvature, thickness = 1e-3, 4.0
    depth = (torch.arange(400, dtype=torch.float64) + 0.5) / 400 * thickness - thickness / 2
    gradient = torch.eye(3, dtype=torch.float64).repeat(400, 1, 1)
    gradient[:, 0, 0] += curvature * depth
    energy = strain_energy(gradient, torch.ones(400, dtype=torch.float64))
    assert float(energy) == pytest.approx((curvature * thickness) ** 2 / 24, rel=1e-4)


def test_candidates_are_independent():
    gradients = torch.eye(3) + 0.1 * torch.rand(4, 3, 3, 3, dtype=torch.float64)
    energies = strain_energy(gradients, VOLUMES)
    assert energies.shape == (4,)
    assert torch.allclose(energies[2], strain_energy(gradients[2], VOLUMES))
