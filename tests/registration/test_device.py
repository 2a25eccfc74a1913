"""Everything a registration makes is where its data are; no GPU is needed to see that."""

from __future__ import annotations

import copy

import pytest
import torch
from small_scene import GRID_OF_SCREWS, RIGID, SCREW, bend, drilled_plate, image, plate, pose, scene

from torchkcreg.implant import Component, ImplantPointCloud, Screw, find_holes
from torchkcreg.registration import RegistrationConfig, Stage, build_scene, register

CONFIG = RegistrationConfig(
    material="steel",
    stages=(
        RIGID[0].model_copy(update={"after": ("slide",)}),
        Stage(
            bin=2, before=("background", "reweight"), similarity="gradient-difference", estimate=("scatter", "tilts")
        ),
        Stage(groups=2, bin=2, iterations=2, estimate=("scatter", "blur", "hardness", "removed")),
        Stage(groups=4, modes=8, bin=2, iterations=2, before=("background",)),
    ),
)


def tensors_of(thing: object, seen: set[int]) -> list[torch.Tensor]:
    """All tensors that hang on something, whether torch knows of them or not."""
    if id(thing) in seen:
        return []
    seen.add(id(thing))
    if isinstance(thing, torch.Tensor):
        return [thing]
    if isinstance(thing, dict):
        return [t for value in thing.values() for t in tensors_of(value, seen)]
    if isinstance(thing, (list, tuple, set)):
        return [t for value in thing for t in tensors_of(value, seen)]
    return tensors_of(vars(thing), seen) if hasattr(thing, "__dict__") and not isinstance(thing, type) else []


def test_nothing_is_made_on_a_device_that_nobody_named() -> None:
    """With another default device, whatever is made without naming one could not be computed with."""
    data, cloud = image(scene(CONFIG, pose(0.5, 0.5), components=[SCREW])), plate()
    expected = register(cloud, data, CONFIG, components=[SCREW])
    with torch.device("meta"):
        result = register(cloud, data, CONFIG, components=[SCREW])
        points = result.warp(cloud.points)
    assert points.device.type == "cpu"
    torch.testing.assert_close(points, expected.warp(cloud.points), atol=1e-6, rtol=0)


def test_nor_by_the_search_for_screws() -> None:
    mesh = drilled_plate()
    cloud, holes = ImplantPointCloud.from_mesh(mesh, 0.5), find_holes(mesh)
    screw = Component.of(Screw((0.0, 1.5, 15.0), (0.0, -18.0, 15.0), 1.6), pitch=0.5)
    steps = {"before": ("choose_screws",), "estimate": ("screws", "tilts"), "iterations": 2}
    config = RegistrationConfig(material="steel", stages=(Stage(bin=2, **steps),), **GRID_OF_SCREWS)
    data = image(build_scene(cloud, config, components=[screw]))
    with torch.device("meta"):
        result = register(cloud, data, config, holes=holes)
    assert len(result.screws_found) == 1


@pytest.mark.parametrize("model", ["modes", "fe"])
def test_a_scene_moves_as_a_whole(model: str) -> None:
    here = scene(CONFIG.model_copy(update={"deformation": model}), components=[SCREW])
    if model == "modes":
        bend(here, 0.02)
    moved = copy.deepcopy(here).to("meta")
    tensors = tensors_of(moved, set())
    assert len(tensors) > 20
    assert all(tensor.is_meta for tensor in tensors)


def test_images_in_double_precision_are_registered_in_it() -> None:
    data = image(scene(CONFIG, pose(0.2, 0.2)))
    exact = type(data)(data.geometry, data.line_integrals.double())
    config = CONFIG.model_copy(update={"stages": RIGID[1:2]})
    assert register(plate(), exact, config).gc.dtype == torch.float64
    assert register(plate(), data, config).gc.dtype == torch.float32


@pytest.mark.parametrize("device", ["cuda"])
def test_a_registration_runs_on_a_device(device: str) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no such device here")
    data = image(scene(CONFIG, pose(0.5, 0.5), components=[SCREW]))
    expected = register(plate(), data, CONFIG, components=[SCREW])
    result = register(plate().to(device), data.to(device), CONFIG, components=[SCREW])
    points = plate().points
    torch.testing.assert_close(result.warp(points).cpu(), expected.warp(points), atol=0.02, rtol=0)
