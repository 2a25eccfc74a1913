"""Projections wherever they are: folders, raw data, HDF5, DICOM, flat and dark fields."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path

import h5py
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import torch
from PIL import Image
from pydicom.dataset import FileDataset, FileMetaDataset

from torchkcreg.io import ProjectionFile, read_geometry, read_projections
from torchkcreg.io.scans.series import in_order

RANDOM = np.random.default_rng(5)
LINES = RANDOM.uniform(0.2, 3, (12, 6, 7))
FLAT = RANDOM.uniform(3000, 4000, (6, 7))
DARK = RANDOM.uniform(50, 90, (6, 7))
RAW = DARK + (FLAT - DARK) * np.exp(-LINES)


def image(path: Path, array: np.ndarray) -> None:
    sitk.WriteImage(sitk.GetImageFromArray(array), str(path))


def dicom(path: Path, images: np.ndarray, **tags: object) -> None:
    """An angiographic multi-frame file, by another library's writer."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.12.1"
    meta.MediaStorageSOPInstanceUID = pydicom.uid.generate_uid()
    meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    data.Modality, data.SamplesPerPixel, data.PhotometricInterpretation = "XA", 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    data.Rows, data.Columns = images.shape[-2:]
    if images.ndim == 3:
        data.NumberOfFrames = len(images)
    for name, value in tags.items():
        setattr(data, name, value)
    data.PixelData = images.astype("<u2").tobytes()
    data.save_as(path, enforce_file_format=True)


def lines_of(path: Path, **options: object) -> np.ndarray:
    return read_projections(path, **options).line_integrals.numpy()


@pytest.mark.parametrize("suffix", [".tif", ".mha", ".png", ".nii.gz"])
def test_a_folder_has_one_file_a_view_in_the_order_of_their_numbers(tmp_path, suffix):
    counts = np.round(RAW).astype(np.uint16)
    for index, view in enumerate(counts):
        image(tmp_path / f"view_{index}{suffix}", view)
    (tmp_path / "notes.txt").write_text("tube at 90 kV")
    expected = -np.log(counts / 4000)
    np.testing.assert_allclose(lines_of(tmp_path, open_beam=4000), expected, atol=1e-6)
    part = ProjectionFile(tmp_path, open_beam=4000)
    assert len(part) == 12
    np.testing.assert_allclose(part.read([10, 2]).line_integrals, expected[[10, 2]], atol=1e-6)


def test_a_folder_whose_files_do_not_belong_together_is_refused_or_doubted(tmp_path):
    with pytest.raises(ValueError, match="this one holds no images"):
        read_projections(tmp_path)
    for index in (0, 1, 2, 4, 5):
        image(tmp_path / f"view_{index:03}.tif", RAW[index].astype(np.float32))
    with pytest.warns(UserWarning, match="numbered 2 and then 4: is a view missing"):
        read_projections(tmp_path, open_beam=4000)
    image(tmp_path / "view_003.tif", RAW[0, :4].astype(np.float32))
    with pytest.raises(ValueError, match=r"view_003.tif is 4 x 7 float32, the first image is 6 x 7 float32"):
        read_projections(tmp_path, open_beam=4000)
    (tmp_path / "view_003.tif").write_bytes(b"II*\0damaged")
    with pytest.raises(ValueError, match=r"view_003.tif cannot be read"):
        read_projections(tmp_path, open_beam=4000)
    image(tmp_path / "thumbnail.png", np.zeros((4, 4), np.uint8))
    with pytest.raises(ValueError, match=r"files of several kinds \(.png, .tif\)"):
        read_projections(tmp_path, open_beam=4000)


def test_a_description_names_raw_data_with_flat_and_dark_fields(tmp_path):
    RAW.astype(">f4").tofile(tmp_path / "scan.raw")
    (tmp_path / "flat").mkdir()
    for index, factor in enumerate((0.9, 1.1)):
        image(tmp_path / "flat" / f"{index}.tif", (factor * FLAT).astype(np.float32))
    np.stack([DARK, DARK]).astype(">f4").tofile(tmp_path / "dark.raw")
    text = "images: scan.raw\nflat: flat\ndark: dark.raw\nraw: {shape: [12, 6, 7], type: float32, byte_order: big}\n"
    (tmp_path / "scan.yaml").write_text(text)
    np.testing.assert_allclose(lines_of(tmp_path / "scan.yaml"), LINES, atol=1e-4)
    np.testing.assert_allclose(ProjectionFile(tmp_path / "scan.yaml").read([3]).line_integrals, LINES[[3]], atol=1e-4)
    (tmp_path / "scan.yaml").write_text(text.replace("[12, 6", "[13, 6"))
    with pytest.raises(ValueError, match=r"scan.raw holds 2016 bytes .* 13 images of 6 x 7 float32 are 2184"):
        read_projections(tmp_path / "scan.yaml")


