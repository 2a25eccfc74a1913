import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from torchkcreg.visualization import capture_figure, error_map_figure, histogram_figure


@pytest.fixture
def plate():
    return torch.cartesian_prod(torch.linspace(-6, 6, 9), torch.linspace(-2, 2, 3), torch.linspace(-80, 80, 60))


def spread(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].std()


def test_the_error_map_colours_each_point_by_its_error(plate):
    errors = (plate[:, 2] + 80) / 1000
    figure = error_map_figure(plate, errors, title="surface error", limit_mm=0.2)
    assert [axes.get_title() for axes in figure.axes[:4]] == ["front", "back", "edge", "oblique"]
    assert figure.get_suptitle() == "surface error\nmean 0.080, RMSE 0.093, largest 0.160 mm"
    dots = figure.axes[0].collections[1]
    heights = np.asarray(dots.get_offsets())[:, 1]
    assert np.asarray(dots.get_array()) == pytest.approx((heights + 80) / 1000, abs=1e-6)
    assert figure.axes[-1].get_ylim() == pytest.approx((0, 0.2))
    assert spread(figure) > 10


def test_front_and_back_show_the_two_sides(plate):
    errors = (plate[:, 1] > 1).float()
    figure = error_map_figure(plate, errors)
    nearest = [np.asarray(axes.collections[1].get_array())[-50:].mean() for axes in figure.axes[:2]]
    assert sorted(nearest) == [0, 1]  # what is drawn last lies on top


def test_points_and_errors_must_correspond(plate):
    with pytest.raises(ValueError, match=r"\(N, 3\) and \(N,\), N > 2, got \(1620, 3\) and \(5,\)"):
        error_map_figure(plate, torch.zeros(5))


def test_the_histogram_holds_all_points_and_says_mean_width_and_floor():
    values = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    figure = histogram_figure({"before": 2 * values, "after": values}, fwhm_mm={"after": 0.9}, floor_mm=0.12)
    axes = figure.axes[0]
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert sum("before: mean" in label for label in labels) == 1
    assert f"after: mean {values.mean():.3f}, FWHM 0.900 mm" in labels
    assert "perfect lattices: 0.120 mm" in labels
    assert sum(bar.get_height() for bar in axes.patches) == pytest.approx(200)
    assert spread(figure) > 5


def test_no_distances_make_no_histogram():
    for distances in ({}, {"after": torch.zeros(0)}):
        with pytest.raises(ValueError, match="one to 4 sets"):
            histogram_figure(distances)


def test_the_capture_curve_shows_shares_and_what_is_asked_for():
    figure = capture_figure({"oblique": ([2, 10], [1.0, 0.6])}, required=(10, 0.95))
    curve, cross = figure.axes[0].lines
    assert list(curve.get_ydata()) == [1.0, 0.6]
    assert (list(cross.get_xdata()), list(cross.get_ydata())) == ([10], [0.95])
    assert spread(figure) > 5
    with pytest.raises(ValueError, match="2 offsets and 1 shares"):
        capture_figure({"odd": ([1, 2], [1.0])})
