"""A scene is a torch module: its parameters are what is estimated, and any optimiser of torch registers it."""

from __future__ import annotations

import pytest
import torch
from small_scene import geometry, image, plate, pose

import torchkcreg as kc
from torchkcreg.deformation import RigidDeformation
from torchkcreg.geometry import rotation_about, transform_points
from torchkcreg.physics import material
from torchkcreg.registration import RegistrationConfig, build_scene
from torchkcreg.scene import Assembly, Scene

CONFIG = RegistrationConfig()


def errors(scene: Scene, points: torch.Tensor, truth: torch.Tensor) -> float:
    return float((scene.assemblies[0].warp(points).detach() - truth).norm(dim=-1).max())


def test_adam_on_a_scenes_parameters_finds_a_pose():
    truth, scene = (Scene([Assembly(plate(), RigidDeformation(), implant_to_world=p)]) for p in (pose(1.5, 1.0), None))
    data, points = image(truth), plate().points.double()
    places = truth.assemblies[0].warp(points).detach()
    start = errors(scene, points, places)
    loss, view = kc.GradientCorrelationLoss(data.line_integrals), scene.view(data, oversampling=1)
    optimizer = torch.optim.Adam(scene.parameters(), lr=0.05)
    for _ in range(120):
        optimizer.zero_grad()
        loss(scene(view)).backward()
        optimizer.step()
    assert start > 1.5
    assert errors(scene, points, places) < 0.15


def test_pose_deformation_and_physics_are_parameters():
    scene = build_scene(plate(), RegistrationConfig(material="steel"))
    names = {name.split(".")[-1] for name, _ in scene.named_parameters()}
    assert names == {"twist", "control_points", "scatter", "scatter_removed", "blur_sigma_px", "hardness"}
    scene.intensity.blur_sigma_px.data.fill_(0.5)
    scene(geometry()).square().sum().backward()
    for name, parameter in scene.named_parameters():
        if not name.endswith("scatter_removed"):  # it needs the shape of the scatter, which a geometry does not have
            assert parameter.grad is not None and float(parameter.grad.abs().max()) > 0, name


def test_the_twist_turns_about_the_middle_and_shifts():
    scene = Scene([Assembly(plate(), RigidDeformation(), implant_to_world=pose(2.0, 3.0))])
    (assembly,) = scene.assemblies
    turn, shift = torch.tensor([0.01, -0.02, 0.03]).double(), torch.tensor([0.5, -0.4, 0.3]).double()
    before = assembly.implant_to_world.detach()
    assembly.twist.data = torch.cat([turn * assembly.radius_mm, shift])
    points = plate().points.double()
    turned = transform_points(rotation_about(assembly.middle, turn), points) + shift
    torch.testing.assert_close(assembly.warp(points).detach(), transform_points(before, turned))
    far = (points - assembly.middle).norm(dim=-1).square().mean().sqrt()
    assert assembly.radius_mm == pytest.approx(float(far), rel=0.02)


def test_a_state_dict_takes_pose_and_deformation_along():
    moved, fresh = build_scene(plate(), CONFIG, implant_to_world=pose(2.0, 1.0)), build_scene(plate(), CONFIG)
    with torch.no_grad():
        moved.assemblies[0].twist.add_(torch.arange(6.0))
        moved.assemblies[0].deformation.control_points.add_(0.3)
    fresh.load_state_dict(moved.state_dict())
    points = plate().points
    assert torch.equal(fresh.assemblies[0].warp(points), moved.assemblies[0].warp(points))


def test_a_pose_that_is_set_takes_the_twists_place():
    scene = build_scene(plate(), CONFIG)
    (assembly,) = scene.assemblies
    assembly.twist.data.fill_(1.0)
    assembly.implant_to_world = pose(2.0, 1.0)
    assert torch.equal(assembly.implant_to_world, pose(2.0, 1.0))
    assert not assembly.twist.any()


def test_the_twist_stays_exact_when_a_scene_is_cast():
    scene = build_scene(plate(), CONFIG)
    scene.assemblies[0].twist.data.fill_(1 / 3)
    before = scene.assemblies[0].implant_to_world.detach()
    scene.float()
    assert scene.assemblies[0].twist.dtype == torch.float64
    assert isinstance(scene.assemblies[0].twist, torch.nn.Parameter)
    assert torch.equal(scene.assemblies[0].implant_to_world, before)


def test_screws_are_taken_where_components_are_wanted():
    screw = kc.Screw((2.0, 2.0, 15.0), (2.0, -14.0, 15.0), 1.5, "steel", "s1")
    (assembly,) = build_scene(plate(), CONFIG, components=[screw]).assemblies
    (component,) = assembly.components
    assert component.as_screw == screw
    assert component.material == material("steel").name
