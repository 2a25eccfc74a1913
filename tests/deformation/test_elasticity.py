"""Elastic modes: rigid ones first, then bends as a beam has them; loads; where a stage of modes starts."""

import math

import pytest
import torch
from small_scene import bend, image, objective, pose, scene

from torchkcreg.deformation import BendingPrior, Elasticity, FreeFormDeformation, GroupMotion, Level, ModalMotion
from torchkcreg.geometry import transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import RegistrationConfig, Scene, Stage
from torchkcreg.simulation import locking_plate
from torchkcreg.splines import default_grid

GRID = {"grid_shape": (4, 4, 8), "grid_spacing_mm": (8.0, 8.0, 8.0)}
CONFIG = RegistrationConfig(stages=(Stage(groups=8, modes=14, oversampling=1),), **GRID)


def modal(of: Scene) -> tuple[Elasticity, ModalMotion]:
    (assembly,) = of.assemblies
    motion = assembly.deformation.motion(assembly.implant, Level(groups=8, modes=14))
    assert isinstance(motion, ModalMotion)
    return motion.groups.elasticity, motion


def in_grid(motion: ModalMotion, steps: torch.Tensor) -> torch.Tensor:
    """Motions of the groups in the grid's axes."""
    return motion.coefficients(steps) @ motion.groups.grid.frame[:3, :3]


def test_the_softest_six_modes_are_rigid_and_the_others_stiffer_and_stiffer() -> None:
    _, motion = modal(scene(CONFIG))
    rigid, elastic = motion.stiffnesses[:6], motion.stiffnesses[6:]
    assert float(rigid.max()) < 1e-6 * float(elastic[0])
    assert (elastic.diff() >= 0).all()


def test_a_mode_moves_the_implant_by_a_root_mean_square_of_one_millimetre() -> None:
    elasticity, motion = modal(scene(CONFIG))
    small = 1e-3 * torch.eye(motion.num_parameters, dtype=torch.float64)
    displacements = elasticity.displacements(in_grid(motion, small))
    torch.testing.assert_close(displacements @ displacements.T, 1e-6 * torch.eye(14).double(), atol=2e-8, rtol=0)


def test_the_energy_of_a_mode_is_half_its_stiffness() -> None:
    elasticity, motion = modal(scene(CONFIG))
    for mode in (6, 9):
        step = torch.zeros(1, 14, dtype=torch.float64)
        step[0, mode] = 0.01
        energy = elasticity.volume * elasticity.energy(in_grid(motion, step))
        assert float(energy.detach()) == pytest.approx(0.5 * float(motion.stiffnesses[mode]) * 1e-4, rel=0.02)


def test_the_first_bend_is_as_stiff_as_a_free_beam_of_blended_sections() -> None:
    # Euler-Bernoulli: k = (4.730 / L)^4 I L for a mode of unit root mean square. Blended rigid groups are stiffer, and
    # the few nodes of the energy's integral have a little less second moment than the solid.
    here = scene(CONFIG)
    _, motion = modal(here)
    size = here.assemblies[0].implant.bounds.diff(dim=0)[0].double() + CONFIG.pitch_mm
    thickness, width, length = size.sort().values.tolist()
    beam = (4.730 / length) ** 4 * width * thickness**3 / 12 * length
    assert 0.6 * beam < float(motion.stiffnesses[6]) < 3 * beam


def test_a_stage_of_modes_starts_from_the_bend_so_far() -> None:
    every = CONFIG.model_copy(update={"stages": (CONFIG.stages[0].model_copy(update={"modes": 48}),)})
    here = scene(every, pose(1.0, 0.5))
    bend(here, math.radians(1.0))
    bending = here.assemblies[0].deformation.displacement(here.assemblies[0].implant.points.double()).detach()
    before = in_world(here)
    modes = objective(here, image(here), every.schedule()[0], every)
    modes.accept(modes.at_rest[0])
    error = (in_world(here) - before).norm(dim=-1)
    assert float(bending.norm(dim=-1).max()) > 0.1
    assert float(error.max()) < 0.02 * float(bending.norm(dim=-1).max())


@pytest.mark.parametrize(("holes", "width"), [(4, 11.0), (6, 8.0), (7, 13.5), (9, 13.8)])
def test_modes_of_short_and_narrow_plates_follow_a_bend(holes: int, width: float) -> None:
    mesh = locking_plate(length=15.0 * holes, width=width, thickness=3.2, num_holes=holes)
    cloud = ImplantPointCloud.from_mesh(mesh, 0.5)
    groups = GroupMotion(FreeFormDeformation(default_grid(cloud.points)), cloud, 20, BendingPrior())
    _, depth, height = groups.elasticity.points.unbind(-1)
    curvature = 2.0 / height.max() ** 2
    displacement = torch.stack([0 * height, curvature / 2 * height**2, -curvature * height * depth], dim=-1)
    motion = ModalMotion(groups, 40, displacement)
    assert motion.misfit_mm < 0.02
    assert float(motion.start.abs().max()) < 5.0
    motions = in_grid(motion, motion.at_rest())
    middles = groups.elasticity.of_filling().displacements(
        motions
    )  # groups without metal go along, they do not fly away
    assert float(middles.norm()) < 5.0


def in_world(of: Scene) -> torch.Tensor:
    """Where the implant's nodes are."""
    points = of.assemblies[0].implant.points.double()
    return transform_points(
        of.assemblies[0].implant_to_world, points + of.assemblies[0].deformation.displacement(points)
    ).detach()


def test_a_straight_implant_needs_no_load_and_a_bent_one_does() -> None:
    _, straight = modal(scene(CONFIG))
    assert float(straight.loads(torch.zeros(14).double()).abs().max()) < 1e-9
    bent = scene(CONFIG)
    bend(bent, math.radians(1.0))
    _, motion = modal(bent)
    loads = motion.loads(torch.zeros(14).double())
    assert float(loads[6:].abs().max()) > 1e3 * float(loads[:6].abs().max())
