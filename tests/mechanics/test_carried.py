"""What an implant carries: section loads, stresses and their deviations, against beam theory and draws."""

from __future__ import annotations

import pytest
import torch
import trimesh

from torchkcreg.implant import ImplantPointCloud
from torchkcreg.mechanics import CarriedLoad, Hold, Superelement, node_stresses, von_mises
from torchkcreg.physics import elastic_constants

HOLDS = tuple(Hold(f"at {z:.0f}", (0.0, 0.0, z), 4.0) for z in (-45.0, -15.0, 15.0, 45.0))
WIDTH, THICKNESS = 10.0, 4.0


@pytest.fixture(scope="module")
def element() -> Superelement:
    bar = ImplantPointCloud.from_mesh(trimesh.creation.box((WIDTH, THICKNESS, 100.0)), 0.4)
    return Superelement.of(bar, elastic_constants("steel"), HOLDS, negligible_mm=0.0)


def amounts_of(element: Superelement, loads: torch.Tensor) -> torch.Tensor:
    """Amounts that are loads (H, 6) in the implant's axes."""
    found = torch.linalg.lstsq(element.loads.flatten(1).T, loads.flatten()[:, None]).solution[:, 0]
    torch.testing.assert_close(torch.einsum("a,ahk->hk", found, element.loads), loads, atol=1e-4, rtol=0)
    return found


@pytest.fixture(scope="module")
def four_point(element) -> torch.Tensor:
    """Pushed out of its plane by 100 N at the ends and back at the inner holds, and twisted by 500 N mm."""
    loads = torch.zeros(4, 6, dtype=torch.float64)
    loads[:, 1] = torch.tensor([100.0, -100.0, -100.0, 100.0])
    loads[[0, 3], 5] = torch.tensor([-500.0, 500.0]).double()
    return amounts_of(element, loads)


def test_bending_of_four_points_is_that_of_a_beam(element, four_point) -> None:
    carried = CarriedLoad.of(element, four_point)
    assert [abs(float(x)) for x in carried.axes[1]] == pytest.approx([0, 1, 0], abs=1e-6)
    assert carried.hold_heights.tolist() == pytest.approx([5, 35, 65, 95], abs=0.5)
    bending, shear, torsion = carried.section_loads[:, 3], carried.section_loads[:, 1], carried.section_loads[:, 5]
    inner = (carried.heights > 36) & (carried.heights < 64)
    lower = (carried.heights > 6) & (carried.heights < 34)
    torch.testing.assert_close(bending[inner].abs(), torch.full_like(bending[inner], 3000.0), rtol=1e-3, atol=0)
    torch.testing.assert_close(shear[lower].abs(), torch.full_like(shear[lower], 100.0), rtol=1e-3, atol=0)
    torch.testing.assert_close(
        torsion[lower | inner], torch.full_like(torsion[lower | inner], 500.0), rtol=1e-3, atol=0
    )
    slope = bending[lower].diff() / carried.heights[lower].diff()
    torch.testing.assert_close(slope.abs(), torch.full_like(slope, 100.0), rtol=1e-3, atol=0)
    outside = (carried.heights < 4) | (carried.heights > 96)
    assert float(carried.section_loads[outside].abs().max()) < 0.1
    assert float(carried.section_loads[inner][:, [0, 2, 4]].abs().max()) < 1.0


def test_the_convex_side_is_pulled_by_a_positive_moment(element, four_point) -> None:
    carried = CarriedLoad.of(element, four_point)
    moment = float(carried.section_loads[60, 3])  # middle
    front = carried.axes[1] * THICKNESS / 2
    pulled = float(element.stress(front[None], four_point)[0, 2, 2])
    inertia = WIDTH * THICKNESS**3 / 12
    assert pulled == pytest.approx(moment * THICKNESS / 2 / inertia, rel=0.06)


