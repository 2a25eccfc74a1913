import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchkcreg.geometry import MultisourceScanner
from torchkcreg.io import read_projections, write_projections


@pytest.fixture
def line_integrals():
    return np.random.default_rng(3).uniform(0, 4, (3, 8, 6)).astype(np.float32)


def test_intensities_become_the_line_integrals_that_made_them(tmp_path, line_integrals):
    write_projections(tmp_path / "p.npz", intensity=3000 * np.exp(-line_integrals.astype(float)), open_beam=3000.0)
    projections = read_projections(tmp_path / "p.npz")
    torch.testing.assert_close(projections.line_integrals, torch.from_numpy(line_integrals), rtol=0, atol=2e-6)
    assert projections.line_integrals.dtype == torch.float32
    assert projections.mask.dtype == torch.bool
    assert projections.mask.all()
    assert projections.num_masked == {}
    assert projections.num_saturated == 0


def test_normalised_intensities_keep_their_small_values(tmp_path):
    write_projections(tmp_path / "p.npz", intensity=np.exp(-np.full((1, 2, 2), 8.0)), open_beam=1.0)
    assert read_projections(tmp_path / "p.npz").line_integrals.numpy() == pytest.approx(8.0, abs=1e-5)


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".mha", ".nrrd", ".nii", ".nii.gz"])
def test_line_integrals_are_read_from_each_format_alike(tmp_path, line_integrals, suffix):
    path = tmp_path / f"p{suffix}"
    if suffix == ".npz":
        write_projections(path, line_integrals=torch.from_numpy(line_integrals))
    elif suffix == ".npy":
        np.save(path, line_integrals)
    else:
        sitk.WriteImage(sitk.GetImageFromArray(line_integrals), str(path))
    projections = read_projections(path)
    assert np.array_equal(projections.line_integrals.numpy(), line_integrals)


def test_an_image_with_an_open_beam_holds_intensities(tmp_path):
    sitk.WriteImage(sitk.GetImageFromArray(np.full((2, 4, 5), 500, np.uint16)), str(tmp_path / "p.mha"))
    projections = read_projections(tmp_path / "p.mha", open_beam=1000)
    assert projections.line_integrals.numpy() == pytest.approx(np.log(2), abs=1e-6)


@pytest.mark.parametrize("shape", [(), (1,), (3,), (8, 6), (3, 1, 1), (3, 8, 6)])
def test_an_open_beam_of_any_broadcasting_shape_is_taken(tmp_path, line_integrals, shape):
    beam = np.random.default_rng(1).uniform(900, 1100, shape)
    full = beam[:, None, None] if shape == (3,) else beam
    write_projections(tmp_path / "p.npz", intensity=full * np.exp(-line_integrals), open_beam=beam)
    projections = read_projections(tmp_path / "p.npz", views=[2, 0])
    torch.testing.assert_close(projections.line_integrals, torch.from_numpy(line_integrals[[2, 0]]), rtol=0, atol=2e-6)


def test_pixels_without_a_measurement_are_masked_counted_and_finite(tmp_path):
    intensity = np.full((1, 3, 4), 100.0)
    intensity[0, 0, :3] = np.nan, np.inf, -np.inf
    intensity[0, 1, :2] = 0, -5
    projections = read_projections(saved(tmp_path, intensity=intensity, open_beam=200.0))
    assert projections.num_masked == {"not finite": 3, "not positive": 2}
    assert (~projections.mask).sum() == 5
    assert projections.mask[0, 2].all()
    assert torch.isfinite(projections.line_integrals).all()


def test_line_integrals_that_are_not_finite_are_masked_and_zero(tmp_path):
    values = np.ones((1, 2, 2))
    values[0, 0] = np.nan, -np.inf
    projections = read_projections(saved(tmp_path, line_integrals=values))
    assert projections.num_masked == {"not finite": 2}
    assert projections.line_integrals.tolist() == [[[0, 0], [1, 1]]]
    assert projections.mask.tolist() == [[[False, False], [True, True]]]


def test_the_mask_of_the_file_counts(tmp_path):
    mask = np.ones((1, 2, 2), np.uint8)
    mask[0, 1, 1] = 0
    projections = read_projections(saved(tmp_path, line_integrals=np.ones((1, 2, 2)), mask=mask))
    assert projections.num_masked == {"in the file's mask": 1}
    assert projections.mask.sum() == 3


def test_saturated_pixels_keep_the_value_of_the_ceiling_and_count(tmp_path):
    intensity = np.array([[[4095, 4095], [2000, 10]]], np.uint16)
    path = saved(tmp_path, intensity=intensity, open_beam=np.float32(5000))
    projections = read_projections(path)
    assert projections.num_saturated == 2
    assert projections.mask.all()
    assert projections.line_integrals[0, 0].numpy() == pytest.approx(np.log(5000 / 4095), abs=1e-6)


def test_a_given_ceiling_clamps_what_is_above_it(tmp_path):
    path = saved(tmp_path, intensity=np.array([[[900, 1200], [950, 10]]], np.uint16), open_beam=1000.0)
    projections = read_projections(path, saturation=950)
    assert projections.num_saturated == 2
    assert projections.line_integrals[0, 0, 1] == pytest.approx(np.log(1000 / 950), abs=1e-6)
    assert read_projections(path).num_saturated == 0


