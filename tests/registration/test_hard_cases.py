"""Whole registrations of kinds of cases that once ended far off without a word."""

from dataclasses import replace

import pytest
import torch

from torchkcreg.registration import RegistrationConfig, Trainer, build_scene
from torchkcreg.simulation import draw_case, random_case
from torchkcreg.studies.capture import registration_inputs

KINDS = {
    "a limb of water": {"water_radius": 45.0, "material": "steel", "screw_material": "steel", "azimuth_deg": 45.0},
    "titanium face on": {"material": "titanium", "screw_material": "titanium", "azimuth_deg": 91.0},
    "short and narrow": {"num_holes": 6, "width": 11.0, "pitch": 14.5, "holes_used": (0, 2, 3, 5), "loose": None},
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_hard_kind_of_case_is_right(kind: str) -> None:
    case = random_case(replace(draw_case(9), heads=False, scanner="extremity", **KINDS[kind]))
    config = RegistrationConfig(material=case.implant_material)
    data, cloud, screws = registration_inputs(case, config.pitch_mm)
    scene = build_scene(cloud, config, spectrum=case.spectrum, components=screws)
    result = Trainer(scene, data, config).fit()
    nodes = cloud.coarsened(8).points.double()
    errors = result.warp(nodes) - case.deform(nodes)
    assert float(errors.square().sum(-1).mean().sqrt()) < 0.15
    assert bool(torch.isfinite(errors).all())
    # One limb from one side hardly tells one kind of scatter from the other.
    assert 0.0 < result.intensity["scatter"] + result.intensity["scatter_removed"] < 0.6
    assert result.intensity["blur_sigma_px"] > 0.1