def test_pixels_that_the_open_beam_does_not_light_are_masked(tmp_path):
    flat = FLAT.copy()
    flat[2, 3] = DARK[2, 3]
    np.savez(tmp_path / "p.npz", intensity=RAW, open_beam=flat, dark=DARK)
    found = read_projections(tmp_path / "p.npz")
    assert found.num_masked == {"without open beam": 12} and not found.mask[:, 2, 3].any() and found.mask[:, 0].all()
    assert bool(found.line_integrals.isfinite().all())
    np.savez(tmp_path / "p.npz", intensity=RAW, open_beam=DARK, dark=FLAT)
    with pytest.raises(ValueError, match="above the dark field"):
        read_projections(tmp_path / "p.npz")
    np.savez(tmp_path / "p.npz", intensity=RAW, open_beam=FLAT, dark=DARK[:3])
    with pytest.raises(ValueError, match=r"dark must be one number or an image \(6, 7\)"):
        read_projections(tmp_path / "p.npz")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("images: ../secret.tif", "outside the description's folder"),
        ("images: /etc/hostname", "outside the description's folder"),
        ("images: gone.tif", "does not exist"),
        ("images: s.yaml", "another description"),
        ("images: a.mha\nflat: a.mha\nopen_beam: 3", "name one"),
        ("images: a.mha\ndark: a.mha", "leaves the open beam unknown"),
        ("images: a.mha\nline_integrals: true\nopen_beam: 4", "need no flat"),
        ("images: a.mha\nflats: a.mha", "flats"),
        ("images: a.mha\nflat: small.mha", "the views have"),
        ("images: a.bin", "not .bin"),
    ],
)
def test_a_description_that_is_wrong_is_refused(tmp_path, text, reason):
    image(tmp_path / "a.mha", RAW.astype(np.float32))
    image(tmp_path / "small.mha", RAW[:, :3].astype(np.float32))
    (tmp_path / "a.bin").write_bytes(b"0123")
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises((ValueError, FileNotFoundError), match=reason):
        read_projections(tmp_path / "s.yaml")


def test_a_folder_of_raw_files_has_one_a_view(tmp_path):
    (tmp_path / "scan").mkdir()
    (tmp_path / "flat").mkdir()
    for index, view in enumerate(RAW):
        view.astype("<f4").tofile(tmp_path / "scan" / f"{index}.raw")
    for index in range(2):
        FLAT.astype("<f4").tofile(tmp_path / "flat" / f"{index}.raw")
    DARK.astype("<f4").tofile(tmp_path / "dark.raw")
    text = "images: scan\nflat: flat\ndark: dark.raw\nraw: {shape: [12, 6, 7], type: float32}\n"
    (tmp_path / "scan.yaml").write_text(text)
    np.testing.assert_allclose(lines_of(tmp_path / "scan.yaml"), LINES, atol=1e-4)
    (tmp_path / "scan" / "11.raw").unlink()
    with pytest.raises(ValueError, match=r"scan holds 11 images, raw.shape says 12"):
        read_projections(tmp_path / "scan.yaml")


def test_an_open_beam_for_each_view_goes_with_its_view(tmp_path):
    beams = np.linspace(3000, 4000, 12)
    np.save(tmp_path / "p.npy", beams[:, None, None] * np.exp(-LINES))
    part = ProjectionFile(tmp_path / "p.npy", open_beam=beams).read([7, 2, 3, 4, 5, 6, 8])  # as many as columns
    np.testing.assert_allclose(part.line_integrals, LINES[[7, 2, 3, 4, 5, 6, 8]], atol=1e-5)


