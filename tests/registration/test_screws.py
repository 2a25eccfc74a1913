"""Screws that are found in an implant's holes, and their shapes that are estimated along."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from small_scene import GRID_OF_SCREWS, drilled_plate, image, pose

from torchkcreg.implant import Component, ImplantPointCloud, Screw, find_holes
from torchkcreg.registration import Implant, RegistrationConfig, Stage, build_scene, find_screws, register
from torchkcreg.scene import RegistrationData, Scene, ScrewPaths
from torchkcreg.scene.parameter_blocks import ScrewShapes

TRUE = Screw((0.0, 1.5, 15.0), (0.0, -18.0, 15.0), 1.6, "steel")
CONFIG = RegistrationConfig(material="steel", stages=(Stage(oversampling=1),), **GRID_OF_SCREWS)


@pytest.fixture(scope="module")
def mesh() -> trimesh.Trimesh:
    return drilled_plate()


def scene_of(mesh: trimesh.Trimesh, motion: torch.Tensor | None = None, components: tuple[Screw, ...] = ()) -> Scene:
    cloud = ImplantPointCloud.from_mesh(mesh, 0.5)
    holes = find_holes(mesh)
    parts = [Component.of(screw, pitch=0.5) for screw in components]
    return build_scene(cloud, CONFIG, implant_to_world=motion, components=parts, holes=holes)


def found_in(mesh: trimesh.Trimesh, data: RegistrationData, bin: int = 1) -> list[Screw]:
    scene = scene_of(mesh)
    return find_screws(scene, scene.assemblies[0], data, bin=bin)


def test_the_one_screw_of_three_holes_is_found_with_its_length_and_radius(mesh: trimesh.Trimesh) -> None:
    data = image(scene_of(mesh, components=(TRUE,)))
    (found,) = found_in(mesh, data)
    assert np.allclose(found.start, TRUE.start, atol=0.3)
    assert np.allclose(found.end, TRUE.end, atol=1.0)
    assert found.radius == pytest.approx(TRUE.radius, abs=0.15)


@pytest.mark.parametrize("metal", ["steel", "titanium"])
def test_a_screw_of_either_metal_is_told_by_how_dark_it_is(mesh: trimesh.Trimesh, metal: str) -> None:
    screw = replace(TRUE, material=metal)
    data = image(scene_of(mesh, components=(screw,)))
    (found,) = found_in(mesh, data)
    assert found.material == metal
    assert np.allclose(found.end, TRUE.end, atol=1.0)


def test_a_tilted_screw_of_another_metal_does_not_pull_the_implant_along(mesh: trimesh.Trimesh) -> None:
    motion = pose(0.4, 0.3)
    tilted = replace(TRUE, material="titanium").moved(torch.tensor([0.0, 0.0, 0.1]), torch.zeros(3))
    data = image(scene_of(mesh, motion, components=(tilted,)))
    fit = {"oversampling": 1, "estimate": ("screws", "tilts"), "tolerance": 1e-4, "iterations": 40}
    stages = (*(2 * [Stage(bin=2, before=("find_screws",), **fit)]), Stage(**fit))
    cloud = ImplantPointCloud.from_mesh(mesh, 0.5)
    result = register(cloud, data, CONFIG.model_copy(update={"stages": stages}), holes=find_holes(mesh))
    (found,) = result.screws_found
    assert found.material == "titanium"
    assert np.allclose(found.end, tilted.end, atol=0.4)
    points = cloud.points.double()
    truth = points @ motion[:3, :3].T + motion[:3, 3]
    assert float((result.warp(points) - truth).norm(dim=-1).max()) < 0.05


def test_a_screw_moves_to_the_other_part_of_a_combination_hole_as_a_whole() -> None:
    moved = TRUE.moved(torch.zeros(3), torch.tensor([0.0, 0.0, 2.0]))
    assert moved.end == pytest.approx((0.0, -18.0, 17.0)) and moved.length == pytest.approx(TRUE.length)
    assert TRUE.same_side(moved) and not TRUE.same_side(replace(TRUE, end=(0.0, 20.0, 15.0)))


def test_no_screw_is_found_where_there_is_none(mesh: trimesh.Trimesh) -> None:
    data = image(scene_of(mesh))
    noise = torch.randn(data.line_integrals.shape, generator=torch.Generator().manual_seed(0))
    noisy = type(data)(data.geometry, data.line_integrals + 0.02 * noise)
    assert found_in(mesh, noisy, bin=2) == []


def test_a_registration_that_is_told_of_no_screw_finds_it_and_its_shape(mesh: trimesh.Trimesh) -> None:
    motion = pose(0.4, 0.3)
    data = image(scene_of(mesh, motion, components=(TRUE,)))
    fit = {"oversampling": 1, "estimate": ("screws",)}
    stages = (Stage(bin=2, before=("find_screws",), **fit), Stage(tolerance=1e-4, **fit))
    cloud = ImplantPointCloud.from_mesh(mesh, 0.5)
    result = register(cloud, data, CONFIG.model_copy(update={"stages": stages}), holes=find_holes(mesh))
    (found,) = result.screws_found
    assert np.allclose(found.end, TRUE.end, atol=0.25)
    points = cloud.points.double()
    truth = points @ motion[:3, :3].T + motion[:3, 3]
    assert float((result.warp(points) - truth).norm(dim=-1).max()) < 0.05


def test_screws_found_at_the_start_keep_the_first_stage_from_sliding(mesh: trimesh.Trimesh) -> None:
    start = pose(1.0, 0.5)
    data = image(scene_of(mesh, start, components=(TRUE,)))
    steps = {"before": ("find_screws",), "after": ("slide",)}
    stages = (Stage(bin=2, oversampling=1, estimate=("screws",), iterations=30, **steps),)
    cloud = ImplantPointCloud.from_mesh(mesh, 0.5)
    result = register(cloud, data, CONFIG.model_copy(update={"stages": stages}), holes=find_holes(mesh))
    assert len(result.screws_found) == 1
    points = cloud.points.double()
    truth = points @ start[:3, :3].T + start[:3, 3]
    assert float((result.warp(points) - truth).norm(dim=-1).max()) < 0.5


def test_screws_are_not_looked_for_where_that_is_not_wanted(mesh: trimesh.Trimesh) -> None:
    data = image(scene_of(mesh, components=(TRUE,)))
    stages = (Stage(bin=2, oversampling=1, iterations=1, before=("find_screws",), estimate=("screws",)),)
    config = CONFIG.model_copy(update={"stages": stages, "find_screws": False})
    result = register(ImplantPointCloud.from_mesh(mesh, 0.5), data, config, holes=find_holes(mesh))
    assert result.screws_found == []


def test_shapes_are_the_slopes_of_the_images(mesh: trimesh.Trimesh) -> None:
    scene = scene_of(mesh)
    path = ScrewPaths(scene.assemblies[0], scene.view(image(scene), oversampling=1, margin_mm=6.0))
    shapes = ScrewShapes([TRUE], path)
    longer = shapes.added(torch.tensor([[0.4, 0.0]], dtype=torch.float64))["steel"][0]
    (stepped,) = shapes.stepped(torch.tensor([0.4, 0.0], dtype=torch.float64))
    assert stepped.length == pytest.approx(TRUE.length + 0.4)
    change = path(stepped) - path(TRUE)
    assert float(longer.sum()) == pytest.approx(float(change.sum()), rel=0.03)
    thicker = shapes.added(torch.tensor([[0.0, 0.5]], dtype=torch.float64))["steel"][0]
    (stepped,) = shapes.stepped(torch.tensor([0.0, 0.5], dtype=torch.float64))
    assert stepped.radius == pytest.approx(TRUE.radius + 0.1)
    change = path(stepped) - path(TRUE)
    assert float(thicker.sum()) == pytest.approx(float(change.sum()), rel=0.06)


def test_screws_side_by_side_overlap_and_others_do_not() -> None:
    beside = Screw((0.0, 1.5, 18.0), (0.0, -18.0, 18.0), 1.6, "steel")
    apart = Screw((0.0, 1.5, 19.0), (0.0, -18.0, 19.0), 1.6, "steel")
    assert TRUE.overlaps(TRUE.with_length(5.0)) and TRUE.overlaps(beside) and not TRUE.overlaps(apart)


@pytest.mark.parametrize("metal", ["steel", "titanium"])
def test_the_metal_is_the_one_with_which_a_stage_ends_best(mesh: trimesh.Trimesh, metal: str) -> None:
    motion = pose(0.3, 0.2)
    screw = replace(TRUE, material=metal)
    data = image(scene_of(mesh, motion, components=(screw,)))
    options = {"similarity": "gradient-difference", "estimate": ("screws", "tilts"), "iterations": 30}
    stages = (Stage(bin=2, oversampling=1, before=("choose_screws",), **options),)
    cloud = ImplantPointCloud.from_mesh(mesh, 0.5)
    result = register(cloud, data, CONFIG.model_copy(update={"stages": stages}), holes=find_holes(mesh))
    assert [found.material for found in result.screws_found] == [metal]


def test_each_of_two_plates_finds_its_own_screws(mesh: trimesh.Trimesh) -> None:
    cloud, holes = ImplantPointCloud.from_mesh(mesh, 0.5), find_holes(mesh)
    beside = torch.eye(4, dtype=torch.float64)
    beside[0, 3] = 20.0

    def plates(screws: list[list[Screw]]) -> list[Implant]:
        parts = [[Component.of(s, pitch=0.5) for s in own] for own in screws]
        return [
            Implant(cloud, parts[0], holes, name="medial"),
            Implant(cloud, parts[1], holes, implant_to_world=beside, name="lateral"),
        ]

    lower = replace(TRUE, start=(0.0, 1.5, -15.0), end=(0.0, -16.0, -15.0))
    data = image(build_scene(plates([[TRUE], [lower]]), CONFIG))
    stages = (Stage(oversampling=1, before=("choose_screws",), estimate=("screws",), iterations=8),)
    result = register(plates([[], []]), data, CONFIG.model_copy(update={"stages": stages}))
    for implant, screw in zip(result.implants, (TRUE, lower), strict=True):
        (found,) = implant.screws
        assert np.allclose(found.end, screw.end, atol=0.5), implant.name
