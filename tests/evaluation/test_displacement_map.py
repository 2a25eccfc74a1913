import pytest
import torch

from torchkcreg.evaluation import displacement_map
from torchkcreg.geometry import rigid_matrix, transform_points


@pytest.fixture
def plate():
    """A bar along z from -80 to 80 mm."""
    x, y, z = torch.linspace(-6, 6, 5), torch.linspace(-2, 2, 3), torch.linspace(-80, 80, 81)
    return torch.cartesian_prod(x, y, z).double()


@pytest.fixture
def motion():
    return rigid_matrix(torch.tensor([0.2, -0.1, 0.4]).double(), torch.tensor([5.0, -3.0, 40.0]).double())


def bent(points):
    """Bent towards y above z = 0 only."""
    result = points.clone()
    result[:, 1] += 3 * (points[:, 2].clamp_min(0) / 80) ** 2
    return result


def test_an_implant_that_only_moved_has_a_map_of_zeros(plate, motion):
    assert displacement_map(plate, transform_points(motion, plate)).magnitudes.max() < 1e-9


def test_the_bending_above_the_distal_end_is_what_the_map_shows(plate):
    result = displacement_map(plate, bent(plate))
    torch.testing.assert_close(result.vectors, bent(plate) - plate, rtol=0, atol=1e-9)
    assert result.magnitudes.max() == pytest.approx(3)
    assert torch.equal(result.distal, plate[:, 2] <= -40)


def test_a_motion_of_the_whole_turns_the_vectors_and_leaves_their_lengths(plate, motion):
    still = displacement_map(plate, bent(plate))
    moved = displacement_map(plate, transform_points(motion, bent(plate)))
    torch.testing.assert_close(moved.magnitudes, still.magnitudes, rtol=0, atol=1e-9)
    torch.testing.assert_close(moved.vectors, still.vectors @ motion[:3, :3].T, rtol=0, atol=1e-9)
    torch.testing.assert_close(moved.alignment, motion, rtol=0, atol=1e-9)
    torch.testing.assert_close(moved.deformed, transform_points(motion, bent(plate)), rtol=0, atol=1e-9)


def test_the_frame_of_the_undeformed_implant_does_not_matter(plate, motion):
    elsewhere = transform_points(motion, plate).flip(-1)
    elsewhere = elsewhere * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)  # flip mirrors; this turns it back
    result = displacement_map(elsewhere, bent(plate))
    torch.testing.assert_close(result.vectors, bent(plate) - plate, rtol=0, atol=1e-9)


def test_the_distal_end_is_the_lower_one_in_the_world_unless_said_otherwise(plate):
    upper = displacement_map(plate, bent(plate), distal_direction=(0.0, 0.0, 1.0))
    assert torch.equal(upper.distal, plate[:, 2] >= 40)
    assert displacement_map(plate, bent(plate), distal_fraction=0.5).distal.sum() == 41 * 15
    assert displacement_map(plate, bent(plate), distal_fraction=1.0).distal.all()


def test_nodes_without_volume_do_not_pull_at_the_alignment(plate):
    warped = bent(plate)
    stray = (plate[:, 2] < -75) & (plate[:, 0] > 5)
    warped[stray, 0] += 4
    weights = torch.where(stray, 0.0, 1.0)
    result = displacement_map(plate, warped, weights=weights)
    torch.testing.assert_close(result.alignment, torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-9)
    assert displacement_map(plate, warped).alignment[0, 3].abs() > 1e-3


def test_what_makes_no_map_is_refused(plate):
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        displacement_map(plate, plate[1:])
    for fraction in (0, 1.5):
        with pytest.raises(ValueError, match=r"distal_fraction must be in \(0, 1\]"):
            displacement_map(plate, plate, distal_fraction=fraction)
    with pytest.raises(ValueError, match="holds 1 nodes"):
        displacement_map(torch.tensor([[0.0, 0, 0], [0, 0, 9], [0, 1, 5]]), torch.zeros(3, 3), distal_fraction=0.1)