def test_hdf5_of_data_exchange_nxtomo_or_one_dataset(tmp_path):
    with h5py.File(tmp_path / "exchange.h5", "w") as file:
        file["exchange/data"], file["exchange/data_white"] = RAW, np.stack([0.9 * FLAT, 1.1 * FLAT])
        file["exchange/data_dark"] = DARK[None]
    np.testing.assert_allclose(lines_of(tmp_path / "exchange.h5"), LINES, atol=1e-4)
    with h5py.File(tmp_path / "nx.nxs", "w") as file:
        group = file.create_group("entry1/tomo_entry/instrument/detector")
        group["data"] = np.concatenate([FLAT[None], DARK[None], RAW, FLAT[None]])
        group["image_key"] = [1, 2, *[0] * 12, 1]
    np.testing.assert_allclose(lines_of(tmp_path / "nx.nxs"), LINES, atol=1e-4)
    np.testing.assert_allclose(ProjectionFile(tmp_path / "nx.nxs").read([11]).line_integrals, LINES[[11]], atol=1e-4)
    with h5py.File(tmp_path / "one.h5", "w") as file:
        file["exchange/data"], file["exchange/data_white"], file["exchange/data_dark"] = RAW, FLAT, DARK
    np.testing.assert_allclose(lines_of(tmp_path / "one.h5"), LINES, atol=1e-4)
    with h5py.File(tmp_path / "nx.nxs", "a") as file:
        detector = file["entry1/tomo_entry/instrument/detector"]
        shown = file.create_group("entry1/tomo_entry/data")
        shown["data"], shown["image_key"] = detector["data"], detector["image_key"]  # hard links
    np.testing.assert_allclose(lines_of(tmp_path / "nx.nxs"), LINES, atol=1e-4)
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["a/views"], file["b/views"] = LINES, 2 * LINES
    with pytest.raises(ValueError, match=r"2 datasets of three dimensions \(a/views, b/views\): name one"):
        read_projections(tmp_path / "two.h5")
    (tmp_path / "s.yaml").write_text("images: two.h5\ndataset: /b/views\n")
    np.testing.assert_allclose(lines_of(tmp_path / "s.yaml"), 2 * LINES, rtol=1e-6)
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("views", (10**6, 4096, 4096), "f4", chunks=(1, 64, 64))
    with pytest.raises(ValueError, match="more than a file of"):
        read_projections(tmp_path / "bomb.h5")
    (tmp_path / "no.h5").write_text("nothing")
    with pytest.raises(ValueError, match="is no HDF5 file"):
        read_projections(tmp_path / "no.h5")


XA = {
    "DistanceSourceToDetector": 1200,
    "DistanceSourceToPatient": 750,
    "ImagerPixelSpacing": [0.4, 0.3],
    "PositionerPrimaryAngle": -30,
    "PositionerSecondaryAngle": 0,
}


def test_a_c_arms_dicom_file_is_projections_and_geometry(tmp_path):
    """At angle 0 the detector is in front; the left side is on the right of the image and the head at the top."""
    counts = np.round(RAW[:3]).astype(np.uint16)
    dicom(tmp_path / "run.dcm", counts, **XA, PositionerPrimaryAngleIncrement=[0, 30, 120])
    np.testing.assert_allclose(lines_of(tmp_path / "run.dcm", open_beam=4000), -np.log(counts / 4000), atol=1e-6)
    geometry = read_geometry(tmp_path / "run.dcm")
    assert geometry.det_shape == (6, 7) and geometry.pixel_spacing == pytest.approx((0.4, 0.3))
    assert geometry.angles_deg == pytest.approx((-30, 0, 90))
    source = torch.tensor([[0.0, 750.0, 0.0]]).double()
    torch.testing.assert_close(geometry.source_positions[1:2], source)
    left_and_head = torch.tensor([[1.0, 0, 0], [0, 0, 1.0]]).double()
    pixels = geometry.project(left_and_head)[0]
    torch.testing.assert_close(pixels[1], torch.tensor([[3 + 1.6 / 0.3, 2.5], [3, 2.5 - 1.6 / 0.4]]).double())
    torch.testing.assert_close(geometry.source_positions[2], torch.tensor([-750.0, 0, 0]).double())  # detector left
    dicom(tmp_path / "cra.dcm", counts[:1], **{**XA, "PositionerPrimaryAngle": 0, "PositionerSecondaryAngle": 30})
    assert float(read_geometry(tmp_path / "cra.dcm").source_positions[0, 2]) == pytest.approx(-375)  # detector up
    dicom(tmp_path / "steady.dcm", counts, **XA, PositionerPrimaryAngleIncrement=2.5)
    assert read_geometry(tmp_path / "steady.dcm").angles_deg == pytest.approx((-30, -27.5, -25))


