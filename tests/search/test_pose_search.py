"""Search from nowhere: the implant is found in any frame, beside others, and half turns are candidates."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from small_scene import PLAIN, SCREW, geometry, image, plate, pose, scene

from torchkcreg.geometry import circular_geometry, rigid_matrix, rotation_from_vector, rotation_grid, transform_points
from torchkcreg.registration.start import body_of, drawn
from torchkcreg.scene import RegistrationData
from torchkcreg.search import Body, Candidates, CoarseViews, PoseSearch, aimed_at, spread_views

ANYWHERE = rigid_matrix(torch.tensor([1.7, -0.9, 1.2]).double(), torch.tensor([60.0, -110.0, 35.0]).double())


def body_in_frame(pitch: float, frame: torch.Tensor = ANYWHERE) -> Body:
    """The small plate in a CAD frame of its own."""
    cloud = plate().coarsened_to(pitch)
    cell = cloud.cell.double() @ frame[:3, :3].T
    return Body.of(transform_points(frame, cloud.points.double()), cloud.volumes, cell)


def off_mm(poses: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Root mean square distances (K,) of the nodes at poses (K, 4, 4) of that frame from the truth."""
    points = plate().coarsened_to(2.0).points.double()
    there = transform_points(poses @ ANYWHERE, points.expand(len(poses), -1, 3))
    return (there - transform_points(truth, points)).square().sum(-1).mean(-1).sqrt()


def test_an_implant_is_found_in_any_frame() -> None:
    truth = pose(8.0, 25.0)
    search = PoseSearch(image(scene(PLAIN, truth)), body_in_frame, rotations=2000)
    steps: list[int] = []
    candidates = search.candidates(lambda done, text: steps.append(done))
    assert steps == [0, 1, 2, 3]
    assert bool((candidates.similarity.diff() <= 0).all())
    assert float(off_mm(candidates.poses(search.body)[:1], truth)) < 0.5
    assert float(candidates.similarity[0]) > 0.9


def test_a_shadow_is_placed_where_it_fits_best() -> None:
    truth = pose(8.0, 25.0)
    search = PoseSearch(image(scene(PLAIN, truth)), body_in_frame)
    body = search.coarse.body
    right = (truth @ torch.linalg.inv(ANYWHERE))[:3, :3]
    placed = search.coarse.shadows(torch.stack([rotation_grid(5)[1], right]), 1)
    assert float(placed.similarity[1]) > max(0.9, 1.3 * float(placed.similarity[0]))
    centre = transform_points(truth @ torch.linalg.inv(ANYWHERE), body.center)
    seen = geometry().project(torch.stack([placed.centers[1], centre]))[0][1]
    assert float((seen[0] - seen[1]).norm()) * 0.8 < search.pixel_mm


def test_a_second_implant_is_searched_beside_the_first() -> None:
    """A bulky first implant hides the small one unless it is part of the model."""
    here = scene(PLAIN, pose(3.0, 10.0))
    (assembly,) = here.assemblies
    truth = rigid_matrix(torch.tensor([0.3, 0.2, -0.4]).double(), torch.tensor([14.0, 5.0, -4.0]).double())
    both = RegistrationData(geometry(), drawn([assembly], image(here)) + image(scene(PLAIN, truth)).line_integrals)
    search = PoseSearch(both, body_in_frame, partial(drawn, [assembly]), rotations=2000)
    assert float(off_mm(search.candidates().poses(search.body)[:1], truth)) < 1.0


def test_refinement_never_loses_and_half_turns_are_half_turns() -> None:
    data, body = image(scene(PLAIN)), body_in_frame(2.0, torch.eye(4).double())
    views = CoarseViews(data, body, torch.zeros(3).double(), 2.0, 0.5)
    turns = rotation_from_vector(0.04 * torch.randn(6, 3, generator=torch.Generator().manual_seed(0)).double())
    start = views.compared(turns, body.center + torch.tensor([1.0, -0.5, 1.5]).double().expand(6, 3))
    refined = views.refined(start, 10)
    assert bool((refined.similarity >= start.similarity - 1e-4).all())
    assert float(refined.similarity.min()) > 0.94 > 1.3 * float(start.similarity.max())
    turned = start[:1].half_turned(body)
    assert len(turned) == 3 and bool((turned.centers == start.centers[0]).all())
    for rotation in turned.rotations:
        relative = start.rotations[0].mT @ rotation
        torch.testing.assert_close(relative @ relative, torch.eye(3).double(), atol=1e-9, rtol=0)
        assert float(relative.trace()) == pytest.approx(-1.0)


def test_distinct_candidates_lie_apart() -> None:
    body = body_in_frame(2.0)
    turns = torch.eye(3).double().expand(4, 3, 3)
    centers = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0], [9.5, 0, 0]]).double()
    apart = Candidates(turns, centers, torch.tensor([0.5, 0.6, 0.2, 0.1])).distinct(body, 4.0)
    assert apart.centers[:, 0].tolist() == [1.0, 9.0]


def test_the_views_are_aimed_at_the_rotation_axis_and_spread_over_directions() -> None:
    ring = circular_geometry(range(0, 180, 5), sad=404, sdd=538, det_shape=(64, 64), pixel_spacing=(3.0, 3.0))
    torch.testing.assert_close(aimed_at(ring), torch.zeros(3).double(), atol=1e-6, rtol=0)
    chosen = spread_views(ring, 3)
    assert len(chosen) == 3 and ring.num_views // 2 in chosen
    angles = torch.tensor([ring.angles_deg[view] for view in chosen])
    assert float(torch.cat([angles.diff(), angles[:1] + 180 - angles[-1:]]).min()) > 35
    assert spread_views(ring.select([4]), 3) == [0]
    alone = aimed_at(ring.select([0]))
    depth = float(ring.select([0]).project(alone[None])[1])
    assert 0.3 * 538 < depth < 0.95 * 538


def test_the_body_of_an_assembly_holds_its_screws() -> None:
    bare, screwed = (scene(PLAIN, components=parts).assemblies[0] for parts in ((), (SCREW,)))
    volumes = [float(body_of(assembly, 1.0).volumes.sum()) for assembly in (bare, screwed)]
    assert volumes[1] - volumes[0] == pytest.approx(float(SCREW.cloud.volumes.sum()), rel=1e-3)
