import matplotlib
import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from torchkcreg.visualization import displacement_figure, history_figure, overlay_figure


def rendered(figure):
    """The figure as an image (height, width, 3), 0 to 255."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def share_of(image, test):
    red, green, blue = (image[..., i].astype(int) for i in range(3))
    return float(test(red, green, blue).mean())


def is_green(red, green, blue):
    return (green > red + 30) & (green > blue + 20)


@pytest.fixture
def shadow():
    """Two views of a bar, 30 of 200 rows and 12 of 100 columns."""
    image = torch.zeros(2, 200, 100)
    image[0, 90:120, 40:52] = 3.0
    image[1, 20:50, 60:72] = 3.0
    return image


def test_the_overlay_is_cropped_to_the_implant_with_one_size_for_all_views(shadow):
    figure = overlay_figure(shadow, shadow, margin_px=5)
    drawn = [axes.images[0].get_array().shape for axes in figure.axes]
    assert drawn == [(40, 22, 3), (40, 22, 3)]
    whole = overlay_figure(shadow, shadow, crop=False)
    assert whole.axes[0].images[0].get_array().shape == (200, 100, 3)


def test_green_lies_where_the_drr_is(shadow):
    figure = overlay_figure(shadow, shadow, crop=False)
    composite = np.asarray(figure.axes[0].images[0].get_array())
    inside, outside = composite[100, 45], composite[10, 10]
    assert inside[1] > inside[0] + 0.2
    assert outside[0] == outside[1] == outside[2]


def test_before_stands_over_after_and_views_stand_side_by_side(shadow):
    labels = ["91 deg, T1", "92 deg, T2"]
    figure = overlay_figure(
        shadow,
        shadow,
        before=shadow.roll(4, -1),
        view_labels=labels,
        gc_before=torch.tensor([0.25, 0.5]),
        gc_after=torch.tensor([0.75, 1.0]),
        pixel_spacing=(0.388, 0.388),
    )
    assert len(figure.axes) == 4
    assert [axes.get_title() for axes in figure.axes[:2]] == labels
    assert [axes.texts[0].get_text() for axes in figure.axes] == ["GC 0.250", "GC 0.500", "GC 0.750", "GC 1.000"]
    assert share_of(rendered(figure), is_green) > 0.05


def test_an_implant_outside_a_view_and_a_flat_image_are_drawn(shadow):
    shadow[1] = 0
    assert rendered(overlay_figure(torch.zeros_like(shadow), shadow)).size > 0
    assert rendered(overlay_figure(shadow, torch.zeros_like(shadow))).size > 0


def test_images_of_other_shapes_are_refused(shadow):
    with pytest.raises(ValueError, match=r"measured must have shape .*\(2, 200, 100\), got \(1, 200, 100\)"):
        overlay_figure(shadow[:1], shadow)
    with pytest.raises(ValueError, match="before must have shape"):
        overlay_figure(shadow, shadow, before=shadow[..., :-1])


@pytest.fixture
def plate():
    return torch.cartesian_prod(torch.linspace(-6, 6, 9), torch.linspace(-2, 2, 3), torch.linspace(-80, 80, 60))


def test_the_displacement_map_shows_the_largest_displacement_and_the_scale(plate):
    vectors = torch.zeros_like(plate)
    vectors[:, 0] = (plate[:, 2] + 80) / 160 * 1.5
    figure = displacement_figure(plate, vectors, title="Configuration 3")
    assert figure.get_suptitle() == "Configuration 3\nlargest 1.50 mm"
    assert figure.axes[-1].get_ylim() == pytest.approx((0, 1.5))
    assert [axes.get_title() for axes in figure.axes[:3]] == ["flat side", "edge", "oblique"]
    assert rendered(figure).std() > 10


def test_the_upper_end_in_the_world_is_drawn_on_top(plate):
    vectors = torch.zeros_like(plate)
    vectors[:, 0] = (plate[:, 2] > 0).float()
    for nodes in (plate, plate @ torch.tensor([[1.0, 0, 0], [0, 0.6, 0.8], [0, -0.8, 0.6]])):
        dots = displacement_figure(nodes, vectors).axes[0].collections[1]
        heights, lengths = np.asarray(dots.get_offsets())[:, 1], np.asarray(dots.get_array())
        up = np.sign(np.corrcoef(heights, lengths)[0, 1])
        assert up == np.sign(np.corrcoef(nodes[:, 2], plate[:, 2])[0, 1])


def test_exaggeration_moves_the_dots_and_not_the_numbers(plate):
    vectors = torch.tensor([0.5, 0, 0]).expand_as(plate)
    figure = displacement_figure(plate, vectors, exaggeration=10)
    grey, dots = figure.axes[0].collections
    shift = np.asarray(dots.get_offsets())[:, 0].mean() - np.asarray(grey.get_offsets())[:, 0].mean()
    assert abs(shift) == pytest.approx(5, rel=1e-3)
    assert np.asarray(dots.get_array()) == pytest.approx(0.5)
    assert "drawn 10 times too large" in figure.get_suptitle()


def test_no_displacement_is_drawn_too(plate):
    assert "largest 0.00 mm" in displacement_figure(plate, torch.zeros_like(plate)).get_suptitle()


def test_nodes_and_vectors_must_correspond(plate):
    with pytest.raises(ValueError, match="must both have shape"):
        displacement_figure(plate, plate[1:])


def history(*lengths):
    return [
        {"stage": stage, "iteration": i, "loss": 1 / (1 + i + 10 * stage), "step_mm": 0.5**i, "seconds": 0.1}
        for stage, length in enumerate(lengths)
        for i in range(length)
    ]


def test_the_history_draws_what_is_recorded_and_marks_the_stages():
    figure = history_figure(history(5, 3, 4), stage_labels=["rigid", "2 groups", "5 groups"])
    assert [axes.get_ylabel() for axes in figure.axes] == ["loss", "step (mm)"]
    loss = figure.axes[0]
    curves = [line.get_xdata().tolist() for line in loss.lines if len(line.get_xdata()) != 2]
    assert curves == [[1, 2, 3, 4, 5], [6, 7, 8], [9, 10, 11, 12]]
    assert [line.get_xdata()[0] for line in loss.lines if len(line.get_xdata()) == 2] == [5.5, 8.5]
    assert [text.get_text() for text in loss.texts] == ["rigid", "2 groups", "5 groups"]
    assert rendered(figure).std() > 5


def test_evaluations_are_the_abscissa_where_they_are_recorded():
    records = [{"loss": 1.0, "gc": 0.5, "evaluations": 40}, {"loss": 0.5, "gc": 0.75, "evaluations": 80}]
    figure = history_figure(records)
    assert figure.axes[-1].get_xlabel() == "evaluations"
    assert figure.axes[0].lines[0].get_xdata().tolist() == [40, 80]
    assert [axes.get_ylabel() for axes in figure.axes] == ["loss", "gradient correlation"]


def test_a_single_record_and_missing_values_are_drawn():
    assert rendered(history_figure([{"loss": 0.5}])).size > 0
    assert rendered(history_figure([{"loss": None, "step_mm": 0.0}, {"loss": 0.5, "step_mm": 0.1}])).size > 0


def test_an_empty_history_is_refused():
    for records in ([], [{"step_mm": 1.0}]):
        with pytest.raises(ValueError, match="at least one record with a loss"):
            history_figure(records)


def test_figures_leave_the_global_state_of_matplotlib_alone(plate):
    before = dict(matplotlib.rcParams)
    rendered(displacement_figure(plate, torch.zeros_like(plate)))
    rendered(history_figure(history(2)))
    assert dict(matplotlib.rcParams) == before