def test_a_folder_of_dicom_files_is_in_the_order_of_their_numbers(tmp_path):
    counts = np.round(RAW[:3]).astype(np.uint16)
    for name, number in (("a", 2), ("b", 0), ("c", 1)):
        dicom(
            tmp_path / f"{name}.dcm",
            counts[number],
            **{**XA, "PositionerPrimaryAngle": 10 * number, "InstanceNumber": number},
        )
    np.testing.assert_allclose(lines_of(tmp_path, open_beam=4000), -np.log(counts / 4000), atol=1e-6)
    assert read_geometry(tmp_path).angles_deg == pytest.approx((0, 10, 20))


def test_dicom_files_without_endings_or_numbers_are_in_the_order_of_their_names(tmp_path):
    counts = np.round(RAW[:3]).astype(np.uint16)
    for number, index in ((1, 0), (2, 1), (10, 2)):
        dicom(tmp_path / f"IM{number}", counts[index], **{**XA, "PositionerPrimaryAngle": number})
    np.testing.assert_allclose(lines_of(tmp_path, open_beam=4000), -np.log(counts / 4000), atol=1e-6)
    assert read_geometry(tmp_path).angles_deg == pytest.approx((1, 2, 10))
    assert read_geometry(tmp_path / "IM10").angles_deg == pytest.approx((10,))
    dicom(tmp_path / "IM10", counts[2], **{**XA, "PositionerPrimaryAngle": 10, "InstanceNumber": 7})
    for read in (read_geometry, read_projections):
        with pytest.raises(ValueError, match="do not say their order"):
            read(tmp_path)


def test_two_dicom_series_in_a_folder_are_refused_and_single_exposures_are_views(tmp_path):
    for index, series in enumerate(("1.2", "1.2", "1.3")):
        dicom(tmp_path / f"{index}.dcm", RAW[index], **XA, InstanceNumber=index, SeriesInstanceUID=series)
    with pytest.raises(ValueError, match="belong to 2 series"):
        read_projections(tmp_path, open_beam=4000)
    (tmp_path / "0.dcm").unlink()
    assert len(lines_of(tmp_path, open_beam=4000)) == 2


def test_a_link_within_the_folder_may_lead_to_data_elsewhere(tmp_path):
    (tmp_path / "store").mkdir()
    np.save(tmp_path / "store" / "views.npy", RAW)
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "views.npy").symlink_to(tmp_path / "store" / "views.npy")
    (tmp_path / "scan" / "scan.yaml").write_text("images: views.npy\nopen_beam: 4000\n")
    assert lines_of(tmp_path / "scan" / "scan.yaml").shape == RAW.shape


def test_each_dicom_file_has_distances_of_its_own_and_pixels_of_one_size(tmp_path):
    for index, sdd in enumerate((1200, 1300)):
        dicom(tmp_path / f"{index}.dcm", RAW[index], **{**XA, "DistanceSourceToDetector": sdd})
    assert read_geometry(tmp_path).detector_distances.tolist() == pytest.approx([1200, 1300])
    dicom(tmp_path / "1.dcm", RAW[1], **{**XA, "ImagerPixelSpacing": [0.2, 0.2]})
    with pytest.raises(ValueError, match="pixels of different numbers or sizes"):
        read_geometry(tmp_path)
    dicom(tmp_path / "1.dcm", RAW[1], **XA, PixelIntensityRelationshipSign=-1)
    with pytest.raises(ValueError, match="fewer X-rays"):
        read_projections(tmp_path / "1.dcm", open_beam=4000)


def test_dicom_that_does_not_say_enough_is_refused(tmp_path):
    def refused(reason: str, **tags: object) -> None:
        dicom(tmp_path / "x.dcm", RAW[:3], **{**XA, **tags})
        with pytest.raises(ValueError, match=reason):
            read_geometry(tmp_path / "x.dcm")

    refused("DistanceSourceToDetector must hold numbers", DistanceSourceToDetector=None)
    refused("must lie between 0 and", DistanceSourceToPatient=1300)
    refused("Increment has 2 values for 3 frames", PositionerPrimaryAngleIncrement=[0, 1])
    refused("flipped or turned", FieldOfViewHorizontalFlip="YES")
    dicom(tmp_path / "x.dcm", RAW[:3], **XA, PixelIntensityRelationship="DISP")
    with pytest.raises(ValueError, match="pixels are DISP of the X-ray intensity"):
        read_projections(tmp_path / "x.dcm", open_beam=4000)
    (tmp_path / "x.dcm").write_bytes(b"DICM")
    with pytest.raises(ValueError, match="no DICOM file"):
        read_geometry(tmp_path / "x.dcm")


