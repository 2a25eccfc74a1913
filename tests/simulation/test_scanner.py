"""The simulated scanner: path lengths by material, expected counts, blur, scatter, noise, saturation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import trimesh

from torchkcreg.geometry import ConeBeamGeometry, circular_geometry
from torchkcreg.physics import Spectrum, material, tungsten_spectrum
from torchkcreg.simulation import Cylinder, FlatPanel, Part, Sphere, Tube, material_paths, simulate_projections

GEOMETRY = circular_geometry([0.0], sad=400, sdd=600, det_shape=(64, 64), pixel_spacing=(0.5, 0.5))
MATRIX = GEOMETRY.projection_matrices[0]
MONO = Spectrum((60.0,), (1.0,))
IDEAL = FlatPanel.ideal()
BLOCK = Part("block", trimesh.creation.box([8.0, 60.0, 60.0]), "aluminium")


def test_a_wide_slab_attenuates_as_beer_lambert_says():
    counts = simulate_projections(GEOMETRY, [BLOCK], MONO, panel=IDEAL)
    assert counts.dtype == torch.uint16
    expected = 60000 * math.exp(-8.0 * float(material("aluminium").attenuation(60.0)))
    assert float(counts[0, 32, 32].item()) == pytest.approx(expected, abs=1.0)


def test_an_empty_beam_reads_the_open_beam():
    counts = simulate_projections(GEOMETRY, [], MONO, panel=IDEAL)
    assert (counts.int() == 60000).all()


def test_transmission_is_averaged_after_the_exponential():
    # an opaque edge through the middle of column 32, whose centre is 0.25 mm off the middle on the detector
    edge = trimesh.creation.box([2.0, 20.0, 60.0]).apply_translation([0.0, 10.0 + 0.25 * 400 / 600, 0.0])
    counts = simulate_projections(GEOMETRY, [Part("edge", edge, "lead")], MONO, panel=IDEAL)
    assert counts[0, 32, 31:34].int().tolist() == pytest.approx([60000, 30000, 0], abs=300)


def test_a_screw_displaces_the_bone_around_it():
    bone = Part("bone", Tube([0.0, 0.0, -20.0], [0.0, 0.0, 20.0], 6.0, 3.0), "cortical_bone")
    screw = Part("screw", Cylinder([-9.0, 0.0, 0.0], [9.0, 0.0, 0.0], 1.0), "steel", displaces=("bone",))
    apart, together = (material_paths(parts, MATRIX, (64, 64)) for parts in ([bone], [bone, screw]))
    column = 32, 32
    assert float(together["steel"][column]) == pytest.approx(18.0, rel=1e-3)
    assert float(apart["cortical_bone"][column]) == pytest.approx(6.0, rel=1e-3)
    assert float(together["cortical_bone"][column].abs()) < 1e-9
    assert float(together["cortical_bone"].min()) > -1e-9


def test_what_stands_inside_is_missing_from_what_is_around():
    bath = Part("bath", Cylinder([0.0, 0.0, -60.0], [0.0, 0.0, 60.0], 15.0), "water")
    parts = [
        bath,
        Part("plate", trimesh.creation.box([4.0, 10.0, 10.0]), "titanium", inside="bath"),
        Part("bead", Sphere([0.0, 9.0, 0.0], 2.0), "titanium", inside="bath"),
    ]
    alone, full = material_paths([bath], MATRIX, (64, 64)), material_paths(parts, MATRIX, (64, 64))
    torch.testing.assert_close(full["water"] + full["titanium"], alone["water"])
    assert float(full["titanium"].max()) > 3.9


def test_focal_spot_and_scintillator_keep_the_sum_and_widen_an_edge():
    bead = [Part("bead", Sphere([0.0, 0.0, 0.0], 3.0), "steel")]
    sharp = simulate_projections(GEOMETRY, bead, MONO, panel=IDEAL).double()
    for panel in (replace(IDEAL, focal_spot_mm=3.0), replace(IDEAL, half_contrast_lp_mm=0.3)):
        blurred = simulate_projections(GEOMETRY, bead, MONO, panel=panel).double()
        assert float(sharp.sum()) == pytest.approx(float(blurred.sum()), rel=1e-4)
        assert float(blurred.diff(dim=-1).abs().max()) < 0.7 * float(sharp.diff(dim=-1).abs().max())


def test_scatter_is_smooth_and_as_strong_as_asked():
    parts = [Part("bead", Sphere([0.0, 0.0, 0.0], 8.0), "aluminium")]
    without = simulate_projections(GEOMETRY, parts, MONO, panel=IDEAL).double()
    scatter = simulate_projections(GEOMETRY, parts, MONO, panel=IDEAL, scatter_to_primary=0.05).double() - without
    shadow = without < 0.9 * 60000
    assert float(scatter[shadow].mean() / without[shadow].mean()) == pytest.approx(0.05, rel=0.01)
    assert float(scatter.diff(dim=-1).abs().max()) < 0.05 * float(scatter.max())


def test_noise_has_the_variance_of_its_photons_and_electronics():
    noisy = FlatPanel.ideal(open_beam=2000.0, photons=1e4, electronic_noise=5.0, bits=12)
    counts = simulate_projections(GEOMETRY, [], MONO, panel=noisy).double()
    assert float(counts.mean()) == pytest.approx(2000.0, abs=2.0)
    assert float(counts.var()) == pytest.approx(2000.0**2 / 1e4 + 25.0 + 1 / 12, rel=0.1)


def test_the_seed_decides_the_noise():
    first, again, other = (simulate_projections(GEOMETRY, [BLOCK], MONO, seed=seed).int() for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_a_bright_beam_saturates_at_the_detectors_range():
    bright = FlatPanel(open_beam=5000.0)
    counts = simulate_projections(GEOMETRY, [], MONO, panel=bright)
    assert bright.saturation == 4095
    assert (counts.int() == 4095).all()


def test_wrong_scenes_and_detectors_are_refused():
    bead = Part("bead", Sphere([0.0, 0.0, 0.0], 3.0), "steel")
    hole = trimesh.creation.box([4.0, 4.0, 4.0])
    hole.update_faces([True] * 11 + [False])
    for parts, message in (
        ([bead, bead], "unique names"),
        ([replace(bead, inside="bath")], "must refer to one of bead, got 'bath'"),
        ([Part("open", hole, "steel")], "must be closed"),
        ([BLOCK, replace(bead, displaces=("block",))], "must be solids"),
    ):
        with pytest.raises(ValueError, match=message):
            material_paths(parts, MATRIX, (64, 64))
    for wrong in ({"glare": -0.1}, {"photons": 0.0}, {"bits": 17}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            FlatPanel(**wrong)


def test_views_of_several_sources_are_taken_in_their_own_spectra():
    circle = circular_geometry([0, 90], sad=404, sdd=538, det_shape=(6, 8), pixel_spacing=(4.0, 4.0))
    geometry = ConeBeamGeometry(circle.projection_matrices, (6, 8), (4.0, 4.0), sources=["low", "high"])
    parts = [Part("ball", Sphere(torch.zeros(3), 10.0), "water")]
    spectra = {"low": tungsten_spectrum(70), "high": tungsten_spectrum(120)}
    detector = FlatPanel().without_noise()
    both = simulate_projections(geometry, parts, spectra, panel=detector)
    for view, spectrum in enumerate(spectra.values()):
        alone = simulate_projections(geometry.select([view]), parts, spectrum, panel=detector)
        assert torch.equal(both[view], alone[0])
    assert not torch.equal(both[0], both[1])
    with pytest.raises(ValueError, match="got none for high"):
        simulate_projections(geometry, parts, {"low": spectra["low"]})
    with pytest.raises(ValueError, match="got none for no source"):
        simulate_projections(circle, parts, spectra)
