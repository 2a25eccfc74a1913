"""An implant condensed to the loads at its holds: balance, completeness, finite rotations, files."""

from __future__ import annotations

import math

import pytest
import torch
import trimesh

from torchkcreg.deformation import FiniteElementDeformation, Level, deformation_from_dict
from torchkcreg.implant import ImplantPointCloud, find_holes
from torchkcreg.mechanics import (
    ElasticBody,
    ExpectedLoads,
    Hold,
    LoadPrior,
    Superelement,
    fragment_loads,
    hold_motions,
    holds_of,
    shares_of_holds,
    sides_of_holds,
)
from torchkcreg.mechanics.holds import unit_loads
from torchkcreg.physics import elastic_constants
from torchkcreg.plain import plain
from torchkcreg.simulation import locking_plate

STEEL = elastic_constants("steel")
LONG = 100.0
HOLDS = tuple(Hold(f"at {z:.0f}", (0.0, 0.0, z), 4.0) for z in (-45.0, -15.0, 15.0, 45.0))


@pytest.fixture(scope="module")
def bar() -> ImplantPointCloud:
    return ImplantPointCloud.from_mesh(trimesh.creation.box((10.0, 4.0, LONG)), 0.4)


@pytest.fixture(scope="module")
def element(bar) -> Superelement:
    return Superelement.of(bar, STEEL, HOLDS)


def test_the_loads_of_every_way_to_bend_are_in_balance(element: Superelement) -> None:
    places = torch.tensor([h.center for h in HOLDS]).double()
    for loads in (element.loads, element.stiff):
        forces, moments = loads[..., :3], loads[..., 3:]
        size = float(loads.abs().max())
        assert float(forces.sum(1).abs().max()) < 1e-9 * size
        turning = moments + torch.linalg.cross(places.expand_as(forces), forces, dim=-1)
        assert float(turning.sum(1).abs().max()) < 1e-8 * size
    assert len(element.loads) + len(element.stiff) == 6 * len(HOLDS) - 6


def test_amounts_are_millimetres_and_softest_first(element: Superelement, bar: ImplantPointCloud) -> None:
    points, share = bar.points.double(), (bar.volumes / bar.volumes.sum()).double()
    deformation = FiniteElementDeformation(element)
    for number in range(3):
        deformation.reset()
        deformation.amounts.data[number] = 1e-3
        moved = deformation.displacement(points)
        assert float((share[:, None] * moved.detach() ** 2).sum().sqrt()) == pytest.approx(1e-3, rel=0.01)
    assert bool((element.expected.diff() <= 0).all()) and float(element.expected[-1]) > 1e-3


def test_small_amounts_give_the_displacements_of_the_whole_body(element: Superelement, bar: ImplantPointCloud) -> None:
    body = ElasticBody(bar, STEEL)
    where, forces = unit_loads(bar, HOLDS)
    flat = element.loads[2].flatten() * 1e-4
    nodal = sum(float(f) * body.response([p], [u]) for f, p, u in zip(flat, where, forces, strict=True))
    deformation = FiniteElementDeformation(element)
    deformation.amounts.data[2] = 1e-4
    points = bar.points[::37].double()
    wanted = body.displacement(points, nodal)[0]
    torch.testing.assert_close(deformation.displacement(points), wanted, atol=2e-8, rtol=0)


def test_a_bar_that_is_bent_far_keeps_its_length_and_becomes_an_arc(bar: ImplantPointCloud) -> None:
    ends = (Hold("low", (0.0, 0.0, -46.0), 4.5), Hold("high", (0.0, 0.0, 46.0), 4.5))
    element = Superelement.of(bar, STEEL, ends)
    loads = element.loads[:, :, 3]  # moments about x
    bending = int((loads[:, 1] - loads[:, 0]).abs().div(element.loads.flatten(1).norm(dim=1)).argmax())
    deformation = FiniteElementDeformation(element)
    deformation.amounts.data[bending] = 1.0  # some 10 degrees between the holds, more than a plate survives
    along = torch.linspace(-30, 30, 61).double()
    axis = torch.stack([0 * along, 0 * along, along], dim=-1)
    moved = deformation(axis).detach()
    lengths = moved.diff(dim=0).norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths), atol=5e-4, rtol=0)
    tangents = moved.diff(dim=0) / lengths[:, None]
    turn = math.degrees(math.acos(float(tangents[0] @ tangents[-1])))
    assert turn > 5
    chord = float((moved[-1] - moved[0]).norm())
    radius = 59 / math.radians(turn)
    assert chord == pytest.approx(2 * radius * math.sin(30 / radius), abs=0.02)