def test_colours_are_no_projections(tmp_path):
    image = sitk.GetImageFromArray(np.zeros((4, 5, 6, 3), np.uint8), isVector=True)
    sitk.WriteImage(image, str(tmp_path / "c.mha"))
    with pytest.raises(ValueError, match="3 numbers a pixel"):
        read_projections(tmp_path / "c.mha")
    Image.new("RGB", (5, 4)).save(tmp_path / "c.tif")
    with pytest.raises(ValueError, match="kind RGB, not grey"):
        read_projections(tmp_path / "c.tif")


def test_pages_of_a_tiff_are_views(tmp_path):
    """Written by another library, compressed, of 16 bits and of floats."""
    counts = np.round(RAW).astype(np.uint16)
    pages = [Image.fromarray(view) for view in counts]
    pages[0].save(tmp_path / "p.tif", save_all=True, append_images=pages[1:], compression="tiff_lzw")
    np.testing.assert_allclose(lines_of(tmp_path / "p.tif", open_beam=4000), -np.log(counts / 4000), atol=1e-6)
    part = ProjectionFile(tmp_path / "p.tif", open_beam=4000).read([11, 0])
    np.testing.assert_allclose(part.line_integrals, -np.log(counts[[11, 0]] / 4000), atol=1e-6)
    image(tmp_path / "f.tif", LINES.astype(np.float32))
    np.testing.assert_allclose(lines_of(tmp_path / "f.tif"), LINES, rtol=1e-6)


def test_headers_of_other_programs_are_read(tmp_path):
    """Keys of DICOM's, comments, flags as numbers; and what ITK's reader does not survive is refused."""
    stack = RAW.astype("<f4")
    head = (
        "ObjectType = Image\nNDims = 3\nComment = plate, loaded = 300 N\nBinaryData = True\n0018|0060 = 90\n"
        "BinaryDataByteOrderMSB = False\nCompressedData = False\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 0 0 0\n"
        "ElementSpacing = 0.4 0.4 1\nDimSize = 7 6 12\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
    )
    (tmp_path / "a.mha").write_bytes(head.encode() + stack.tobytes())
    np.testing.assert_allclose(lines_of(tmp_path / "a.mha", open_beam=4000), -np.log(stack / 4000), atol=1e-5)
    for wrong, reason in (("BinaryData = True", "BinaryData = rue"), ("NDims = 3", "NDims = -1")):
        (tmp_path / "b.mha").write_bytes(head.replace(wrong, reason).encode() + stack.tobytes())
        with pytest.raises(ValueError, match="its header's"):
            read_projections(tmp_path / "b.mha", open_beam=4000)


def test_vectors_and_detached_headers(tmp_path):
    """A displacement field is no projections; data that lie beside their header are not asked for their size."""
    field = sitk.GetImageFromArray(np.zeros((4, 5, 6, 3), np.float32), isVector=True)
    sitk.WriteImage(field, str(tmp_path / "field.nii"))
    with pytest.raises(ValueError, match="3 numbers a pixel"):
        read_projections(tmp_path / "field.nii")
    stack = np.tile(LINES, (1, 40, 30)).astype(np.float32)
    sitk.WriteImage(sitk.GetImageFromArray(stack), str(tmp_path / "s.nhdr"))
    np.testing.assert_array_equal(lines_of(tmp_path / "s.nhdr"), stack)


def test_numbers_of_a_tiff_are_what_was_stored(tmp_path):
    counts = np.array([[1, 2**31 + 5], [7, 2**32 - 1]], np.uint32)
    image(tmp_path / "u.tif", counts)
    np.testing.assert_allclose(
        lines_of(tmp_path / "u.tif", open_beam=2.0**32), -np.log(counts / 2.0**32)[None], rtol=1e-5, atol=1e-6
    )
    Image.fromarray(np.full((4, 5), 9, np.uint8)).save(tmp_path / "w.tif", tiffinfo={262: 0})
    with pytest.raises(ValueError, match="white is zero"):
        read_projections(tmp_path / "w.tif", open_beam=255)


