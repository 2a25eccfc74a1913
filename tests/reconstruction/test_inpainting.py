"""Known metal is interpolated across: what it leaves in an FDK."""

import pytest
import torch
import trimesh

from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import tungsten_spectrum
from torchkcreg.reconstruction import BeamModel, component_path_lengths, fdk, inpainted, prepare
from torchkcreg.simulation import FlatPanel, Part, simulate_projections
from torchkcreg.simulation.solids import Cylinder

PANEL = {"sad": 404, "sdd": 538, "det_shape": (24, 56), "pixel_spacing": (2.0, 2.0)}
GRID = VolumeGrid.centered((6, 26, 26), 2.5)
SPECTRUM = tungsten_spectrum(90)


@pytest.fixture(scope="module")
def volumes():
    """FDKs of a steel bar in water as it is, around the bar, and of the water alone; where metal is."""
    geometry = circular_geometry(range(0, 360, 4), **PANEL)
    axis = torch.tensor([0.0, 0.0, 60.0])
    bar = trimesh.creation.box((5.0, 12.0, 60.0))
    bar.apply_translation((6.0, 4.0, 0.0))
    water = Part("bath", Cylinder(-axis, axis, 28.0), "water")
    plate = Part("bar", bar, "steel", inside="bath")
    panel = FlatPanel.ideal()
    with_bar, without = (
        simulate_projections(geometry, parts, SPECTRUM, panel=panel).float() / panel.open_beam
        for parts in ([plate, water], [water])
    )
    beam = BeamModel.polyenergetic([], SPECTRUM)
    component = KnownComponent.from_mesh(bar, "steel", pitch=0.5)
    lines, clean = (prepare(images, geometry, beam).line_integrals for images in (with_bar, without))
    around = inpainted(lines, component_path_lengths([component], geometry))
    made = [fdk(images, geometry, GRID) for images in (lines, around, clean)]
    return *made, torch.nn.functional.max_pool3d(component.fraction(GRID)[None].float(), 3, 1, 1)[0] > 0


def test_streaks_beside_known_metal_fall_to_a_small_part(volumes):
    plain, around, clean, metal = volumes
    inside = (clean > 0.9 * clean.max()) & ~metal
    streaks, left = ((volume - clean)[inside].square().mean().sqrt() for volume in (plain, around))
    assert float(left) < 0.2 * float(streaks)
    assert float((around - clean)[inside].mean().abs()) < 0.01 * float(clean.max())


def test_nothing_changes_beside_the_shadow():
    lines, metal = torch.rand(2, 6, 7), torch.zeros(1, 2, 6, 7)
    metal[0, 0, 3, 3] = 2.0
    around = inpainted(lines, metal)
    changed = around != lines
    assert bool(changed[0, 2:5, 2:5].all()) and int(changed.sum()) == 9
    assert int((inpainted(lines, metal, margin_px=0) != lines).sum()) == 1


def test_dead_pixels_are_no_neighbours():
    lines, mask = torch.full((1, 5, 5), 2.0), torch.ones(1, 5, 5)
    lines[0, 2, 1], mask[0, 2, 1] = torch.nan, 0.0
    metal = torch.zeros(1, 1, 5, 5)
    metal[0, 0, 2, 2] = 3.0
    torch.testing.assert_close(inpainted(lines, metal, mask=mask, margin_px=0), torch.full((1, 5, 5), 2.0))


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="metal must have shape"):
        inpainted(torch.zeros(1, 5, 5), torch.zeros(1, 5, 5))
    with pytest.raises(ValueError, match="margin_px must not be negative"):
        inpainted(torch.zeros(1, 5, 5), torch.zeros(1, 1, 5, 5), margin_px=-1)
    with pytest.raises(ValueError, match="no valid one"):
        inpainted(torch.zeros(1, 5, 5), torch.ones(1, 1, 5, 5))
