"""Whole simulated cases: truth and images belong together."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchkcreg.physics import PolyenergeticTransmission, material
from torchkcreg.projector.mesh import project_mesh
from torchkcreg.simulation import weight_bearing_case
from torchkcreg.simulation.bench import LoadRecipe, PanelRecipe

SMALL = {"views": [48], "binning": 8}
CLEAN = {"panel": PanelRecipe(noise=False), "scatter_to_primary": 0.1}


def plate_shadow(case, vertices: torch.Tensor) -> torch.Tensor:
    """Line integrals of the plate alone."""
    faces = torch.tensor(case.implant.faces)
    path = project_mesh(vertices, faces, case.geometry.projection_matrices, case.geometry.det_shape)
    return PolyenergeticTransmission([material("steel")], case.spectrum, scatter=0.1)(path[None]).detach()


def test_without_a_load_nothing_moves():
    case = weight_bearing_case(0.0, **SMALL)
    torch.testing.assert_close(case.beads_after, case.beads_before)
    np.testing.assert_allclose(case.deformed_implant().vertices, case.implant.vertices, atol=1e-9)


def test_the_image_shows_the_plate_where_the_truth_has_it():
    case = weight_bearing_case(1.5, **CLEAN, **SMALL)
    data = case.data()
    assert data.mask.all()
    measured = data.line_integrals
    before = torch.tensor(np.asarray(case.implant.vertices))
    errors = []
    for vertices in (before, case.deform(before)):
        shadow = plate_shadow(case, vertices)
        behind = shadow > 0.5 * shadow.max()
        errors.append(float(shadow[behind].sub(measured[behind]).clamp_min(0).mean()))
    assert errors[1] < 0.2 * errors[0]


def test_loads_move_beads_and_plate_by_millimetres():
    case = weight_bearing_case(1.0, seed=3, **SMALL)
    moved = (case.beads_after - case.beads_before).norm(dim=1)
    assert float(moved.min()) > 0.5
    assert float(moved.max()) < 5
    torch.testing.assert_close(case.deform(case.beads_before), case.beads_after, rtol=0, atol=1e-3)


def test_the_seed_decides_misalignment_and_noise():
    first, again, other = (weight_bearing_case(1.0, seed=seed, **SMALL) for seed in (1, 1, 2))
    assert torch.equal(first.intensity.int(), again.intensity.int())
    assert not torch.allclose(first.beads_after, other.beads_after)


def test_the_s_bend_has_four_screws_and_parallel_ends():
    case = weight_bearing_case(1.0, mode="s_bend", **SMALL)
    assert len(case.screws) == 4
    assert case.load.s_bend == 3.0
    assert case.load.zone == 63.0


def test_a_load_of_ones_own_is_taken_as_it_is():
    load = LoadRecipe.of({"torsion": "2 deg"})
    assert weight_bearing_case(load, **SMALL).load is load


def test_soft_tissue_darkens_the_background_only():
    bare = weight_bearing_case(0.0, **{**CLEAN, "scatter_to_primary": 0.0}, **SMALL)
    covered = weight_bearing_case(0.0, **{**CLEAN, "scatter_to_primary": 0.0}, tissue_radius_mm=40.0, **SMALL)
    assert (covered.intensity.int() <= bare.intensity.int()).all()
    paths = {part.name for part in covered.parts} - {part.name for part in bare.parts}
    assert paths == {"tissue"}


def test_the_three_default_views_come_from_three_sources():
    case = weight_bearing_case(0.0, det_shape=(256, 64), binning=8)
    assert case.geometry.sources == ("T1", "T2", "T3")
    assert case.intensity.shape == (3, 32, 8)


def test_wrong_requests_are_refused():
    with pytest.raises(ValueError, match="mode"):
        weight_bearing_case(mode="sideways")
    with pytest.raises(ValueError, match="det_shape"):
        weight_bearing_case(det_shape=(1000, 10))
    with pytest.raises(ValueError, match="tissue_radius_mm"):
        weight_bearing_case(tissue_radius_mm=10.0)
