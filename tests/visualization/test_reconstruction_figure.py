import pytest
import torch

from torchkcreg.geometry import VolumeGrid
from torchkcreg.visualization import reconstruction_figure

GRID = VolumeGrid.centered((6, 10, 12), 1.0)


def test_a_figure_has_a_panel_for_each_volume_height_and_difference():
    volumes = {"PWLS": torch.rand(GRID.shape), "KC-Rec": torch.rand(GRID.shape)}
    figure = reconstruction_figure(volumes, GRID, heights_mm=(-1, 1), difference=("KC-Rec", "PWLS"), profile_y_mm=0.0)
    assert len(figure.axes) == 2 * 3 + 1
    assert [line.get_label() for line in figure.axes[-1].lines] == ["PWLS", "KC-Rec"]
    figure.canvas.draw()


def test_what_cannot_be_drawn_is_named():
    with pytest.raises(ValueError, match="at least one volume"):
        reconstruction_figure({}, GRID)
    with pytest.raises(ValueError, match="must have the grid's shape"):
        reconstruction_figure({"a": torch.zeros(2, 2, 2)}, GRID)
    with pytest.raises(ValueError, match="difference must name two of a"):
        reconstruction_figure({"a": torch.zeros(GRID.shape)}, GRID, difference=("a", "b"))
