import pytest
import torch

from torchkcreg.evaluation import bb_rmse, evaluate, evaluate_points, point_errors


def test_errors_are_distances():
    truth = torch.zeros(2, 2, 3)
    estimated = torch.tensor([[[3.0, 4, 0], [0, 0, 0]], [[0, 0, -2], [1, 2, 2]]])
    assert point_errors(estimated, truth).tolist() == [[5, 0], [2, 3]]
    assert bb_rmse(estimated, truth).tolist() == pytest.approx([(25 / 2) ** 0.5, (13 / 2) ** 0.5])


def test_a_shift_of_all_points_is_the_error():
    truth = 100 * torch.randn(8, 3, generator=torch.Generator().manual_seed(0))
    assert bb_rmse(truth + torch.tensor([0.1, -0.2, 0.2]), truth) == pytest.approx(0.3, rel=1e-4)


def test_points_that_do_not_correspond_are_refused():
    with pytest.raises(ValueError, match=r"\(2, 3\) and \(3, 3\)"):
        bb_rmse(torch.zeros(2, 3), torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"shape \(\.\.\., N, 3\)"):
        point_errors(torch.zeros(2, 2), torch.zeros(2, 2))
    with pytest.raises(ValueError, match="at least one point"):
        bb_rmse(torch.zeros(0, 3), torch.zeros(0, 3))


class Shift:
    """Moves every point by one vector, and knows points up to x = 10."""

    gc = torch.tensor([0.5, 0.25])

    def __init__(self, *vector):
        self.vector = torch.tensor(vector, dtype=torch.float64)

    def warp(self, points):
        return points + self.vector

    def outside(self, points):
        return points[..., 0] > 10


def test_metrics_of_a_known_error_are_known():
    points = torch.tensor([[0.0, 0, 0], [20, 0, 0], [5, 5, 5]])
    truth = points.double() + torch.tensor([1.0, 2, 3], dtype=torch.float64)
    truth[0, 0] += 0.3
    metrics = evaluate(Shift(1, 2, 3), points, truth, start=points)
    assert metrics.num_points == 3
    assert metrics.rmse_mm == pytest.approx(0.3 / 3**0.5)
    assert metrics.mean_mm == pytest.approx(0.1)
    assert metrics.median_mm == pytest.approx(0)
    assert metrics.max_mm == pytest.approx(0.3)
    assert metrics.rmse_xyz_mm == pytest.approx((0.3 / 3**0.5, 0, 0))
    assert metrics.motion_rms_mm == pytest.approx(((1.69 + 4 + 9 + 2 * 14) / 3) ** 0.5)
    assert metrics.num_outside == 1
    assert metrics.gc == (0.5, 0.25)
    assert metrics.to_dict()["rmse_mm"] == metrics.rmse_mm
    assert "they moved" in str(metrics)
    assert "1 beyond the control-point grid" in str(metrics)


def test_what_is_not_known_is_left_out():
    metrics = evaluate_points(torch.zeros(2, 3), torch.ones(2, 3))
    assert set(metrics.to_dict()) == {"num_points", "rmse_mm", "mean_mm", "median_mm", "max_mm", "rmse_xyz_mm"}
    assert metrics.rmse_mm == pytest.approx(3**0.5)
    assert "moved" not in str(metrics)


def test_points_need_their_rows_and_one_at_least():
    with pytest.raises(ValueError, match=r"estimated must have shape \(N, 3\)"):
        evaluate(Shift(0, 0, 0), torch.zeros(3), torch.zeros(3))
    with pytest.raises(ValueError, match="at least one point"):
        evaluate_points(torch.zeros(0, 3), torch.zeros(0, 3))
