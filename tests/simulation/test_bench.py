"""Experiments out of recipes: what they are made of, where loads take them, what the panel reads."""

import ast
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml

import torchkcreg
from torchkcreg.evaluation import GapLoad, callus_stiffness
from torchkcreg.geometry import circular_geometry
from torchkcreg.physics import Spectrum, elastic_constants, material, tungsten_spectrum
from torchkcreg.plain import plain
from torchkcreg.simulation.bench import (
    ElasticConstruct,
    FlatPanel,
    LoadRecipe,
    Recipe,
    acquisitions,
    loaded,
    scattered,
    specimen,
    views_of,
)
from torchkcreg.simulation.bench.standing import parts_in_beam

MONO = Spectrum((60.0,), (1.0,))
QUIET = {"noise": False, "glare": 0, "half_contrast_lp_mm": 1e6, "bits": 16, "open_beam": 6e4}


def small(**changes) -> Recipe:
    """A short plate on four screws, in one coarse view."""
    options = {
        "implant": {"plate": {"length": "110 mm", "holes": 6, "hole_radius": "1.5 mm"}, "material": "titanium"},
        "screws": {"holes": [0, 1, 4, 5], "length": "30 mm", "radius": "1.4 mm"},
        "scanner": {"views": [48], "binning": 4},
        "panel": {"supersample": 1},
    }
    return Recipe.of(options | changes)


def only(recipe: Recipe, *, geometry=None, spectrum=MONO, **meshes):
    made = specimen(recipe, **meshes)
    views = views_of(recipe.scanner) if geometry is None else geometry
    return next(acquisitions(made, views, spectrum, progress=False))


def test_quantities_have_units():
    recipe = small(
        limb={"bone": {"axis": "[0, -1.7, 0] cm", "gap": "0.004 m"}, "beads": ["[1, 2, 3] mm", ["1 cm", "0 mm", 0]]},
        configurations={"a": {"bend": "0.05 rad"}, "b": {"force": "[0, 0, -0.3] kN", "at": "[0, 0, 0] mm"}},
        scatter_to_primary="25 %",
    )
    assert recipe.limb.bone.axis == (0.0, -17.0, 0.0)
    assert recipe.limb.bone.gap == 4.0
    assert recipe.limb.beads == ((1.0, 2.0, 3.0), (10.0, 0.0, 0.0))
    assert recipe.configurations["a"].bend == pytest.approx(math.degrees(0.05))
    assert recipe.configurations["b"].force == (0.0, 0.0, -300.0)
    assert recipe.scatter_to_primary == 0.25


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"screws": {"holes": [0], "lenght": "30 mm"}}, "screws.lenght"),
        ({"screws": {"length": 30}}, "a length in mm"),
        ({"screws": {"length": "30 kV"}}, "a length in mm"),
        ({"screws": {"length": "nan mm"}}, "a length"),
        ({"screws": {"tilt": "five deg"}}, "an angle such as"),
        ({"screws": {"holes": [0], "file": "screws.json"}}, "not from both"),
        ({"implant": {"material": "steel"}}, "either a mesh or a plate"),
        ({"limb": {"beads": ["[1, 2] mm"]}}, "three of a length"),
        ({"configurations": {"a": {"force": "[0, 0, 1] N", "bend": "1 deg"}}}, "either a force or angles"),
        ({"configurations": {"a/b": {}}}, "letters, digits"),
        ({"configurations": {}}, "no configuration"),
        ({"scatter_to_primary": "-1 %"}, "greater than or equal to 0"),
    ],
)
def test_wrong_recipes_are_refused_in_a_line(changes, message):
    with pytest.raises(ValueError, match=message) as refused:
        small(**changes)
    assert "\n" not in str(refused.value)


def test_a_recipe_that_is_written_is_read_again():
    recipe = small(limb={"tissue": {"radius": "4 cm"}}, configurations={"a": {"force": "[1, 2, 3] N"}})
    assert Recipe.of(plain(recipe.model_dump(mode="json"))) == recipe


