"""Motions: a step moves points as the deformation and the pose that it leaves, and costs what the formulas say."""

from __future__ import annotations

import pytest
import torch
from small_scene import plate

from torchkcreg.deformation import (
    BendingPrior,
    FreeFormDeformation,
    Level,
    LinearDeformation,
    RigidDeformation,
    diffusion_penalty,
)
from torchkcreg.deformation.group_motion import GroupMotion
from torchkcreg.deformation.modal_motion import ModalMotion
from torchkcreg.splines import default_grid

GRID = default_grid(plate().points, shape=(4, 4, 6), spacing=(10.0, 10.0, 12.0))


class Bows(LinearDeformation):
    """Two parabolas, with a prior."""

    def shapes(self, points):
        """Displacements along x and y that grow with the square of the height."""
        zero, square = 0 * points[..., 2], (points[..., 2] / 25) ** 2
        rows = [torch.stack(row, dim=-1) for row in ((square, zero, zero), (zero, square, zero))]
        return torch.stack(rows, dim=-2)

    def prior(self, amounts):
        """Square of the amounts with weights of 1 and 3."""
        return (amounts.square() * amounts.new_tensor([1.0, 3.0])).sum(-1)


def bowed() -> Bows:
    deformation = Bows(2)
    deformation.amounts.data.copy_(torch.tensor([0.4, -0.7]))
    return deformation


def free_form() -> FreeFormDeformation:
    deformation = FreeFormDeformation(GRID)
    generator = torch.Generator().manual_seed(3)
    deformation.control_points.data.copy_(torch.randn(*GRID.shape, 3, generator=generator))
    return deformation


def test_free_amounts_are_parameters_after_the_six_rigid_ones() -> None:
    cloud = plate()
    assert bowed().motion(cloud, Level(groups=2)).num_parameters == 8
    assert bowed().motion(cloud, Level(groups=1)).num_parameters == 6
    assert RigidDeformation().motion(cloud, Level(groups=4)).num_parameters == 6


@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("kind", [bowed, free_form, RigidDeformation])
def test_a_step_moves_points_as_the_deformation_and_pose_it_leaves(kind, groups: int) -> None:
    cloud, deformation = plate(), kind()
    points = cloud.points[::5].double()
    before = deformation(points).detach()
    motion = deformation.motion(cloud, Level(groups=groups))
    rest = motion.displacement(points, torch.zeros(1, motion.num_parameters).double())[0]
    if kind is not free_form:  # groups start from their nearest rigid motions
        torch.testing.assert_close(points + rest, before, rtol=0, atol=1e-6)
    steps = 0.5 * torch.randn(motion.num_parameters, generator=torch.Generator().manual_seed(1)).double()
    moved = points + motion.displacement(points, steps[None])[0]
    left = motion.accept(steps)
    torch.testing.assert_close(deformation(points) @ left[:3, :3].T + left[:3, 3], moved, rtol=0, atol=1e-6)
    assert float((moved - before).norm(dim=-1).max()) > 0.2


def test_candidates_of_amounts_turn_with_the_implant_and_cost_their_prior() -> None:
    motion = bowed().motion(plate(), Level(groups=2))
    steps = torch.zeros(3, 8).double()
    steps[1, 6:], steps[2, 3] = torch.tensor([0.6, 0.2]).double(), 1.5
    points = torch.tensor([[0.0, 0.0, 25.0]]).double()
    moved = motion.displacement(points, steps)[:, 0]
    expected = torch.tensor([[0.4, -0.7, 0.0], [1.0, -0.5, 0.0], [1.9, -0.7, 0.0]]).double()
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-7)
    prior = [0.4**2 + 3 * 0.7**2, 1 + 3 * 0.5**2, 0.4**2 + 3 * 0.7**2]
    torch.testing.assert_close(motion.penalty(steps), torch.tensor(prior).double())


def test_groups_cost_beta_times_the_diffusion_plus_the_weighted_elastic_energy() -> None:
    cloud, prior = plate(), BendingPrior(beta=0.3, stiffness=2.0)
    motion = GroupMotion(FreeFormDeformation(GRID), cloud, 3, prior)
    steps = torch.randn(2, motion.num_parameters, generator=torch.Generator().manual_seed(0)).double()
    diffusion = diffusion_penalty(motion.control_points(steps), GRID)
    energy = motion.elasticity.energy(motion.in_grid(steps))
    assert float(diffusion.min()) > 0 and float(energy.min()) > 0
    torch.testing.assert_close(motion.penalty(steps), 0.3 * diffusion + 2.0 * energy)


def test_a_unit_step_of_a_group_moves_its_metal_by_about_a_millimetre() -> None:
    cloud = plate()
    motion = GroupMotion(FreeFormDeformation(GRID), cloud, 2, BendingPrior())
    points = cloud.points.double()
    steps = torch.eye(motion.num_parameters).double()
    furthest = motion.displacement(points, steps).norm(dim=-1).amax(-1)
    assert bool((furthest > 0.3).all()) and bool((furthest < 3.0).all())


def test_modes_start_from_the_bend_and_cost_the_square_of_their_loads() -> None:
    groups = GroupMotion(FreeFormDeformation(GRID), plate(), 4, BendingPrior())
    motion = ModalMotion(groups, 10, torch.zeros_like(groups.elasticity.points))
    steps = torch.zeros(1, motion.num_parameters).double()
    assert float(motion.penalty(steps)) == pytest.approx(0.0, abs=1e-12)
    steps[0, 7] = 1.0
    once = float(motion.penalty(steps))
    assert once > 0 and float(motion.penalty(2 * steps)) == pytest.approx(4 * once)