def test_motions_and_deformations_agree_and_the_rigid_part_goes_to_the_pose(element, bar) -> None:
    deformation = FiniteElementDeformation(element)
    deformation.amounts.data[:4] = torch.tensor([1.0, -0.5, 0.2, 0.1]).double()
    points = bar.points[::53].double()
    generator = torch.Generator().manual_seed(0)
    for level in (Level(1), Level(2), Level(20, 40)):
        motion = deformation.motion(bar, level)
        torch.testing.assert_close(
            motion.displacement(points, motion.at_rest())[0], deformation.displacement(points), atol=1e-10, rtol=0
        )
        steps = 0.5 * torch.randn(motion.num_parameters, dtype=torch.float64, generator=generator)
        moved = points + motion.displacement(points, steps[None])[0]
        common = motion.accept(steps)
        after = deformation(points) @ common[:3, :3].T + common[:3, 3]
        torch.testing.assert_close(after, moved, atol=5e-3, rtol=0)


def test_the_motion_has_the_gradients_it_says(element, bar) -> None:
    motion = FiniteElementDeformation(element).motion(bar, Level(20, 40))
    points = bar.points[::997].double()
    steps = 0.1 * torch.ones(1, motion.num_parameters, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: motion.displacement(points, s), steps, atol=1e-6)
    still = torch.zeros(1, motion.num_parameters, dtype=torch.float64)
    assert float(motion.penalty(still)) == 0 and float(motion.penalty(steps.detach())) > 0


def test_levels_free_as_many_ways_as_groups_or_modes_have_numbers(element, bar) -> None:
    deformation = FiniteElementDeformation(element)
    counts = [deformation.motion(bar, level).num_parameters for level in (Level(1), Level(2), Level(20, 9), Level(20))]
    assert counts == [6, 12, 9, 6 + element.num_amounts]


def test_files_give_it_back(element, bar) -> None:
    deformation = FiniteElementDeformation(element)
    deformation.amounts.data[0] = 1.5
    content = deformation.to_dict()
    points = bar.points[::29].double()
    for form in (content, plain(content)):
        again = deformation_from_dict(form)
        torch.testing.assert_close(again.displacement(points), deformation.displacement(points), atol=1e-6, rtol=0)
    assert again.superelement.holds == HOLDS
    del content["superelement"]["loads"]
    with pytest.raises(ValueError, match="'loads' of a superelement is missing"):
        deformation_from_dict(content)


def test_a_stronger_prior_expects_more_and_one_hold_is_not_enough(bar, element) -> None:
    twice = Superelement.of(bar, STEEL, HOLDS, prior=LoadPrior(2 * LoadPrior().force, 2 * LoadPrior().moment))
    torch.testing.assert_close(twice.expected[:5], 2 * element.expected[:5], rtol=1e-6, atol=0)
    with pytest.raises(ValueError, match="held in two places or more, got 1"):
        Superelement.of(bar, STEEL, HOLDS[:1])


def test_plates_are_held_at_their_holes_and_bars_along_their_length(bar) -> None:
    mesh = locking_plate(length=100.0, num_holes=5, hole_offset=2.0)
    plate = ImplantPointCloud.from_mesh(mesh, 0.5)
    holes = holds_of(plate, find_holes(mesh))
    assert [h.name for h in holes] == [f"hole {n}" for n in range(1, 6)]  # combination holes count once
    assert all(len(h.nodes(plate.points)) > 20 for h in holes)
    patches = holds_of(bar)
    assert len(patches) >= 3 and patches[0].name == "patch 1"
    assert patches[-1].center[2] - patches[0].center[2] > 0.6 * LONG
    assert holds_of(plate, find_holes(mesh)[:2])[0].name == "patch 1"  # too few to hold it


