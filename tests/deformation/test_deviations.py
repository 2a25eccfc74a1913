"""How far an implant may be off: against what draws of its parameters do."""

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.deformation import Deviations, depth_direction

DEPTH = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def nodes() -> torch.Tensor:
    return torch.cartesian_prod(*(torch.arange(-a, a + 1, 3.0).double() for a in (6.0, 3.0, 60.0)))


@pytest.fixture(scope="module")
def deviations(nodes) -> Deviations:
    """Of a rod that shifts, turns about its long axis, and bends, by amounts that hang together."""
    shift = DEPTH.expand_as(nodes)
    turn = torch.linalg.cross(torch.tensor([0.0, 0, 1]).double().expand_as(nodes), nodes) / 10
    bend = torch.zeros_like(nodes)
    bend[:, 0], bend[:, 2] = nodes[:, 2] ** 2 / 3600, -2 * nodes[:, 0] * nodes[:, 2] / 3600
    covariance = torch.tensor([[0.04, 0.01, 0.0], [0.01, 0.01, 0.002], [0.0, 0.002, 0.0025]]).double()
    return Deviations.of(nodes, torch.stack([shift, turn, bend]), covariance, DEPTH)


def test_fields_are_uncorrelated_and_sum_to_the_covariance(nodes, deviations) -> None:
    middle = (nodes.norm(dim=-1)).argmin()
    found = deviations.covariance(nodes[middle][None])[0]
    assert float(found[1, 1]) == pytest.approx(0.04, rel=0.02)
    assert float(found[0, 0]) < 1e-4


def test_points_beside_are_carried_rigidly(nodes, deviations) -> None:
    beside = torch.tensor([[18.0, 0.0, 0.0]]).double()  # an arm of 12 mm more than the implant's edge
    lateral, depth = deviations.split(beside)
    assert float(depth) == pytest.approx(math.sqrt(0.04 + 2 * 1.8 * 0.01 + 1.8**2 * 0.01), rel=0.01)
    assert float(lateral) < 0.05
    at_nodes = torch.einsum("rni,rnj->nij", deviations.fields, deviations.fields)
    torch.testing.assert_close(deviations.covariance(nodes), at_nodes, rtol=0.02, atol=2e-4)


def test_the_whole_is_what_draws_deviate(nodes, deviations) -> None:
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(4000, len(deviations.fields), generator=generator, dtype=torch.float64)
    drawn = torch.einsum("kr,rni->kni", weights, deviations.fields)
    whole, lateral, depth = deviations.rms
    assert float(drawn.square().sum(-1).mean().sqrt()) == pytest.approx(whole, rel=0.03)
    assert float((drawn @ DEPTH).square().mean().sqrt()) == pytest.approx(depth, rel=0.03)
    assert whole**2 == pytest.approx(2 * lateral**2 + depth**2)
    nearest = deviations.of_nearest(nodes + 0.1)
    assert float(nearest.square().mean().sqrt()) == pytest.approx(whole)


def test_files_give_them_back_and_refuse_what_does_not_fit(nodes, deviations) -> None:
    again = Deviations.from_dict(deviations.to_dict())
    torch.testing.assert_close(again.covariance(nodes[:5]), deviations.covariance(nodes[:5]), rtol=1e-4, atol=1e-8)
    content = deviations.to_dict()
    with pytest.raises(ValueError, match="fields"):
        Deviations.from_dict({**content, "fields": content["fields"][:, 1:]})
    with pytest.raises(ValueError, match="finite"):
        Deviations.from_dict({**content, "depth": torch.tensor([0.0, float("nan"), 0.0])})
    with pytest.raises(ValueError, match="depth"):
        Deviations.from_dict({name: content[name] for name in ("points", "fields")})


def test_depth_is_where_the_rays_run() -> None:
    sources = torch.tensor([[0.0, 600, 120], [0, 600, 0], [0, 600, -120]]).double()
    assert abs(float(depth_direction(sources, torch.zeros(3).double()) @ DEPTH)) == pytest.approx(1.0, abs=1e-6)