def test_surface_stress_is_that_of_a_beam(element, four_point) -> None:
    points = torch.tensor([[0.0, THICKNESS / 2, z] for z in (-8.0, 0.0, 8.0)]).double()
    covariance = torch.diag((0.02 * element.expected.clamp_max(1.0)).square())
    value, deviation = node_stresses(element, points, four_point, covariance)
    twisted = 500.0 / (0.258 * WIDTH * THICKNESS**2)  # Roark, b/t = 2.5
    wanted = (112.5**2 + 3 * twisted**2) ** 0.5
    assert value.tolist() == pytest.approx([wanted] * 3, rel=0.06)
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(80, len(four_point), generator=generator, dtype=torch.float64) * covariance.diagonal().sqrt()
    drawn = torch.stack([node_stresses(element, points, four_point + d, covariance)[0] for d in draws])
    torch.testing.assert_close(deviation, drawn.std(0), rtol=0.25, atol=0.5)


def test_cubes_with_little_metal_do_not_invent_stress() -> None:
    parts = [trimesh.creation.box((WIDTH, THICKNESS, 100.0)), trimesh.creation.box((4.0, THICKNESS, 12.0))]
    parts[1].apply_translation((7.0, 0.0, 12.0))  # where it ends, and how thick it is, no lattice of cubes fits
    bar = ImplantPointCloud.from_mesh(trimesh.util.concatenate(parts), 0.7)
    element = Superelement.of(bar, elastic_constants("steel"), HOLDS, negligible_mm=0.0)
    assert float((element.filled / element.filled.max()).min()) < 0.3
    loads = torch.zeros(4, 6, dtype=torch.float64)
    loads[[0, 3], 3] = torch.tensor([1000.0, -1000.0]).double()
    places = torch.cartesian_prod(*(torch.linspace(-x, x, 9).double() for x in (WIDTH / 2, THICKNESS / 2, 30.0)))
    highest = 1000.0 * THICKNESS / 2 / (WIDTH * THICKNESS**3 / 12)
    value = von_mises(element.stress(places, amounts_of(element, loads)))
    assert 0.9 * highest < float(value.max()) < 1.35 * highest


def test_deviations_of_section_loads_are_those_of_draws(element, four_point) -> None:
    covariance = torch.diag((0.1 * element.expected).square())
    stated = CarriedLoad.of(element, four_point, covariance)
    generator = torch.Generator().manual_seed(1)
    draws = torch.randn(400, len(four_point), generator=generator, dtype=torch.float64) * 0.1 * element.expected
    drawn = torch.stack([CarriedLoad.of(element, four_point + d).section_loads for d in draws]).std(0)
    torch.testing.assert_close(stated.section_std, drawn, rtol=0.2, atol=1.0)
    torch.testing.assert_close(CarriedLoad.of(element, four_point).hold_std, 10 * stated.hold_std, rtol=1e-6, atol=1e-6)
    assert float(CarriedLoad.of(element, four_point).hold_std[:, :3].max()) < 301  # N: the prior's


def test_ways_that_images_cannot_tell_keep_their_uncertainty(four_point) -> None:
    bar = ImplantPointCloud.from_mesh(trimesh.creation.box((WIDTH, THICKNESS, 100.0)), 0.8)
    element = Superelement.of(bar, elastic_constants("steel"), HOLDS, negligible_mm=0.02)
    assert len(element.stiff) > 0
    nothing = torch.zeros_like(element.expected)
    sure = CarriedLoad.of(element, nothing, torch.diag(nothing))
    assert float(sure.section_std[60, 2]) > 100  # N: stretching it is one of them


def test_to_dict_names_units(element, four_point) -> None:
    content = CarriedLoad.of(element, four_point).to_dict()
    assert [hold["name"] for hold in content["holds"]] == [h.name for h in HOLDS]
    assert content["sections"]["moment_nmm"].shape == (121, 3) and set(content["axes"]) == {
        "across",
        "out of plane",
        "along",
    }