def test_holds_are_used_where_heads_are(element) -> None:
    heads = torch.tensor([[0.0, 3.0, -44.0], [1.0, 3.0, -46.0], [0.0, 3.0, 12.0]]).double()
    assert shares_of_holds(element, heads, 0.1).tolist() == pytest.approx([1, 0.1, 1, 0.1])
    assert shares_of_holds(element, heads[:2], 0.1).tolist() == [1, 1, 1, 1]  # one place alone: no balance
    assert shares_of_holds(element, heads[:0], 0.1).tolist() == [1, 1, 1, 1]


def test_a_hold_that_is_not_used_carries_nothing_and_the_rest_bends_as_if_it_were_not_there(bar, element) -> None:
    expected = ExpectedLoads.of(element, torch.tensor([1.0, 1e-4, 1.0, 1.0]))
    loads = expected.loads_of(element)
    softest = torch.linalg.eigh(expected.precision)[1][:, :6]
    carried = torch.einsum("ab,ahk->bhk", softest, loads)
    assert float(carried[:, 1].abs().max()) < 1e-3 * float(carried.abs().max())
    fewer = Superelement.of(bar, STEEL, [HOLDS[0], *HOLDS[2:]])
    assert (1 / torch.linalg.eigvalsh(expected.precision)[:6].sqrt()).tolist() == pytest.approx(
        fewer.expected[:6].tolist(), rel=1e-2
    )


