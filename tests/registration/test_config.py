"""Options of a registration: the paper's preset is what the paper says."""

from __future__ import annotations

import pytest
import torch
from small_scene import plate

from torchkcreg.deformation import Level
from torchkcreg.deformation.penalty import diffusion_penalty
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.registration import Implant, RegistrationConfig
from torchkcreg.registration.implant import deformation_of


def test_the_paper_preset_has_the_papers_settings_and_nothing_beside_them() -> None:
    config = RegistrationConfig(preset="paper")
    assert (config.grid_shape, config.grid_spacing_mm) == ((6, 6, 10), (8.75, 8.75, 25.0))  # section 2.4
    grid = deformation_of(Implant(plate()), config).grid
    assert grid.shape == (6, 6, 10) and grid.spacing == (8.75, 8.75, 25.0)
    start, rigid, *bending = config.schedule()
    assert start.level.is_rigid and rigid.level.is_rigid
    assert [stage.groups for stage in bending] == [2, 4, 6, 8, 10]  # section 2.4
    assert start.optimizer == "cmaes"
    for stage in (rigid, *bending):
        assert (stage.optimizer, stage.population, stage.iterations) == ("cmaes", 40, 400)  # section 2.3
    for stage in config.schedule():
        assert stage.similarity == "gradient-correlation"  # eq. 4
        assert stage.modes is None and stage.estimate == stage.before == stage.after == ()
    assert config.material is None and not config.find_screws and config.view_motion == "off"
    assert not config.undo_stages and config.deformation == "ffd"


def test_the_paper_presets_objective_is_gradient_correlation_and_the_diffusion_penalty() -> None:
    config = RegistrationConfig(preset="paper")
    cloud = plate()
    deformation = deformation_of(Implant(cloud), config)
    motion = deformation.motion(cloud, Level(2))
    steps = torch.randn(3, motion.num_parameters, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = config.beta * diffusion_penalty(motion.control_points(steps), deformation.grid)  # eq. 5
    assert (expected > 1e-6).all()
    torch.testing.assert_close(motion.penalty(steps), expected)


def test_what_is_given_beside_the_paper_preset_counts() -> None:
    config = RegistrationConfig.of({"preset": "paper", "material": "steel", "stiffness": 30.0, "grid_grows": True})
    assert (config.material, config.stiffness, config.grid_grows) == ("steel", 30.0, True)
    assert config.grid_spacing_mm == (8.75, 8.75, 25.0)
    assert RegistrationConfig.of(config.model_dump()) == config
    assert RegistrationConfig().stiffness == 30.0


def test_an_implant_longer_than_a_grid_that_may_not_grow_is_refused() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)).double() * torch.tensor([10.0, 4.0, 260.0])
    long = ImplantPointCloud(points, torch.ones(500).double(), torch.eye(3).double())
    with pytest.raises(ValueError, match=r"260 mm, is longer than the grid of 6 x 6 x 10 .*grid_grows"):
        deformation_of(Implant(long), RegistrationConfig(preset="paper"))
