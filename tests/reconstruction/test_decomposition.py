"""Water and calcium out of two tube voltages: simulated rods beside a titanium plate in a water bath."""

from __future__ import annotations

import pytest
import torch
import trimesh

from torchkcreg.evaluation import cylinder_region, region_statistics
from torchkcreg.geometry import ConeBeamGeometry, VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import tungsten_spectrum
from torchkcreg.reconstruction import PWLSConfig, decompose
from torchkcreg.simulation import FlatPanel, Part, simulate_projections
from torchkcreg.simulation.solids import Cylinder

VIEWS = 90
SPECTRA = {"low": tungsten_spectrum(70), "high": tungsten_spectrum(120)}
GRID = VolumeGrid.centered((28, 52, 52), 1.5)
RODS = {"ca50": (-18.0, -8.0), "ca100": (0.0, -18.0), "ca200": (18.0, -6.0)}


def rod(x: float, y: float, radius: float) -> Cylinder:
    return Cylinder(torch.tensor([x, y, -45.0]), torch.tensor([x, y, 45.0]), radius)


def plate() -> trimesh.Trimesh:
    box = trimesh.creation.box((22.0, 4.0, 12.0))
    box.apply_translation((0.0, 4.0, 0.0))
    return box


@pytest.fixture(scope="module")
def scan() -> tuple[ConeBeamGeometry, torch.Tensor]:
    """Views at two voltages in turns, and their transmissions with noise."""
    circle = circular_geometry(
        [i * 360 / VIEWS for i in range(VIEWS)], sad=404, sdd=538, det_shape=(30, 76), pixel_spacing=(1.5, 1.5)
    )
    sources = ["low" if i % 2 == 0 else "high" for i in range(VIEWS)]
    geometry = ConeBeamGeometry(circle.projection_matrices, circle.det_shape, circle.pixel_spacing, sources=sources)
    parts = [Part("bath", rod(0.0, 0.0, 34.0), "water"), Part("plate", plate(), "titanium", inside="bath")]
    parts += [Part(name, rod(*place, 6.0), name, inside="bath") for name, place in RODS.items()]
    panel = FlatPanel.ideal(photons=2e4, electronic_noise=2.0)
    return geometry, simulate_projections(geometry, parts, SPECTRA, panel=panel).float() / panel.open_beam


def test_rods_are_recovered_beside_a_plate(scan):
    geometry, transmission = scan
    metal = [KnownComponent.from_mesh(plate(), "titanium", pitch=0.4)]
    found = decompose(transmission, geometry, GRID, SPECTRA, components=metal)
    for name, place in RODS.items():
        region = cylinder_region(GRID, (*place, -9.0), (*place, 9.0), 3.5)
        calcium = region_statistics(found.calcium_mg_ml, region)
        assert calcium.mean == pytest.approx(float(name[2:]), abs=7), name  # noise of a small region
        assert region_statistics(found.water, region).mean == pytest.approx(1.0, abs=0.04)
        assert region_statistics(found.single_mg_ml, region).mean == pytest.approx(float(name[2:]), abs=8)
    assert found.history[-1] < found.history[0] < 0.03
    assert found.mask is not None and float(found.water.min()) >= 0


@pytest.mark.slow
def test_tissue_lighter_than_water_is_no_lack_of_calcium(scan):
    """One voltage cannot tell light tissue from less calcium; two can."""
    geometry, _ = scan
    bath = Part("bath", rod(0.0, 0.0, 30.0), "adipose_tissue")
    panel = FlatPanel.ideal()
    images = simulate_projections(geometry, [bath], SPECTRA, panel=panel).float()
    found = decompose(images / panel.open_beam, geometry, GRID, SPECTRA, config=PWLSConfig(iterations=20, subsets=5))
    inside = cylinder_region(GRID, (0, 0, -9), (0, 0, 9), 20.0)
    both = region_statistics(found.calcium_mg_ml, inside).mean
    alone = region_statistics(found.single_mg_ml, inside).mean
    assert alone < -30 and abs(both) < 0.6 * abs(alone)
    assert region_statistics(found.water, inside).mean < 1.0


def test_what_cannot_be_decomposed_is_refused(scan):
    geometry, transmission = scan
    bare = ConeBeamGeometry(geometry.projection_matrices, geometry.det_shape, geometry.pixel_spacing)
    with pytest.raises(ValueError, match="views need sources"):
        decompose(transmission, bare, GRID, SPECTRA)
    with pytest.raises(ValueError, match="got none for high"):
        decompose(transmission, geometry, GRID, {"low": SPECTRA["low"]})
    with pytest.raises(ValueError, match="two materials need two spectra"):
        decompose(transmission, geometry, GRID, {"low": SPECTRA["low"], "high": SPECTRA["low"]})
