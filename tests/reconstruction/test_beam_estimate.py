"""A beam that nobody knows, out of the shadow of known metal: simulated scans of a bar in a water bath."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import Beam, material, tungsten_spectrum
from torchkcreg.reconstruction import BeamModel, component_path_lengths, estimate_beam
from torchkcreg.simulation import FlatPanel, Part, simulate_projections
from torchkcreg.simulation.solids import Cylinder
from torchkcreg.visualization import beam_figure

GRID = VolumeGrid.centered((16, 32, 32), 2.2)
GEOMETRY = circular_geometry(range(0, 360, 6), sad=404, sdd=538, det_shape=(32, 80), pixel_spacing=(1.4, 1.4))
THICKNESSES = torch.tensor([1.0, 3.0, 6.0], dtype=torch.float64)


def bar() -> trimesh.Trimesh:
    box = trimesh.creation.box((6.0, 12.0, 30.0))
    box.apply_translation((8.0, 5.0, 0.0))
    return box


def component(name: str) -> KnownComponent:
    return KnownComponent.from_mesh(bar(), name, pitch=0.5)


@pytest.fixture(scope="module")
def scans() -> dict[tuple[str, float], torch.Tensor]:
    """Transmissions by the bar's alloy and the tube's voltage."""
    axis = torch.tensor([0.0, 0.0, 40.0])
    panel = FlatPanel.ideal(photons=2e4, electronic_noise=2.0)
    made = {}
    for alloy, kvp in (("titanium", 120.0), ("steel", 80.0)):
        parts = [Part("bar", bar(), alloy, inside="bath"), Part("bath", Cylinder(-axis, axis, 28.0), "water")]
        images = simulate_projections(GEOMETRY, parts, tungsten_spectrum(kvp), panel=panel)
        made[alloy, kvp] = images.float() / panel.open_beam
    return made


def curve(beam: BeamModel) -> torch.Tensor:
    """Line integrals of the first metal, of some thicknesses."""
    paths = torch.zeros(1, len(beam.attenuation), 1, 1, len(THICKNESSES), dtype=torch.float64)
    paths[0, 0, 0, 0] = THICKNESSES
    return -beam.beam.transmission(paths)[0, 0, 0].log()


@pytest.mark.parametrize(("alloy", "kvp"), [("titanium", 120.0), ("steel", 80.0)])
def test_the_voltage_is_found_and_what_the_metal_lets_through(scans, alloy, kvp):
    found = estimate_beam(scans[alloy, kvp], GEOMETRY, GRID, [component(alloy)])
    truth = curve(BeamModel.polyenergetic([material(alloy)], tungsten_spectrum(kvp)))
    wrong = curve(BeamModel.polyenergetic([material(alloy)], tungsten_spectrum(120.0 if kvp < 100 else 70.0)))
    error = (curve(found.beam) - truth).abs()
    assert float(error.max() / truth.max()) < 0.04
    assert float(error.max()) < 0.3 * float((wrong - truth).abs().max())
    assert abs(found.kvp - kvp) <= 20 and found.scales[0] == pytest.approx(1.0, abs=0.07)


def test_an_alloy_that_nobody_named_is_found_among_others(scans):
    found = estimate_beam(scans["steel", 80.0], GEOMETRY, GRID, [component("titanium")], alloys=("steel", "cocr"))
    assert found.alloys == ("steel",)
    assert found.scales[0] == pytest.approx(1.0, abs=0.1)
    other = estimate_beam(scans["titanium", 120.0], GEOMETRY, GRID, [component("steel")], alloys=("titanium", "cocr"))
    assert other.alloys == ("titanium",)


def test_scatter_that_is_more_than_was_told_is_not_taken_for_softer_metal(scans):
    primary = scans["steel", 80.0]
    level = 0.3 * float(primary.mean())
    without = estimate_beam(primary, GEOMETRY, GRID, [component("steel")])
    told = torch.full_like(primary, 0.96 * level)
    found = estimate_beam(primary + level, GEOMETRY, GRID, [component("steel")], scatter=told)
    assert found.scatter_scale == pytest.approx(1 / 0.96, abs=0.01)
    torch.testing.assert_close(curve(found.beam), curve(without.beam), rtol=0.02, atol=0)


def test_a_known_spectrum_is_where_it_starts(scans):
    spectrum = tungsten_spectrum(120.0)
    found = estimate_beam(scans["titanium", 120.0], GEOMETRY, GRID, [component("titanium")], spectrum=spectrum)
    truth = curve(BeamModel.polyenergetic([material("titanium")], spectrum))
    assert found.kvp is None
    torch.testing.assert_close(curve(found.beam), truth, rtol=0.05, atol=0)
    assert found.in_words()["alloys"] == ("titanium",)


def through_water(beam: BeamModel, mm: float = 45.0) -> float:
    """The line integral that the beam has behind so much water."""
    return float(-(beam.weights * torch.exp(-beam.background * beam.water * mm)).sum().log())


@pytest.mark.parametrize(("alloy", "kvp"), [("titanium", 120.0), ("steel", 80.0)])
def test_that_the_object_is_a_water_bath_fixes_the_scale(scans, alloy, kvp):
    truth = through_water(BeamModel.polyenergetic([material(alloy)], tungsten_spectrum(kvp)))
    found = estimate_beam(scans[alloy, kvp], GEOMETRY, GRID, [component(alloy)], soft_tissue=1.0)
    assert through_water(found.beam) == pytest.approx(truth, rel=0.01)
    muscle = estimate_beam(scans[alloy, kvp], GEOMETRY, GRID, [component(alloy)], soft_tissue=1.05)
    assert through_water(muscle.beam) < 0.97 * through_water(found.beam)  # water lets through more than muscle


def test_a_figure_shows_the_curve_and_the_pixels(scans):
    found = estimate_beam(scans["steel", 80.0], GEOMETRY, GRID, [component("steel")])
    axes = beam_figure(found.beam.beam, found.alloys, found.lengths_mm, found.measured).axes[0]
    drawn, points = axes.lines[0], axes.containers[0].lines[0]
    expected = np.interp(np.asarray(points.get_xdata(), dtype=float), drawn.get_xdata(), drawn.get_ydata())
    seen = expected > 1e-3  # what noise leaves of the rest is shown, and no more
    assert seen.sum() >= 5
    np.testing.assert_allclose(np.asarray(points.get_ydata(), dtype=float)[seen], expected[seen], rtol=0.15)


def test_what_tells_nothing_is_refused(scans):
    transmission = scans["titanium", 120.0]
    with pytest.raises(ValueError, match="there are no components"):
        estimate_beam(transmission, GEOMETRY, GRID, [])
    needle = trimesh.creation.box((0.3, 0.3, 2.0))
    with pytest.raises(ValueError, match="too few to estimate the beam: give a spectrum"):
        estimate_beam(transmission, GEOMETRY, GRID, [KnownComponent.from_mesh(needle, "titanium", pitch=0.1)])


def test_an_estimate_that_is_unlikely_is_told(scans):
    with pytest.warns(UserWarning, match="titanium is fitted with .* wrong metal"):
        estimate_beam(scans["steel", 80.0], GEOMETRY, GRID, [component("titanium")], spectrum=tungsten_spectrum(80.0))
    alone = component_path_lengths([component("titanium")], GEOMETRY)
    bare = Beam.of([material("titanium")], tungsten_spectrum(90.0)).transmission(alone[None].double())[0].float()
    with pytest.warns(UserWarning, match="there is no soft tissue around the metal"):
        estimate_beam(bare, GEOMETRY, GRID, [component("titanium")])