def test_the_recipe_in_the_docs_is_right_and_its_parts_fit():
    text = (Path(__file__).resolve().parents[2] / "docs" / "experiments.md").read_text(encoding="utf-8")
    recipe = Recipe.of(yaml.safe_load(text.split("```yaml")[1].split("```")[0]))
    made = specimen(recipe)
    names = {part.name for part in parts_in_beam(made, loaded(made, recipe.configurations["unloaded"]))}
    assert {"plate", "screw5", "head0", "distal", "bead1", "insert0", "tissue"} <= names


def test_screws_stand_in_the_holes_that_are_named_tilted_and_into_the_bone():
    made = specimen(small(screws={"holes": [0, 5], "length": "30 mm", "tilt": "6 deg"}))
    heights = [made.holes[n].center[2] for n in (0, 5)]
    assert [screw.start[2] for screw in made.screws] == pytest.approx(heights)
    for screw in made.screws:
        direction = np.subtract(screw.end, screw.start) / 30.0
        assert 2.0 < math.degrees(math.acos(-direction[1])) < 6.0
    with pytest.raises(ValueError, match="among the 6 holes"):
        specimen(small(screws={"holes": [6]}))


def test_solids_and_meshes_attenuate_as_beer_and_lambert_say():
    box = trimesh.creation.box((20.0, 4.0, 60.0))
    recipe = Recipe.of(
        {
            "implant": {"mesh": "box.stl", "material": "titanium"},
            "limb": {"tissue": {"radius": "40 mm", "axis": "[0, 0, 0] mm", "material": "water"}},
            "panel": QUIET,
            "tube": {"focal_spot": "0 mm"},
            "scatter_to_primary": 0,
        }
    )
    geometry = circular_geometry([90.0], sad=400.0, sdd=500.0, det_shape=(5, 5), pixel_spacing=(0.4, 0.4))
    counts = only(recipe, geometry=geometry, implant=box).counts
    mu = {name: float(material(name).attenuation(60.0)) for name in ("titanium", "water")}
    expected = 6e4 * math.exp(-mu["titanium"] * 4.0 - mu["water"] * 76.0)
    assert float(counts[0, 2, 2]) == pytest.approx(expected, rel=1e-3)
    rod = {"start": "[0, 15, -80] mm", "end": "[0, 15, 80] mm", "radius": "8 mm", "calcium_mg_ml": 100}
    beside = recipe.model_copy(
        update={"limb": type(recipe.limb).of(plain(recipe.limb.model_dump(mode="json")) | {"inserts": [rod]})}
    )
    darker = only(beside, geometry=geometry, implant=box).counts
    more = 16.0 * (float(material("ca100").attenuation(60.0)) - mu["water"])
    assert float(darker[0, 2, 2]) == pytest.approx(expected * math.exp(-more), rel=1e-3)


def test_parts_must_not_overlap_or_stick_out():
    with pytest.raises(ValueError, match="tissue must hold all of plate"):
        only(small(limb={"tissue": {"radius": "5 mm", "axis": "[0, 0, 0] mm"}}))
    rod = {"start": "[0, -20, -50] mm", "end": "[0, -20, 50] mm", "radius": "5 mm", "material": "ca50"}
    with pytest.raises(ValueError, match="insert0 reaches into the distal bone"):
        only(small(limb={"bone": {}, "inserts": [rod]}))
    with pytest.raises(ValueError, match="implant's mesh must be closed"):
        open_box = trimesh.creation.box((5.0, 5.0, 50.0))
        open_box.update_faces(np.arange(len(open_box.faces)) > 0)
        only(Recipe.of({"implant": {"mesh": "box.stl"}}), implant=open_box)