def test_views_are_taken_in_the_order_asked_for(tmp_path, line_integrals):
    path = saved(tmp_path, line_integrals=line_integrals)
    chosen = read_projections(path, views=[2, 0])
    assert np.array_equal(chosen.line_integrals.numpy(), line_integrals[[2, 0]])
    assert torch.equal(read_projections(path).select([2, 0]).line_integrals, chosen.line_integrals)


def test_projections_are_checked_against_a_geometry(tmp_path, line_integrals):
    projections = read_projections(saved(tmp_path, line_integrals=line_integrals))
    scanner = MultisourceScanner(det_shape=(8, 6))
    projections.check_against(scanner.geometry().select([0, 1, 2]))
    with pytest.raises(ValueError, match=r"\(3, 8, 6\), the geometry has \(2, 8, 6\)"):
        projections.check_against(scanner.geometry().select([0, 1]))


def saved(tmp_path, **arrays):
    np.savez(tmp_path / "p.npz", **arrays)
    return tmp_path / "p.npz"


IMAGE = np.ones((2, 3, 4))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"intensity": IMAGE}, "has intensity but no open_beam"),
        ({"other": IMAGE}, "needs either intensity"),
        ({"intensity": IMAGE, "line_integrals": IMAGE, "open_beam": 1.0}, "needs either intensity"),
        (
            {"line_integrals": IMAGE[0]},
            r"line_integrals must be numbers of shape \(V, rows, cols\), got float64 \(3, 4\)",
        ),
        ({"line_integrals": IMAGE[:0]}, r"shape \(V, rows, cols\)"),
        ({"line_integrals": IMAGE * 1j}, "line_integrals must be numbers"),
        ({"line_integrals": IMAGE.astype(np.uint16)}, "look like intensities"),
        ({"intensity": IMAGE, "open_beam": 0.0}, "open_beam must be positive"),
        ({"intensity": IMAGE, "open_beam": np.nan}, "open_beam must be positive"),
        ({"intensity": IMAGE, "open_beam": np.ones((5,))}, "open_beam must broadcast"),
        ({"intensity": IMAGE, "open_beam": np.ones((1, 2, 3, 4))}, "open_beam must broadcast"),
        ({"intensity": IMAGE, "open_beam": 1.0, "saturation": -1}, "saturation must be positive"),
        ({"line_integrals": IMAGE, "mask": IMAGE[:1]}, "mask must be numbers of the shape"),
        ({"line_integrals": np.array([[["a"]]], dtype=object)}, "cannot be read"),
    ],
)
def test_a_bad_file_is_refused_in_one_line_that_names_it(tmp_path, arrays, message):
    with pytest.raises(ValueError, match=rf"^projections file .*p\.npz: .*{message}") as caught:
        read_projections(saved(tmp_path, **arrays))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["p.npz", "p.npy", "p.mha", "p.nrrd"])
def test_a_damaged_file_cannot_be_read_and_is_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"PK\x03\x04 this is nothing")
    with pytest.raises(ValueError, match=rf"{name}: cannot be read") as caught:
        read_projections(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_truncated_npz_cannot_be_read(tmp_path, line_integrals):
    path = saved(tmp_path, line_integrals=line_integrals)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match="cannot be read"):
        read_projections(path)


def test_an_unknown_suffix_and_a_missing_file_are_named(tmp_path):
    (tmp_path / "p.csv").write_text("1,2")
    with pytest.raises(ValueError, match=r"not \.csv"):
        read_projections(tmp_path / "p.csv")
    with pytest.raises(FileNotFoundError, match=r"projections file .*q\.npz does not exist"):
        read_projections(tmp_path / "q.npz")


@pytest.mark.parametrize("views", [[0, 3], [-1], []])
def test_a_view_that_is_not_there_is_refused(tmp_path, line_integrals, views):
    with pytest.raises(ValueError, match="view"):
        read_projections(saved(tmp_path, line_integrals=line_integrals), views=views)


def test_writing_needs_one_kind_of_image_and_an_npz(tmp_path):
    with pytest.raises(ValueError, match="intensity and open_beam, or line_integrals"):
        write_projections(tmp_path / "p.npz", intensity=IMAGE)
    with pytest.raises(ValueError, match=r"written to a \.npz"):
        write_projections(tmp_path / "p.npy", line_integrals=IMAGE)
    assert list(tmp_path.iterdir()) == []


def test_an_archive_that_unpacks_to_more_than_memory_is_refused(tmp_path, monkeypatch):
    write_projections(tmp_path / "p.npz", line_integrals=np.zeros((40, 64, 64), np.float32))
    monkeypatch.setattr("torchkcreg.io.scans.projections.physical_memory", lambda: 640_000.0)
    with pytest.raises(ValueError, match=r"p.npz: cannot be read: unpacks to 0 GiB, this machine has 0 GiB of memory"):
        read_projections(tmp_path / "p.npz")