def test_where_all_holds_are_alike_amounts_are_independent(element) -> None:
    expected = ExpectedLoads.of(element)
    torch.testing.assert_close(expected.precision, torch.diag(element.expected**-2.0), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(expected.spread, torch.eye(len(element.stiff)).double(), rtol=1e-6, atol=1e-6)
    assert float(expected.followed.abs().max()) < 1e-6 * float(element.expected[-1] ** -1)


def test_a_deformation_learns_where_its_screws_are_and_files_know_it(element, bar) -> None:
    deformation = FiniteElementDeformation(element, unused=0.01)
    amounts = torch.zeros(1, element.num_amounts, dtype=torch.float64)
    amounts[0, 3] = 0.1
    before = float(deformation.prior(amounts))
    deformation.fixed_at(torch.tensor([[0.0, 2.0, -45.0], [0.0, 2.0, 45.0]]))
    assert float(deformation.prior(amounts)) > 10 * before
    again = deformation_from_dict(plain(deformation.to_dict()))
    torch.testing.assert_close(again.prior(amounts), deformation.prior(amounts), rtol=1e-4, atol=0)
    motion = deformation.motion(bar, Level(2))
    motion.accept(torch.eye(12, dtype=torch.float64)[6])  # the softest way
    assert float(deformation.loads[1:3].abs().max()) < 0.02 * float(deformation.loads.abs().max())
    motion.keep_covariance(torch.eye(12, dtype=torch.float64) * 1e-4)
    values = torch.linalg.eigvalsh(deformation.covariance)
    assert float(values.min()) > 0 and int((values - 1e-4).abs().lt(1e-9).sum()) >= 6


def test_ways_to_bend_do_not_depend_on_the_sign_of_eigenvectors(bar, element, monkeypatch) -> None:
    """Which is another one from library to library, and from processor to processor."""
    eigh = torch.linalg.eigh

    def turned(matrix):
        values, vectors = eigh(matrix)
        return values, vectors * torch.tensor([-1.0, 1.0]).repeat(vectors.shape[1])[: vectors.shape[1]]

    monkeypatch.setattr(torch.linalg, "eigh", turned)
    other = Superelement.of(bar, STEEL, HOLDS)
    torch.testing.assert_close(other.loads, element.loads, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(other.nodal, element.nodal, rtol=1e-5, atol=1e-7)


def test_the_energy_is_the_work_of_the_loads_on_their_holds(element) -> None:
    energy = element.energy
    assert energy is not None
    moved = hold_motions(element.hexahedra, element.nodal, element.holds)
    work = torch.einsum("ahk,bhk->ab", element.loads, moved)
    count = element.num_amounts
    torch.testing.assert_close(energy[:count, :count], work, rtol=0.02, atol=0.02 * float(work.abs().max()))
    assert float(torch.linalg.eigvalsh(energy).min()) > 0


def test_loads_between_fragments_have_their_resultant_and_the_least_energy(element) -> None:
    loads = torch.cat([element.loads, element.stiff])
    sides = torch.tensor([-1, 0, 1, 1])
    scale = loads.new_tensor([200.0] * 3 + [1500.0] * 3)
    amounts = fragment_loads(loads, element.energy, element.centers, sides, scale)
    acting = torch.einsum("qa,ahk->qhk", amounts, loads)
    assert float(acting[:, 1].abs().max()) < 1e-6  # no fragment, no load
    middle = (element.centers[2:].mean(0) + element.centers[0]) / 2
    arms = (element.centers[2:] - middle).expand(6, -1, 3)
    moments = acting[:, 2:, 3:] + torch.linalg.cross(arms, acting[:, 2:, :3])
    through = torch.cat([acting[:, 2:, :3].sum(1), moments.sum(1)], dim=1)
    torch.testing.assert_close(through, torch.eye(6).double(), rtol=0, atol=1e-6)
    bending = float(amounts[3] @ element.energy @ amounts[3])
    # a moment that enters at the outer hold bends the stretch between both upper holds as well
    outer = fragment_loads(loads, element.energy, element.centers, torch.tensor([-1, 0, 0, 1]), scale)
    assert bending < 0.9 * float(outer[3] @ element.energy @ outer[3])


def test_between_fragments_large_loads_are_expected_at_the_screws_beside_the_gap(element) -> None:
    sides = (-1, -1, 1, 1)
    plain_prior, wide = ExpectedLoads.of(element), ExpectedLoads.of(element, sides=sides)
    extra = torch.linalg.eigvalsh(wide.covariance - plain_prior.covariance)
    assert float(extra.min()) > -1e-9 * float(extra.max()) and float(extra.max()) > 0  # wider, never narrower
    loads = torch.einsum("ab,ahk->bhk", torch.linalg.cholesky(wide.covariance), wide.loads_of(element))
    moments = loads[..., 3:].square().sum(0).sum(-1).sqrt()
    assert float(moments[1:3].min()) > 1.5 * float(moments[[0, 3]].max())
    again = ExpectedLoads.of(element, sides=(0, 0, 0, 0))
    torch.testing.assert_close(again.precision, plain_prior.precision)


def test_holds_belong_to_the_fragment_on_their_side_of_the_widest_gap(element) -> None:
    axis = element.sections.axis
    sign = int(torch.sign(axis[2]))
    assert (sign * sides_of_holds(element.centers, axis, [0, 2, 3])).tolist() == [-1, 0, 1, 1]
    assert sides_of_holds(element.centers, axis, [2]).tolist() == [0, 0, 0, 0]


def test_a_bent_implant_shows_where_the_fracture_is(element) -> None:
    axis, used = element.sections.axis, [0, 1, 2, 3]
    bent_between_0_and_1 = torch.zeros(4, 3).double()
    bent_between_0_and_1[1:, 0] = 0.02
    sides = sides_of_holds(element.centers, axis, used, bent_between_0_and_1)
    assert (sides != sides[0]).tolist() == [False, True, True, True]
    deformation = FiniteElementDeformation(element)
    heads = element.centers
    deformation.fixed_at(heads)
    as_undeformed = deformation.sides
    loads = torch.cat([element.loads, element.stiff])
    scale = loads.new_tensor([200.0] * 3 + [1500.0] * 3)
    wanted = torch.tensor([-1, -1, -1, 1]) * (1 if float(axis[2]) > 0 else -1)
    moved = fragment_loads(loads, element.energy, element.centers, wanted, scale)[3]
    deformation.amounts.data.copy_(1e4 * moved[: element.num_amounts])
    deformation.fixed_at(heads)
    assert deformation.sides == tuple(wanted.tolist()) != as_undeformed
