"""Shapes of scatter: what passes, what is removed."""

import torch

from torchkcreg.physics import scatter_shapes, scattered_signal


def beam() -> torch.Tensor:
    """A limb, down to a tenth of the beam, in the open beam, one view."""
    across = (torch.arange(80.0) - 40).abs()
    return torch.where(across < 20, 0.1, 1.0).expand(1, 60, 80)


def test_the_one_follows_the_open_beam_and_the_other_the_limb() -> None:
    passed, removed = scatter_shapes(beam(), torch.ones(1, 60, 80), 4.0)
    middle, side = (0, 30, 40), (0, 30, 4)
    assert float(passed[middle]) < 0.2 < 0.9 < float(passed[side])
    assert float(removed[middle]) > 0.2 > 0.01 > float(removed[side])


def test_pixels_that_do_not_count_have_no_share_in_them() -> None:
    image, mask = beam().clone(), torch.ones(1, 60, 80)
    whole = scatter_shapes(image, mask, 4.0)
    image[:, 20:24, 30:34], mask[:, 20:24, 30:34] = 5.0, 0.0
    torch.testing.assert_close(scatter_shapes(image, mask, 4.0), whole, atol=0.02, rtol=0)


def test_more_than_the_open_beam_scatters_nothing_away() -> None:
    image = torch.full((1, 20, 20), 1.3)
    assert float(scatter_shapes(image, torch.ones_like(image), 2.0)[1].abs().max()) == 0.0


def test_the_signal_is_the_sum_of_both() -> None:
    shapes = torch.rand(2, 3, 4, 5)
    signal = scattered_signal(torch.tensor([[0.2, 0.0], [0.1, 0.3]]), shapes)
    torch.testing.assert_close(signal[0], 0.2 * shapes[0])
    torch.testing.assert_close(signal[1], 0.1 * shapes[0] + 0.3 * shapes[1])
    assert scattered_signal(torch.tensor([[0.2, 0.3]]), None).flatten().tolist() == [torch.tensor(0.2).item()]
