import pytest
import torch
import trimesh

from torchkcreg.callbacks import Callback
from torchkcreg.geometry import VolumeGrid, circular_geometry
from torchkcreg.implant import KnownComponent
from torchkcreg.physics import material, tungsten_spectrum
from torchkcreg.reconstruction import (
    BeamModel,
    PWLSConfig,
    component_path_lengths,
    known_materials,
    prepare,
    reconstruct,
    unknown_share,
    with_components,
)
from torchkcreg.simulation import FlatPanel, Part, simulate_projections
from torchkcreg.simulation.solids import Cylinder

PANEL = {"sad": 404, "sdd": 538, "det_shape": (24, 56), "pixel_spacing": (2.0, 2.0)}
GRID = VolumeGrid.centered((12, 26, 26), 2.5)
SPECTRUM = tungsten_spectrum(90)


def bar(extents=(5.0, 14.0, 60.0), offset=(6.0, 4.0, 0.0)):
    box = trimesh.creation.box(extents)
    box.apply_translation(offset)
    return box


@pytest.fixture(scope="module")
def scan():
    """Transmissions of a titanium bar in water, and of the water alone; noiseless."""
    geometry = circular_geometry(range(0, 200, 5), **PANEL)
    axis = torch.tensor([0.0, 0.0, 60.0])
    water = Part("bath", Cylinder(-axis, axis, 28.0), "water")
    plate = Part("bar", bar(), "titanium", inside="bath")
    panel = FlatPanel.ideal()
    images = [
        simulate_projections(geometry, parts, SPECTRUM, panel=panel).float() / panel.open_beam
        for parts in ([plate, water], [water])
    ]
    return geometry, *images


def test_a_mesh_fills_the_voxels_it_lies_in():
    component = KnownComponent.from_mesh(bar(), "titanium", pitch=0.5)
    assert float(component.fraction(GRID).sum()) * GRID.voxel_volume == pytest.approx(5 * 14 * 30, rel=1e-5)
    cloud_only = KnownComponent(component.cloud, "titanium")
    assert float(cloud_only.fraction(GRID).sum()) == pytest.approx(float(component.fraction(GRID).sum()), rel=0.02)
    mask = unknown_share([component], GRID)
    assert mask.min() == 0 and mask.max() == 1


def test_path_lengths_come_by_material():
    geometry = circular_geometry([0, 90], **PANEL)
    parts = [KnownComponent.from_mesh(bar(), name, pitch=0.5) for name in ("titanium", "steel")]
    lengths = component_path_lengths([*parts, parts[0]], geometry)
    assert known_materials([*parts, parts[0]]) == ["titanium", "steel"]
    assert torch.allclose(lengths[0], 2 * lengths[1])
    assert lengths[1, 0, 12, :].max() == pytest.approx(5.0, rel=0.02)  # seen along x


def test_what_stands_behind_the_bar_is_the_water_around_it(scan):
    geometry, with_bar, alone = scan
    component = KnownComponent.from_mesh(bar(), "titanium", pitch=0.5)
    beam = BeamModel.polyenergetic([material("titanium")], SPECTRUM)
    seen = prepare(with_bar, geometry, beam, components=[component]).line_integrals
    water = prepare(alone, geometry, BeamModel.polyenergetic([], SPECTRUM)).line_integrals
    lengths = component_path_lengths([component], geometry)[0]
    expected = water - beam.water * lengths
    deep = lengths > 3
    assert (seen - expected)[deep].abs().mean() < 0.03
    raw = -with_bar.log()
    assert (raw - water)[deep].mean() > 0.5


def test_known_components_halve_the_error_of_plain_pwls(scan):
    geometry, with_bar, alone = scan
    component = KnownComponent.from_mesh(bar(), "titanium", pitch=0.5)
    plain = BeamModel.polyenergetic([], SPECTRUM)
    beam = BeamModel.polyenergetic([material("titanium")], SPECTRUM)
    config = PWLSConfig(iterations=8, subsets=5, beta=1.0)
    truth = reconstruct(alone, geometry, GRID, plain, config=config).volume
    pwls = reconstruct(with_bar, geometry, GRID, plain, config=config).volume
    kcrec = reconstruct(with_bar, geometry, GRID, beam, config=config, components=[component], passes=2).volume
    near = (GRID.points()[..., :2].norm(dim=-1) < 24) & (unknown_share([component], GRID) == 1)

    def error(volume):
        return float((volume - truth)[near].square().mean().sqrt())

    assert error(kcrec) < 0.5 * error(pwls)
    assert float(kcrec[near].mean()) == pytest.approx(beam.water, rel=0.03)


def test_a_run_stopped_in_its_second_pass_resumes_to_the_same_volume(scan):
    geometry, with_bar, _ = scan
    component = KnownComponent.from_mesh(bar(), "titanium", pitch=0.5)
    beam = BeamModel.polyenergetic([material("titanium")], SPECTRUM)
    config = PWLSConfig(iterations=3, subsets=5)
    options = {"config": config, "components": [component], "passes": 2}
    kept = {}

    class Keeps(Callback):
        def on_iteration(self, run, index, progress):
            if index == 1 and progress["iteration"] == 1:
                kept.update({"pass": index, "solver": run.state_dict(), "volume": run.initial})

    whole = reconstruct(with_bar, geometry, GRID, beam, callbacks=[Keeps()], **options)
    resumed = reconstruct(with_bar, geometry, GRID, beam, state=kept, **options)
    assert torch.equal(resumed.volume, whole.volume)


def test_the_implant_goes_back_into_the_volume():
    component = KnownComponent.from_mesh(bar(), "titanium", pitch=0.5)
    whole = with_components(torch.full(GRID.shape, 0.02), [component], GRID, [0.1])
    filled = component.fraction(GRID)
    assert torch.allclose(whole, 0.02 * (1 - filled) + 0.1 * filled, atol=1e-4)


def test_what_does_not_fit_is_named(scan):
    geometry, with_bar, _ = scan
    component = KnownComponent.from_mesh(bar(), "titanium", pitch=1.0)
    with pytest.raises(ValueError, match=r"attenuation of each material \(titanium\), got 0"):
        prepare(with_bar, geometry, BeamModel.monoenergetic([]), components=[component])
    with pytest.raises(ValueError, match="transmission must be finite numbers of shape"):
        prepare(with_bar[:3], geometry, BeamModel.monoenergetic([]))
    with pytest.raises(ValueError, match="passes must be at least 1"):
        reconstruct(with_bar, geometry, GRID, BeamModel.monoenergetic([]), passes=0)
