"""Images and geometries that cannot be what they are said to be."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchkcreg.geometry import ConeBeamGeometry, MultisourceScanner
from torchkcreg.io import implausible_magnification, read_projections
from torchkcreg.io.scans.plausible import aperture_rim


def geometry() -> ConeBeamGeometry:
    return MultisourceScanner().geometry().select([47, 48, 49]).bin(16)


def limb(views: int = 3, rows: int = 48, cols: int = 40) -> np.ndarray:
    """Counts behind a limb that moves from view to view, in an open beam of 3000."""
    across = np.arange(cols) - cols / 2 - np.arange(views)[:, None]
    path = 40 * np.sqrt(np.clip(1 - (across / 12) ** 2, 0, None))
    path = path[:, None] + 0.1 * np.arange(rows)[:, None]
    return np.round(3000 * np.exp(-0.02 * path)).astype(np.uint16)


def write(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_good_images_give_no_warning(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_projections(write(tmp_path / "p.npz", intensity=limb(), open_beam=3000.0))
        read_projections(write(tmp_path / "p.npz", intensity=1.5 * limb().astype(float), open_beam=3000.0))  # scatter


def test_raw_counts_as_line_integrals_are_refused(tmp_path):
    path = write(tmp_path / "p.npz", line_integrals=limb().astype(np.float32))
    with pytest.raises(ValueError, match=r"p\.npz: line integrals have a median of .* give their open_beam"):
        read_projections(path)


def test_much_more_than_the_open_beam_is_doubted(tmp_path):
    with pytest.warns(UserWarning, match=r"p\.npz: most pixels are much brighter than the open beam"):
        read_projections(write(tmp_path / "p.npz", intensity=limb(), open_beam=300.0))


def test_a_view_that_is_there_twice_is_named(tmp_path):
    intensity = limb()
    intensity[2] = intensity[1]
    with pytest.warns(UserWarning, match="view 2 is the same image as view 1"):
        read_projections(write(tmp_path / "p.npz", intensity=intensity, open_beam=3000.0))


def test_stuck_pixels_are_masked_and_the_open_beam_is_not(tmp_path):
    """A column in the limb's shadow at the ceiling in every view; beside the limb the ceiling is the beam's."""
    intensity = np.minimum(limb().astype(np.int64) + 1200, 4095).astype(np.uint16)
    intensity[:, :, 21] = 4095
    intensity[:, 9, 17] = 4095
    projections = read_projections(write(tmp_path / "p.npz", intensity=intensity, open_beam=4200.0))
    assert projections.num_masked == {"stuck at the ceiling": 3 * 48 + 3}
    assert not projections.mask[:, :, 21].any() and not projections.mask[:, 9, 17].any()
    assert bool(projections.mask[:, :, :4].all()) and projections.num_saturated > 1000
    assert projections.masked_note() == "147 pixels are masked (147 stuck at the ceiling)"


def test_a_bright_spot_that_moves_is_a_gap_in_the_metal(tmp_path):
    intensity = (limb() // 4).astype(np.uint16)
    for view in range(3):
        intensity[view, 20:22, 10 + 5 * view] = 4095
    assert read_projections(write(tmp_path / "p.npz", intensity=intensity, open_beam=4200.0)).num_masked == {}
    alone = write(tmp_path / "one.npz", intensity=intensity[:1], open_beam=4200.0)
    assert read_projections(alone).num_masked == {}


@pytest.mark.parametrize(
    ("saturation", "message"),
    [(np.array([2900]), None), (np.array([1, 2]), "one number"), (np.array("x"), "one number")],
)
def test_a_saturation_may_be_an_array_of_one_number(tmp_path, saturation, message):
    path = write(tmp_path / "p.npz", intensity=limb(), open_beam=3000.0, saturation=saturation)
    if message is None:
        assert read_projections(path).num_saturated == int((limb() >= 2900).sum())
    else:
        with pytest.raises(ValueError, match=message):
            read_projections(path)


def test_an_array_under_an_archives_name_is_read(tmp_path):
    with (tmp_path / "p.npz").open("wb") as stream:
        np.save(stream, np.full((3, 4, 5), 0.5))
    assert read_projections(tmp_path / "p.npz").line_integrals.shape == (3, 4, 5)


def test_a_header_that_contradicts_the_geometry_is_said(tmp_path):
    views = geometry()
    dv, du = views.pixel_spacing
    rows, cols = views.det_shape
    shape = np.zeros((3, rows, cols), np.float32) + np.arange(3, dtype=np.float32)[:, None, None]
    image = sitk.GetImageFromArray(shape)
    for spacing, turned, message in (
        ((du, dv, 1.0), None, None),
        ((1.0, 1.0, 1.0), None, None),
        ((du / 2, dv, 1.0), None, "header says pixels of"),
        ((du, dv, 1.0), (1.0, 0, 0, 0, -1.0, 0, 0, 0, 1.0), "header turns their axes"),
    ):
        image.SetSpacing(spacing)
        image.SetDirection(turned or np.eye(3).ravel().tolist())
        sitk.WriteImage(image, str(tmp_path / "p.mha"))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_projections(tmp_path / "p.mha").check_against(views)
        texts = " ".join(str(w.message) for w in caught)
        assert (message is None and not texts) or (message is not None and message in texts), (spacing, texts)


def test_an_object_in_another_unit_is_doubted_where_it_stands():
    views, plate = geometry(), 20 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert implausible_magnification(views, plate) is None
    in_cm = views.projection_matrices.clone()
    in_cm[:, :, :3] *= 10.0  # P of world points in cm
    other = ConeBeamGeometry(in_cm, views.det_shape, views.pixel_spacing)
    assert "magnified 13" in (implausible_magnification(other, 0.1 * plate) or "")
    coarse = ConeBeamGeometry(views.projection_matrices, views.det_shape, tuple(0.1 * d for d in views.pixel_spacing))
    assert "behind the detector" in (implausible_magnification(coarse, plate) or "")


def disc(size: int, radius: float) -> np.ndarray:
    row, column = np.mgrid[:size, :size] - (size - 1) / 2
    return np.hypot(row, column) < radius


def test_the_rim_of_a_round_aperture_is_masked_and_nothing_else() -> None:
    lit = disc(200, 95)
    rim = aperture_rim(~lit[None])[0]
    assert rim[disc(200, 95) & ~disc(200, 88)].all() and not rim[disc(200, 86)].any() and not rim[~lit].any()
    spot = lit.copy()
    spot[90:110, 90:110] = False  # opaque metal inside is no surroundings
    assert not aperture_rim(~spot[None])[0][disc(200, 80)].any()


def test_dead_lines_and_dead_pixels_are_no_aperture() -> None:
    dead = np.zeros((1, 200, 200), dtype=bool)
    dead[0, :, 0] = dead[0, 50] = dead[0, ::9, ::9] = True
    assert not aperture_rim(dead).any()
    dead[0, :, :8] = True  # a collimator's blade
    assert aperture_rim(dead)[0, :, 8:15].any()


def test_images_behind_a_round_aperture_say_what_is_masked(tmp_path) -> None:
    counts = np.where(disc(100, 48), 900, 0).astype(np.uint16)[None]
    np.savez(tmp_path / "scan.npz", intensity=counts, open_beam=1000.0)
    projections = read_projections(tmp_path / "scan.npz")
    assert "at the rim of the aperture" in (projections.masked_note() or "")
    assert not projections.mask[0, 2, 50] and projections.mask[0, 50, 50]


def test_display_images_are_doubted(tmp_path) -> None:
    image = np.full((1, 40, 40), 200, dtype=np.uint8)
    image[0, 10:20, 10:20] = 60
    np.savez(tmp_path / "display.npz", intensity=image, open_beam=255.0)
    with pytest.warns(UserWarning, match="8 bits are made for display"):
        read_projections(tmp_path / "display.npz")
