import pytest
import torch

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.io import read_geometry, read_mesh, read_projections
from torchkcreg.registration import RegistrationConfig, RegistrationData, Stage, Trainer, build_scene
from torchkcreg.visualization import draw_registration
from torchkcreg.visualization.registration import start_scene


@pytest.fixture(scope="module")
def registered(small_case):
    """Scene, data and result of a quick registration without material."""
    stages = (Stage(bin=4, iterations=2, oversampling=1), Stage(groups=2, bin=2, iterations=3, oversampling=1))
    config = RegistrationConfig(pitch_mm=1.0, stages=stages)
    geometry = read_geometry(small_case / "geometry.json")
    projections = read_projections(small_case / "projections.npz")
    data = RegistrationData(geometry, projections.line_integrals, projections.mask)
    scene = build_scene(ImplantPointCloud.from_mesh(read_mesh(small_case / "implant.stl"), 1.0), config)
    return scene, data, Trainer(scene, data, config).fit()


def texts(figure):
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def test_the_figures_are_those_of_a_run_folder(registered):
    _, data, result = registered
    figures = draw_registration(result, data, [torch.eye(4, dtype=torch.float64)])
    assert list(figures) == ["overlay.png", "displacement.png", "history.png"]


def test_the_overlay_shows_the_gradient_correlations_of_the_start_and_of_the_result(registered):
    _, data, result = registered
    overlay = draw_registration(result, data, [torch.eye(4, dtype=torch.float64)])["overlay.png"]
    written = [float(text.split()[1]) for text in texts(overlay) if text.startswith("GC")]
    before, after = written[:3], written[3:]
    assert after == pytest.approx(result.gc.tolist(), abs=0.01)
    assert all(b < a for b, a in zip(before, after, strict=True))


def test_of_many_views_six_are_drawn(registered):
    _, data, result = registered
    many = data.select([0, 1, 2] * 4)
    overlay = draw_registration(result, many, [torch.eye(4, dtype=torch.float64)])["overlay.png"]
    assert len([text for text in texts(overlay) if text.startswith("GC")]) == 12


def test_the_start_is_undeformed_and_leaves_the_scene_as_it_is(registered):
    scene, _, _ = registered
    phi = scene.assemblies[0].deformation.control_points.detach().clone()
    pose = torch.eye(4, dtype=torch.float64)
    start = start_scene(scene, [pose])
    assert not start.assemblies[0].deformation.control_points.any()
    assert torch.equal(start.assemblies[0].implant_to_world, pose)
    assert phi.any()
    assert torch.equal(scene.assemblies[0].deformation.control_points, phi)
