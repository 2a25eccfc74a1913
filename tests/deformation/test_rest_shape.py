"""Finite elements that bend an implant from the shape it was registered in without load."""

from __future__ import annotations

import math

import pytest
import torch
from small_scene import RIGID, image, plate

from torchkcreg.deformation import (
    Deviations,
    FiniteElementDeformation,
    FreeFormDeformation,
    Level,
    bent_cloud,
    bent_hold,
    deformation_from_dict,
    spread_of_rest,
)
from torchkcreg.geometry import transform_points
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import Hold, Superelement
from torchkcreg.physics import elastic_constants
from torchkcreg.plain import plain
from torchkcreg.registration import Implant, RegisteredImplant, RegistrationConfig, Stage, build_scene, register
from torchkcreg.registration.implant import deformation_of
from torchkcreg.splines import default_grid

HOLDS = [Hold(f"at {z:.0f}", (0.0, 0.0, z), 4.0) for z in (-22.0, -7.0, 7.0, 22.0)]
CONFIG = RegistrationConfig(
    stages=(*RIGID, Stage(groups=20, modes=12, oversampling=1, tolerance=1e-4)), deformation="fe", hold_weight=1e-9
)


def contoured(cloud: ImplantPointCloud, sag: float = 4.0) -> FreeFormDeformation:
    """An implant bent into a bow of so much sag, mm, over 25 mm to both sides."""
    deformation = FreeFormDeformation(default_grid(cloud.points))
    frame = deformation.grid.frame
    _, depth, height = transform_points(frame, deformation.grid.positions()).unbind(-1)
    bow = torch.stack([0 * height, sag * (height / 25) ** 2, -2 * sag * depth * height / 25**2], dim=-1)
    deformation.control_points.data += bow @ frame[:3, :3]
    return deformation


@pytest.fixture(scope="module")
def rest() -> RegisteredImplant:
    return RegisteredImplant("implant", torch.eye(4).double(), contoured(plate()))


@pytest.fixture(scope="module")
def elastic(rest) -> FiniteElementDeformation:
    return deformation_of(Implant(plate(), material="titanium", holds=HOLDS, rest=rest), CONFIG)


def test_without_load_the_implant_has_its_rest_shape(elastic, rest) -> None:
    points = plate().points.double()
    assert float(rest.deformation.displacement(points).norm(dim=-1).max()) > 2.0
    torch.testing.assert_close(elastic(points), rest.deformation(points), atol=1e-9, rtol=0)
    assert not any(p.requires_grad for p in elastic.rest.parameters()) and elastic.amounts.requires_grad
    elastic.reset()
    torch.testing.assert_close(elastic(points), rest.deformation(points), atol=1e-9, rtol=0)


def test_it_bends_as_an_implant_that_is_made_in_that_shape(elastic, rest) -> None:
    made = bent_cloud(plate(), rest.deformation)
    assert made.volume == pytest.approx(plate().volume)
    holds = [bent_hold(hold, rest.deformation) for hold in HOLDS]
    alone = FiniteElementDeformation(Superelement.of(made, elastic_constants("titanium"), holds))
    amounts = torch.tensor([0.5, -0.3, 0.2]).double()
    alone.amounts.data[:3], elastic.amounts.data[:3] = amounts, amounts
    points = plate().points.double()
    torch.testing.assert_close(elastic(points), alone(rest.deformation(points)), atol=1e-9, rtol=0)
    elastic.reset()


def test_holes_turn_with_the_metal_about_them(rest) -> None:
    hold = Hold("hole", (0.0, 0.0, 20.0), 2.0, (0.0, 1.0, 0.0), 1.5)
    moved = bent_hold(hold, rest.deformation)
    along = rest.deformation(torch.tensor([[0.0, 0.0, 19.0], [0.0, 0.0, 21.0]]).double()).diff(dim=0)[0]
    axis = torch.tensor(moved.axis).double()
    assert abs(float(axis @ along / along.norm())) < math.sin(math.radians(4))
    assert float(axis.norm()) == pytest.approx(1.0)
    assert moved.center == pytest.approx(rest.deformation(torch.tensor([hold.center]).double())[0].tolist())


def test_a_step_moves_points_as_the_deformation_and_pose_it_leaves(elastic) -> None:
    cloud = plate()
    motion = elastic.motion(cloud, Level(groups=2))
    steps = 0.3 * torch.randn(motion.num_parameters, generator=torch.Generator().manual_seed(1)).double()
    points = cloud.points[::7].double()
    moved = points + motion.displacement(points, steps[None])[0]
    left = motion.accept(steps)
    there = elastic(points) @ left[:3, :3].T + left[:3, 3]
    torch.testing.assert_close(there, moved, atol=1e-9, rtol=0)
    elastic.reset()


def test_files_keep_the_rest_shape(elastic) -> None:
    elastic.amounts.data[0] = 0.2
    again = deformation_from_dict(plain(elastic.to_dict()))
    points = plate().points.double()
    torch.testing.assert_close(again(points), elastic(points), atol=1e-5, rtol=0)
    elastic.reset()
    assert "rest" not in FiniteElementDeformation(elastic.superelement).to_dict()


def test_load_on_a_contoured_plate_is_found(rest) -> None:
    implant = Implant(plate(), material="titanium", holds=HOLDS, rest=rest)
    truth = build_scene(implant, CONFIG)
    bent = truth.assemblies[0].deformation
    bent.amounts.data[:2] = torch.tensor([0.3, -0.2]).double()
    result = register(implant, image(truth), CONFIG)
    error = (result.warp(plate().points.double()) - truth.assemblies[0].warp(plate().points).detach()).norm(dim=-1)
    assert result.diagnostics["strain"] < 0.005  # by the load; contouring took three per cent
    assert float(error.max()) < 0.02
    loads, found = bent.loads, result.deformation.loads
    assert float((found - loads)[:, 3:].abs().max()) < 0.1 * float(loads[:, 3:].abs().max())


def test_errors_of_the_rest_shape_are_errors_of_the_load(elastic, rest) -> None:
    element, nodes = elastic.superelement, plate().coarsened(2).points.double()
    same = torch.eye(element.num_amounts).double()[:1]
    pose = torch.eye(4).double()
    for size in (0.0, 0.02, 0.04):
        field = size * element.linear(rest.deformation(nodes), same)  # the rest shape is off along the softest way
        doubt = Deviations(nodes, field if size else field[:0], torch.tensor([0.0, 1.0, 0.0]).double())
        spread = spread_of_rest(element, rest.deformation, doubt, pose)
        assert float(spread[0, 0].sqrt()) == pytest.approx(size, rel=0.05)
    assert float(spread[1:, 1:].abs().max()) < 0.05 * float(spread[0, 0])
    element_of = FiniteElementDeformation(element, rest=rest.deformation, rest_spread=spread)
    motion = element_of.motion(plate(), Level(groups=2))
    motion.keep_covariance(1e-12 * torch.eye(motion.num_parameters).double())
    assert float(element_of.covariance[0, 0].sqrt()) >= 0.95 * size


def test_another_model_is_refused(rest) -> None:
    with pytest.raises(ValueError, match="ask for them with --deformation fe"):
        deformation_of(Implant(plate(), material="titanium", rest=rest), RegistrationConfig())
