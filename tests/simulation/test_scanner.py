"""The simulated scanner: path lengths by material, expected counts, blur, scatter, noise, saturation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import trimesh

from torchkcreg.geometry import ConeBeamGeometry, circular_geometry
from torchkcreg.physics import Spectrum, material, tungsten_spectrum
from torchkcreg.simulation import Cylinder, DetectorModel, Part, Sphere, Tube, material_paths, simulate_projections

GEOMETRY = circular_geometry([0.0], sad=400, sdd=600, det_shape=(64, 64), pixel_spacing=(0.5, 0.5))
MATRIX = GEOMETRY.projection_matrices[0]
MONO = Spectrum((60.0,), (1.0,))
IDEAL = DetectorModel(scatter_fraction=0.0, psf_sigma_mm=0.0, open_beam=60000.0, bits=16).without_noise()
BLOCK = Part("block", trimesh.creation.box([8.0, 60.0, 60.0]), "aluminium")


def test_a_wide_slab_attenuates_as_beer_lambert_says():
    counts = simulate_projections(GEOMETRY, [BLOCK], MONO, detector=IDEAL)
    assert counts.dtype == torch.uint16
    expected = 60000 * math.exp(-8.0 * float(material("aluminium").attenuation(60.0)))
    assert float(counts[0, 32, 32].item()) == pytest.approx(expected, abs=1.0)


def test_an_empty_beam_reads_the_open_beam():
    counts = simulate_projections(GEOMETRY, [], MONO, detector=IDEAL)
    assert (counts.int() == 60000).all()


def test_transmission_is_averaged_after_the_exponential():
    # an opaque edge through the middle of column 32, whose centre is 0.25 mm off the middle on the detector
    edge = trimesh.creation.box([2.0, 20.0, 60.0]).apply_translation([0.0, 10.0 + 0.25 * 400 / 600, 0.0])
    counts = simulate_projections(GEOMETRY, [Part("edge", edge, "lead")], MONO, detector=IDEAL)
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


def test_the_point_spread_keeps_the_sum_and_widens_an_edge():
    bead = [Part("bead", Sphere([0.0, 0.0, 0.0], 3.0), "steel")]
    sharp = simulate_projections(GEOMETRY, bead, MONO, detector=IDEAL).double()
    blurred = simulate_projections(GEOMETRY, bead, MONO, detector=replace(IDEAL, psf_sigma_mm=0.75)).double()
    assert float(sharp.sum()) == pytest.approx(float(blurred.sum()), rel=1e-5)
    assert float(blurred.diff(dim=-1).abs().max()) < 0.7 * float(sharp.diff(dim=-1).abs().max())


def test_scatter_is_a_smooth_share_of_the_primary():
    parts = [Part("bead", Sphere([0.0, 0.0, 0.0], 4.0), "lead")]
    with_scatter = replace(IDEAL, scatter_fraction=0.1, scatter_sigma_mm=6.0, open_beam=50000.0)
    without = replace(with_scatter, scatter_fraction=0.0)
    scatter = (
        simulate_projections(GEOMETRY, parts, MONO, detector=with_scatter).int()
        - simulate_projections(GEOMETRY, parts, MONO, detector=without).int()
    )
    assert int(scatter.max()) <= 5000
    assert 2000 < int(scatter[0, 32, 32]) < 4900
    assert int(scatter.diff(dim=-1).abs().max()) < 200


def test_noise_has_the_variance_of_its_photons_and_electronics():
    noisy = DetectorModel(scatter_fraction=0.0, open_beam=2000.0, photons=1e4, electronic_noise=5.0)
    counts = simulate_projections(GEOMETRY, [], MONO, detector=noisy).double()
    assert float(counts.mean()) == pytest.approx(2000.0, rel=2e-3)
    assert float(counts.var()) == pytest.approx(2000.0**2 / 1e4 + 25.0 + 1 / 12, rel=0.1)


def test_the_seed_decides_the_noise():
    first, again, other = (simulate_projections(GEOMETRY, [BLOCK], MONO, seed=seed).int() for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_a_bright_beam_saturates_at_the_detectors_range():
    bright = DetectorModel(open_beam=5000.0)
    counts = simulate_projections(GEOMETRY, [], MONO, detector=bright)
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
    for wrong in ({"scatter_fraction": -0.1}, {"photons": 0.0}, {"bits": 17}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            DetectorModel(**wrong)


def test_scatter_from_what_is_removed_vanishes_in_the_open_beam_and_glare_keeps_the_signal():
    scanner = replace(IDEAL, scatter_removed=0.3, glare_share=0.1)
    assert (simulate_projections(GEOMETRY, [], MONO, detector=scanner) == 60000).all()
    rod = Part("rod", Cylinder([0, 0, -9], [0, 0, 9], 3.0), "steel")
    sharp, scattered = (simulate_projections(GEOMETRY, [rod], MONO, detector=d)[0].float() for d in (IDEAL, scanner))
    assert float(scattered.min()) > float(sharp.min()) + 50


def test_views_of_several_sources_are_taken_in_their_own_spectra():
    circle = circular_geometry([0, 90], sad=404, sdd=538, det_shape=(6, 8), pixel_spacing=(4.0, 4.0))
    geometry = ConeBeamGeometry(circle.projection_matrices, (6, 8), (4.0, 4.0), sources=["low", "high"])
    parts = [Part("ball", Sphere(torch.zeros(3), 10.0), "water")]
    spectra = {"low": tungsten_spectrum(70), "high": tungsten_spectrum(120)}
    detector = DetectorModel().without_noise()
    both = simulate_projections(geometry, parts, spectra, detector=detector)
    for view, spectrum in enumerate(spectra.values()):
        alone = simulate_projections(geometry.select([view]), parts, spectrum, detector=detector)
        assert torch.equal(both[view], alone[0])
    assert not torch.equal(both[0], both[1])
    with pytest.raises(ValueError, match="got none for high"):
        simulate_projections(geometry, parts, {"low": spectra["low"]})
    with pytest.raises(ValueError, match="got none for no source"):
        simulate_projections(circle, parts, spectra)