def test_a_folder_may_mix_endings_of_one_kind(tmp_path):
    for index, suffix in enumerate((".tif", ".TIFF", ".TIF")):
        image(tmp_path / f"{index}.tif", LINES[index].astype(np.float32))
        (tmp_path / f"{index}.tif").rename(tmp_path / f"{index}{suffix}")
    np.testing.assert_allclose(lines_of(tmp_path), LINES[:3], rtol=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ["p_-2.tif", "p_-1.tif", "p_0.tif", "p_1.tif", "p_10.tif"],
        ["view-2.tif", "view-1.tif", "view0.tif", "view1.tif"],
        ["scan-001.tif", "scan-002.tif", "scan-010.tif"],
        ["2024-05-01_2.tif", "2024-05-01_10.tif", "2024-05-02_1.tif"],
        ["-1.5.tif", "-0.5.tif", "0.5.tif"],
        ["angle=-0.50.tif", "angle=-0.25.tif", "angle=0.00.tif"],
        ["1.2.9.tif", "1.2.10.tif"],
        ["IM.0001", "IM.0002"],
        ["a.nii.gz", "b.nii.gz"],
    ],
)
def test_views_are_in_the_order_of_the_numbers_in_their_names(names):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [path.name for path in in_order(Path(name) for name in reversed(names))] == names


def test_points_in_names_that_could_separate_numbers_are_said():
    names = ["p_0.0.tif", "p_0.25.tif", "p_0.5.tif", "p_1.0.tif"]
    with pytest.warns(UserWarning, match=r"read as decimal points: p_0.0.tif, p_0.25.tif"):
        assert [path.name for path in in_order(Path(name) for name in reversed(names))] == names


def beamline(path, put, flat=3000):
    """A Data Exchange file of 3 views whose data are put there by a function of the group."""
    with h5py.File(path, "w") as file:
        group = file.create_group("exchange")
        put(group)
        group["data_white"] = np.full((2, 30, 40), flat, np.uint16)


def test_hdf5_that_cannot_be_read_says_why_and_what_to_do(tmp_path):
    images = np.full((3, 30, 40), 2000, np.uint16)

    def stopped(group):
        data = group.create_dataset("data", images.shape, "u2", chunks=(1, 30, 40))
        data[0], data[2] = images[0], images[2]

    beamline(tmp_path / "plain.h5", lambda group: group.create_dataset("data", data=images))
    assert read_projections(tmp_path / "plain.h5").line_integrals.shape == (3, 30, 40)
    link = h5py.ExternalLink("plain.h5", "/exchange/data")
    beamline(tmp_path / "link.h5", lambda group: group.__setitem__("data", link))
    with pytest.raises(ValueError, match=r"link\.h5.* link to another file, plain\.h5: give the file"):
        read_projections(tmp_path / "link.h5")
    beamline(tmp_path / "stopped.h5", stopped)
    with pytest.raises(ValueError, match=r"stopped\.h5.* view 1 was never written"):
        read_projections(tmp_path / "stopped.h5")
    beamline(tmp_path / "lzf.h5", lambda group: group.create_dataset("data", data=images, compression="lzf"))
    if importlib.util.find_spec("lzf") is None:
        with pytest.raises(ValueError, match=r"compressed by LZF, which cannot be read here: rewrite it"):
            read_projections(tmp_path / "lzf.h5")
    beamline(tmp_path / "soft.h5", lambda group: group.__setitem__("data", h5py.SoftLink("/nowhere")))
    with pytest.raises(ValueError, match="no dataset"):
        read_projections(tmp_path / "soft.h5", views=[0])


def test_images_that_were_divided_by_their_flat_field_are_refused(tmp_path):
    shares = np.full((3, 30, 40), 0.66, np.float32)
    beamline(tmp_path / "divided.h5", lambda group: group.create_dataset("data", data=shares))
    with pytest.raises(ValueError, match="were divided already: give an open beam of 1"):
        read_projections(tmp_path / "divided.h5")
    with pytest.warns(UserWarning, match="says an open beam of 3000, but 1 was given"):
        lines = read_projections(tmp_path / "divided.h5", open_beam=1.0).line_integrals
    assert lines.mean() == pytest.approx(-np.log(0.66), rel=1e-5)
