"""The elastic energy of an implant."""

import pytest
import torch

from torchkcreg.deformation import (
    ControlPointGrid,
    FreeFormDeformation,
    elastic_energy,
    elastic_stiffness,
)
from torchkcreg.geometry import rigid_matrix, transform_points

POSE = rigid_matrix(
    torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64), torch.tensor([30.0, -5.0, 11.0], dtype=torch.float64)
)
GRID = ControlPointGrid((5, 5, 7), (8.0, 7.0, 12.0), POSE)
NU = 0.3


@pytest.fixture(scope="module")
def implant():
    """A block of uneven density across several knot cells: points, masses, stiffness."""
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([16.0, 14.0, 48.0], dtype=torch.float64)
    points = torch.rand(3000, 3, generator=generator, dtype=torch.float64) * size
    points = transform_points(POSE, points + torch.tensor([8.0, 7.0, 12.0], dtype=torch.float64))
    masses = torch.rand(3000, generator=generator, dtype=torch.float64)
    return points, masses, elastic_stiffness(GRID, points, masses, poisson=NU)


def linear_phi(gradient):
    return GRID.positions() @ torch.tensor(gradient, dtype=torch.float64).T


def test_translations_and_infinitesimal_rotations_cost_nothing(implant):
    _, masses, stiffness = implant
    turn = linear_phi([[0.0, -1.0, 2.0], [1.0, 0.0, -3.0], [-2.0, 3.0, 0.0]])
    for phi in (torch.ones_like(turn), turn):
        assert (stiffness @ phi.flatten()).abs().max() < 1e-9 * float(masses.sum())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_confined_stretch_costs_its_analytic_energy(implant, axis):
    _, masses, stiffness = implant
    strain, gradient = 0.01, torch.zeros(3, 3)
    gradient[axis, axis] = strain
    expected = 0.5 * strain**2 * float(masses.sum()) * (1 - NU) / ((1 + NU) * (1 - 2 * NU))
    assert float(elastic_energy(linear_phi(gradient.tolist()), stiffness)) == pytest.approx(expected, rel=1e-6)


def test_a_free_stretch_costs_half_youngs_modulus_times_strain_squared(implant):
    _, masses, stiffness = implant
    phi = linear_phi([[-NU * 0.01, 0.0, 0.0], [0.0, -NU * 0.01, 0.0], [0.0, 0.0, 0.01]])
    assert float(elastic_energy(phi, stiffness)) == pytest.approx(0.5 * 1e-4 * float(masses.sum()))


def test_a_shear_costs_half_the_shear_modulus_times_its_square(implant):
    _, masses, stiffness = implant
    phi = linear_phi([[0.0, 0.0, 0.01], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    shear_modulus = 1 / (2 * (1 + NU))
    assert float(elastic_energy(phi, stiffness)) == pytest.approx(0.5 * shear_modulus * 1e-4 * float(masses.sum()))


def test_any_field_costs_the_integral_of_its_strain_energy_density(implant):
    points, masses, stiffness = implant
    phi = torch.rand(*GRID.shape, 3, dtype=torch.float64)
    slope = FreeFormDeformation(GRID, phi).jacobian(points).detach() - torch.eye(3)
    strain = (slope + slope.mT) / 2
    trace = strain.diagonal(dim1=1, dim2=2).sum(-1)
    density = 0.5 * NU / ((1 + NU) * (1 - 2 * NU)) * trace**2 + 0.5 / (1 + NU) * strain.square().sum((1, 2))
    assert torch.allclose(elastic_energy(phi, stiffness), masses @ density, rtol=1e-9)


def test_the_matrix_is_symmetric_and_positive_semidefinite_with_six_free_motions_of_what_carries(implant):
    _, _, stiffness = implant
    assert torch.allclose(stiffness, stiffness.T, atol=1e-12)
    values = torch.linalg.eigvalsh(stiffness)
    assert values[0] > -1e-9 * values[-1]
    assert int((values < 1e-10 * values[-1]).sum()) >= 6


def test_energies_of_candidates_and_their_gradients(implant):
    _, _, stiffness = implant
    phi = torch.rand(2, 3, *GRID.shape, 3, dtype=torch.float64, requires_grad=True)
    energy = elastic_energy(phi, stiffness)
    assert energy.shape == (2, 3)
    (gradient,) = torch.autograd.grad(energy.sum(), phi)
    assert torch.allclose(gradient[1, 1].flatten(), stiffness @ phi[1, 1].detach().flatten())


def test_impossible_arguments_are_refused(implant):
    points, masses, stiffness = implant
    with pytest.raises(ValueError, match="poisson must"):
        elastic_stiffness(GRID, points, masses, poisson=0.5)
    with pytest.raises(ValueError, match="masses must"):
        elastic_stiffness(GRID, points, masses[:-1])
    with pytest.raises(ValueError, match="valid domain"):
        elastic_stiffness(GRID, points + 100, masses)
    with pytest.raises(ValueError, match="stiffness must"):
        elastic_energy(torch.zeros(4, 4, 4, 3), stiffness)