def test_a_bone_of_ones_own_is_drilled_where_screws_are():
    pytest.importorskip("manifold3d")
    bone = trimesh.creation.cylinder(12.0, height=160.0, sections=48)
    bone.apply_translation((0.0, -16.0, 0.0))
    recipe = small(limb={"mesh": "bone.stl"})
    parts = {part.name: part for part in only(recipe, bone=bone).parts}
    drilled = bone.volume - parts["bone"].shape.volume
    inside = min(30.0 - 1.7, 24.0)  # of each screw, from the bone's near side
    assert drilled == pytest.approx(4 * inside * math.pi * 1.4**2, rel=0.05)


def test_a_bone_of_ones_own_says_what_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    bone = trimesh.creation.cylinder(12.0, height=160.0, sections=48)
    bone.apply_translation((0.0, -16.0, 0.0))
    with pytest.raises(ValueError, match=r"manifold3d: pip install 'torchkcreg\[simulate\]'"):
        only(small(limb={"mesh": "bone.stl"}), bone=bone)


@pytest.fixture(scope="module")
def construct() -> ElasticConstruct:
    return ElasticConstruct(specimen(small(limb={"bone": {}, "beads": ["[10, 0, 40] mm"]})))


def test_the_plate_bends_between_the_fragments_as_beam_theory_says(construct):
    state = construct.loaded(LoadRecipe.of({"force": "[0, 0, -100] N"}))
    arm, inertia = 17.0, 13.5 * 4.6**3 / 12
    z = torch.tensor([-3.0, 3.0], dtype=torch.float64)  # between two holes
    fibre = torch.stack([torch.tensor([[0.0, y, float(h)] for h in z]).double() for y in (-2.0, 2.0)])
    moved = state.implant(fibre)
    slopes = (moved[1] - moved[0])[:, 2] / 4.0
    curvature = abs(float(slopes[1] - slopes[0])) / 6.0
    expected = 100.0 * arm / (elastic_constants("titanium").youngs_modulus * inertia)
    assert curvature == pytest.approx(expected, rel=0.05)
    between = state.carried.section_loads[len(state.carried.heights) // 2]
    assert float(between[3:].abs().max()) == pytest.approx(100.0 * arm, rel=0.02)


def test_fragments_are_rigid_the_distal_one_stays_and_the_screws_go_with_theirs(construct):
    state = construct.loaded(LoadRecipe.of({"force": "[5, 0, -200] N", "translation": "[1, 2, 3] mm"}))
    still = torch.eye(4, dtype=torch.float64)
    still[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(state.fragments["distal"], still, atol=1e-9, rtol=0)
    for screw, motion in zip(construct.specimen.screws, state.screws, strict=True):
        torch.testing.assert_close(motion, state.fragments[construct.specimen.fragment_of(screw.start[2])])
        near = torch.tensor([screw.start]).double()  # where its hole's wall holds it
        assert float((state.implant(near)[0] - (motion[:3, :3] @ near[0] + motion[:3, 3])).norm()) < 0.02
    turn = state.fragments["proximal"][:3, :3]
    assert math.degrees(math.acos((float(turn.trace()) - 1) / 2)) > 0.3


def test_motion_grows_with_the_force_and_a_force_that_the_alloy_does_not_bear_is_told(construct):
    small_force, large = (
        construct.amounts(torch.tensor([0.0, 0.0, f]).double(), torch.zeros(3).double()) for f in (-10, -100)
    )
    torch.testing.assert_close(10 * small_force, large, rtol=1e-5, atol=1e-9)
    with pytest.warns(UserWarning, match="titanium yields"):
        construct.loaded(LoadRecipe.of({"force": "[0, 0, -5000] N"}))


@pytest.mark.parametrize("stiffness", [100.0, 2000.0])
def test_a_callus_takes_its_share_of_the_load_and_is_found_again_from_motion_and_moment(construct, stiffness):
    force = 100.0
    bone = {"callus": f"{stiffness} N/mm"}
    with_callus = ElasticConstruct(specimen(small(limb={"bone": bone})))
    states = {c: c.loaded(LoadRecipe.of({"force": f"[0, 0, {-force}] N"})) for c in (construct, with_callus)}
    moments = [float(s.carried.section_loads[len(s.carried.heights) // 2][3:].norm()) for s in states.values()]
    assert moments[1] < 0.99 * moments[0]
    state = states[with_callus]
    relative = torch.linalg.inv(state.fragments["distal"]) @ state.fragments["proximal"]
    axis = torch.tensor([0.0, -17.0, 0.0, 1.0], dtype=torch.float64)
    closing = -float((relative @ axis - axis)[2])
    turn = float(torch.acos(((relative[:3, :3].trace() - 1) / 2).clamp(-1, 1)))
    found = callus_stiffness([GapLoad(force, moments[1], 1.0, closing, 0.0, turn, 0.0)], 17.0, 13.0)
    assert found.axial == pytest.approx(stiffness, rel=0.05)
    assert 0 < found.shares[0] < 1


def test_a_force_needs_screws_in_both_fragments():
    with pytest.raises(ValueError, match="proximal one has none"):
        ElasticConstruct(specimen(small(screws={"holes": [0, 1]}, limb={"bone": {}})))


def test_angles_bend_a_plate_and_its_screws_go_with_it():
    made = specimen(small(limb={"bone": {}}))
    state = loaded(made, LoadRecipe.of({"bend": "3 deg", "zone": "25 mm"}))
    relative = state.fragments["proximal"] @ torch.linalg.inv(state.fragments["distal"])
    assert math.degrees(math.acos((float(relative[:3, :3].trace()) - 1) / 2)) == pytest.approx(3.0, abs=0.05)
    assert state.carried is None


def test_scatter_is_as_asked_and_smooth_and_more_behind_thick_parts():
    primaries = torch.ones(2, 96, 80, dtype=torch.float64)
    primaries[:, :, 20:60] = 0.3
    primaries[:, :, 36:44] = 0.02
    scatter = scattered(primaries, (1.0, 1.0), 0.4)
    shadow = primaries < 0.9
    assert float(scatter[shadow].mean() / primaries[shadow].mean()) == pytest.approx(0.4, rel=1e-6)
    assert float(scatter.diff(dim=-1).abs().max()) < 0.02
    assert float(scatter[0, 48, 40]) > float(scatter[0, 48, 4]) > 0
    assert float(scattered(torch.ones_like(primaries), (1.0, 1.0), 0.4).abs().max()) == 0
    assert only(small(limb={"bone": {}}, scatter_to_primary=0.35)).scatter_to_primary == pytest.approx(0.35, rel=1e-6)


def test_noise_is_that_of_quanta_and_electronics_behind_the_scintillator():
    panel = FlatPanel(photons=5e3, electronic_noise=3.0, open_beam=3e4, bits=16, glare=0.1)
    flat = torch.full((160, 160), 0.5, dtype=torch.float64)
    spacing, generator = (0.388, 0.388), torch.Generator().manual_seed(0)
    images = torch.stack([panel.counts(flat, spacing, generator).double() for _ in range(12)])
    point = torch.zeros_like(flat)
    point[80, 80] = 1.0
    spread = panel.detected(point, spacing)
    quanta = 0.5 / 5e3 * float(spread.square().sum()) * 3e4**2  # independent quanta, spread
    assert float(images.var()) == pytest.approx(quanta + 9.0 + 1 / 12, rel=0.03)
    assert float(images.mean()) == pytest.approx(1.5e4, rel=1e-3)
    neighbours = (images[..., 1:] - 1.5e4) * (images[..., :-1] - 1.5e4)
    assert float(neighbours.mean()) > 0.05 * quanta  # correlated


def test_the_scintillator_keeps_half_the_contrast_where_it_says_and_the_focal_spot_widens_an_edge():
    panel = FlatPanel(half_contrast_lp_mm=1.25, glare=0.0, focal_spot_mm=0.8)
    x = torch.arange(400, dtype=torch.float64) * 0.05
    wave = (1 + 0.5 * torch.cos(2 * math.pi * 1.25 * x)).expand(64, 400)
    seen = panel.detected(wave, (0.05, 0.05))[32, 100:300]
    assert float(seen.max() - seen.min()) == pytest.approx(0.5, rel=0.01)
    edge = (x > 10.0).double().expand(64, 400)
    blurred = panel.penumbra(edge, (0.05, 0.05), 1.5)[32]  # a box of 0.8 mm x (1.5 - 1)
    rising = (blurred > 0.1) & (blurred < 0.9)
    assert 0.05 * float(rising.sum()) == pytest.approx(0.8 * 0.4, abs=0.06)
    assert panel.penumbra(edge, (0.05, 0.05), 1.0) is edge


def test_faults_are_the_panels_own_and_full_pixels_stay_full():
    panel = FlatPanel(dead_pixels=0.01, gain_error=0.02, photons=math.inf, electronic_noise=0.0, offset=100.0, bits=12)
    flat = torch.ones(100, 100, dtype=torch.float64)
    one, other = (panel.counts(flat, (0.4, 0.4), torch.Generator().manual_seed(seed)).int() for seed in (1, 2))
    assert torch.equal(one, other)  # no noise: the same faults in every view
    assert 40 < int((one == 0).sum()) < 170
    alive = one[one > 0].double()
    assert float(alive.std()) == pytest.approx(0.02 * 2800, rel=0.05)
    assert float(alive.mean()) == pytest.approx(2900, rel=0.002)
    full = replace(panel, open_beam=9000.0).counts(flat, (0.4, 0.4), torch.Generator())
    assert int(full.int().max()) == 4095


def test_spectra_of_other_voltages_come_from_spekpy_and_agree_with_the_packaged_ones():
    pytest.importorskip("spekpy")
    packaged, computed = tungsten_spectrum(90), tungsten_spectrum(90, anode_deg=12.0001)
    weights = np.interp(packaged.energies_kev, computed.energies_kev, computed.weights)
    assert np.abs(weights - np.array(packaged.weights)).max() < 1e-3 * max(packaged.weights)
    assert packaged.mean_energy < tungsten_spectrum(95).mean_energy < tungsten_spectrum(100).mean_energy
    with pytest.raises(ValueError, match="30 to 150"):
        tungsten_spectrum(300)


def test_without_spekpy_a_spectrum_says_which_voltages_there_are(monkeypatch):
    monkeypatch.setitem(sys.modules, "spekpy", None)
    with pytest.raises(ValueError, match="one of 70, 80, 90"):
        tungsten_spectrum(95)


def test_simulator_and_registration_share_neither_projector_nor_scatter_nor_blur_nor_bone(monkeypatch):
    package = Path(torchkcreg.__file__).parent

    def imported(*folders: str) -> set[str]:
        files = [file for folder in folders for file in (package / folder).rglob("*.py")]
        nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
        return {f"{n.module}.{alias.name}" for n in nodes if isinstance(n, ast.ImportFrom) for alias in n.names}

    registering = imported("registration", "scene", "similarity")
    assert any("PointCloud" in name for name in registering)  # the question is not idle
    assert not any("project_mesh" in name or "torchkcreg.simulation" in name for name in registering)
    making = imported("simulation/bench")
    shared = ("blur", "scatter.", "point_cloud", "torchkcreg.scene", "torchkcreg.registration", "Scatter")
    assert not [name for name in making if any(part in name for part in shared)]

    def never(*_args, **_options):
        raise AssertionError("the registration's own model")

    monkeypatch.setattr("torchkcreg.physics.blur.gaussian_blur", never)
    monkeypatch.setattr("torchkcreg.physics.blur.convolve", never)
    monkeypatch.setattr("torchkcreg.physics.blur.gaussian_kernel", never)
    assert len(only(small(limb={"bone": {}})).counts) == 1
