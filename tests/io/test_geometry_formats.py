"""Geometries in the formats of other packages: RTK's XML, tables of matrices, ASTRA's and LEAP's vectors."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh

from torchkcreg.cli import main
from torchkcreg.geometry import (
    ConeBeamGeometry,
    circular_geometry,
    from_astra,
    from_leap,
    from_leap_cone,
    from_tigre,
    gantry_about_z,
    to_astra,
    to_leap,
)
from torchkcreg.io import (
    read_geometry,
    read_mesh,
    read_projections,
    read_rtk,
    read_run,
    write_geometry,
    write_mesh,
    write_rtk,
)

SIZE = {"det_shape": (20, 31), "pixel_spacing": (0.8, 1.2)}
GEOMETRY = circular_geometry(range(0, 360, 30), sad=404, sdd=538, det_offset_mm=(3, -2), source_z_mm=7.0, **SIZE)
# Written by RTK's own writer, of random parameters.
WRITTEN_BY_RTK = """<?xml version="1.0"?>
<!DOCTYPE RTKGEOMETRY>
<RTKThreeDCircularGeometry version="3">
  <Projection>
    <GantryAngle>14.7504686170301</GantryAngle>
    <SourceToIsocenterDistance>427.392337464291</SourceToIsocenterDistance>
    <SourceToDetectorDistance>680.936014129161</SourceToDetectorDistance>
    <SourceOffsetX>9.17986243935994</SourceOffsetX>
    <SourceOffsetY>1.74499965861692</SourceOffsetY>
    <ProjectionOffsetX>-19.3388945788588</ProjectionOffsetX>
    <ProjectionOffsetY>12.5308095680109</ProjectionOffsetY>
    <InPlaneAngle>4.2654310306872</InPlaneAngle>
    <OutOfPlaneAngle>16.5102230911089</OutOfPlaneAngle>
    <Matrix>
        -653.373888220454   -56.6624844407958    185.416018425205   -5937.79928388092
        -2.78980769695661   -647.986891127912   -209.512278716329    5798.00562081675
        0.244112049670937  -0.284186419126955   0.927171713540298   -427.392337464291
    </Matrix>
  </Projection>
</RTKThreeDCircularGeometry>
"""
MATRIX = [
    [-653.373888220454, -56.6624844407958, 185.416018425205, -5937.79928388092],
    [-2.78980769695661, -647.986891127912, -209.512278716329, 5798.00562081675],
    [0.244112049670937, -0.284186419126955, 0.927171713540298, -427.392337464291],
]


def same(one: ConeBeamGeometry, other: ConeBeamGeometry, tolerance: float = 1e-7) -> bool:
    largest = other.projection_matrices.abs().max()
    return bool((one.projection_matrices - other.projection_matrices).abs().max() < tolerance * largest)


def test_the_matrices_of_rtks_file_end_on_pixels_by_the_half_pixel_rule(tmp_path):
    """RTK's matrix ends in mm; the detector's middle, half a pixel beside pixel (n - 1) // 2 for even n, is at 0."""
    (tmp_path / "geometry.xml").write_text(WRITTEN_BY_RTK)
    geometry = read_rtk(tmp_path / "geometry.xml", **SIZE)
    points = torch.rand(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 60 - 30
    u, v, w = torch.tensor(MATRIX).double() @ torch.cat([points, torch.ones(20, 1)], dim=1).double().T
    found, _ = geometry.project(points)
    expected = torch.stack([u / w / 1.2 + 15, v / w / 0.8 + 9.5], dim=-1)
    assert torch.allclose(found[0], expected, atol=1e-5)
    shifted = read_rtk(tmp_path / "geometry.xml", **SIZE, origin_mm=(-18.0 + 1.2, -7.6 - 0.8))
    assert torch.allclose(shifted.project(points)[0][0], expected - torch.tensor([1.0, -1.0]), atol=1e-5)


def test_a_geometry_comes_back_from_rtks_file(tmp_path):
    write_rtk(tmp_path / "geometry.xml", GEOMETRY)
    assert same(read_rtk(tmp_path / "geometry.xml", **SIZE), GEOMETRY)
    turned = GEOMETRY.moved(gantry_about_z("y"))  # into RTK's world
    write_rtk(tmp_path / "turned.xml", turned)
    again = read_rtk(tmp_path / "turned.xml", **SIZE)
    assert again.angles_deg == pytest.approx([a if a <= 180 else a - 360 for a in range(0, 360, 30)], abs=1e-6)
    assert same(again.moved(torch.linalg.inv(gantry_about_z("y"))), GEOMETRY)


def test_shared_values_of_rtks_file_hold_for_all_views(tmp_path):
    text = """<RTKThreeDCircularGeometry version="3"><SourceToIsocenterDistance>404</SourceToIsocenterDistance>
    <SourceToDetectorDistance>538</SourceToDetectorDistance><Projection><GantryAngle>0</GantryAngle></Projection>
    <Projection><GantryAngle>90</GantryAngle></Projection></RTKThreeDCircularGeometry>"""
    (tmp_path / "g.xml").write_text(text)
    found = read_rtk(tmp_path / "g.xml", **SIZE).moved(torch.linalg.inv(gantry_about_z("y")))
    assert same(found, circular_geometry([0, 90], sad=404, sdd=538, **SIZE))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("14.7504686170301", "24.7504686170301"), "Matrix is not that of its angles"),
        (("427.392337464291</Source", "nan</Source"), "must be a finite number"),
        (("680.936014129161", "0"), "parallel rays are not read"),
        (("<Matrix>", "<Matrix>1 "), "must have 12 numbers"),
        (("RTKThreeDCircularGeometry", "Other"), "must be a RTKThreeDCircularGeometry"),
        (("<!DOCTYPE RTKGEOMETRY>", '<!DOCTYPE x [<!ENTITY a "b">]>'), "must not define entities"),
        (("<Projection>", "<RadiusCylindricalDetector>900</RadiusCylindricalDetector><Projection>"), "cylindrical"),
        (("</Projection>", ""), "mismatched tag"),
    ],
)
def test_what_is_wrong_with_rtks_file_is_told(tmp_path, change, reason):
    (tmp_path / "g.xml").write_text(WRITTEN_BY_RTK.replace(*change))
    with pytest.raises(ValueError, match=reason):
        read_rtk(tmp_path / "g.xml", **SIZE)


def test_a_mirror_image_is_not_written_for_rtk(tmp_path):
    flip = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    flip[1, 2] = 19.0
    mirrored = ConeBeamGeometry(flip @ GEOMETRY.projection_matrices, **SIZE)
    with pytest.raises(ValueError, match="no mirror images"):
        write_rtk(tmp_path / "g.xml", mirrored)
    assert not (tmp_path / "g.xml").exists()


@pytest.mark.parametrize("name", ["g.npy", "g.npz", "g.csv", "g.txt"])
@pytest.mark.parametrize("layout", ["matrices", "astra"])
def test_tables_come_back_to_the_same_numbers(tmp_path, name, layout):
    write_geometry(tmp_path / name, GEOMETRY, layout=layout)
    assert same(read_geometry(tmp_path / name, **SIZE, layout=layout), GEOMETRY, 1e-12)
    if layout == "astra":
        with pytest.raises(ValueError, match="say layout matrices or astra"):
            read_geometry(tmp_path / name, **SIZE)
        with pytest.raises(ValueError, match="mm apart"):
            read_geometry(tmp_path / name, det_shape=(20, 31), pixel_spacing=(1.0, 1.0), layout="astra")


def test_tables_that_hold_something_else_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((2, 5)))
    np.save(tmp_path / "b.npy", np.array([{"a": 1}]), allow_pickle=True)
    (tmp_path / "c.csv").write_text("1,2,3,x\n")
    np.savez(tmp_path / "d.npz", a=np.ones(3), b=np.ones(3))
    np.savez_compressed(tmp_path / "e.npz", np.zeros((1 << 24,)))  # packs to a hundredth
    reasons = {
        "e.npz": "unpacks to",
        "a.npy": "got an array of shape",
        "b.npy": "Python objects",
        "c.csv": "c.csv",
        "d.npz": "one array",
    }
    for name, reason in reasons.items():
        with pytest.raises(ValueError, match=reason):
            read_geometry(tmp_path / name, **SIZE)


def test_leaps_and_astras_vectors_are_the_same_views():
    assert same(from_astra(to_astra(GEOMETRY), (20, 31)), GEOMETRY, 1e-12)
    assert same(from_leap(**to_leap(GEOMETRY), **SIZE), GEOMETRY, 1e-12)
    source, center, across, down = to_astra(GEOMETRY)[0].split(3)  # angle 0: the source at +x, columns along +y
    assert source.tolist() == pytest.approx([404, 0, 7]) and across.tolist() == pytest.approx([0, 1.2, 0])
    assert center.tolist() == pytest.approx([-134, -2, 3]) and down.tolist() == pytest.approx([0, 0, 0.8])
    with pytest.raises(ValueError, match=r"shape \(V, 12\)"):
        from_astra(torch.ones(3, 11), (4, 4))
    with pytest.raises(ValueError, match="one size in all views"):
        from_astra(to_astra(GEOMETRY) * torch.linspace(1, 2, 12)[:, None], (20, 31))


def test_parameters_of_leap_and_tigre_are_the_same_views():
    angles = torch.arange(0.0, 360.0, 30.0, dtype=torch.float64)
    level = circular_geometry(angles.tolist(), sad=404, sdd=538, det_offset_mm=(3, -2), **SIZE)
    # the central ray hits the detector 3 mm below and 2 mm beside its middle
    leap = from_leap_cone(20, 31, 0.8, 1.2, 9.5 - 3 / 0.8, 15 + 2 / 1.2, angles + 90, 404, 538)
    assert same(leap, level, 1e-12) and leap.angles_deg == tuple((angles + 90).tolist())
    tigre = {"DSD": 538, "DSO": 404, "nDetector": (20, 31), "dDetector": (0.8, 1.2), "offDetector": (3, -2)}
    assert same(from_tigre(SimpleNamespace(**tigre), torch.deg2rad(angles)), level, 1e-12)
    moved = from_tigre(SimpleNamespace(**tigre, offOrigin=(1.0, 2.0, 3.0)), torch.deg2rad(angles))  # z, y, x
    shift = level.source_positions - moved.source_positions
    torch.testing.assert_close(shift, torch.tensor([3.0, 2.0, 1.0]).double().expand(12, 3))


def test_leaps_and_tigres_axis_beside_the_central_ray():
    """A point on an axis that is tau beside the central ray is seen tau's magnified length beside the middle."""
    point = torch.zeros(1, 3, dtype=torch.float64)
    leap = from_leap_cone(21, 31, 1.0, 1.0, 10, 15, [0.0, 70.0], 400, 600, tau=4.0)
    tigre = SimpleNamespace(DSD=[600, 600], DSO=[400, 400], nDetector=(21, 31), dDetector=(1.0, 1.0), COR=-4.0)
    for geometry in (leap, from_tigre(tigre, torch.deg2rad(torch.tensor([-90.0, -20.0])))):
        pixels = geometry.project(point)[0]
        torch.testing.assert_close(pixels, torch.tensor([[[21.0, 10.0]], [[21.0, 10.0]]]).double())
    tilted = from_leap_cone(21, 31, 1.0, 1.0, 10, 15, [90.0], 400, 600, tilt_angle=90.0)
    seen = tilted.project(torch.tensor([[0.0, 0.0, 2.0]]).double())[0]  # up is now along the columns
    torch.testing.assert_close(seen, torch.tensor([[[18.0, 10.0]]]).double())
    with pytest.raises(ValueError, match="mode cone, got parallel"):
        from_tigre(SimpleNamespace(mode="parallel"), [0.0])
    with pytest.raises(ValueError, match="rotated detector"):
        from_tigre(SimpleNamespace(rotDetector=(0.0, 0.1, 0.0)), [0.0])
    with pytest.raises(ValueError, match="one rotation about z per view"):
        from_tigre(tigre, torch.zeros(2, 3))


def test_the_header_of_the_projections_says_what_the_pixels_are(tmp_path):
    write_rtk(tmp_path / "g.xml", GEOMETRY)
    image = sitk.GetImageFromArray(np.zeros((12, 20, 31), np.float32))
    image.SetSpacing((1.2, 0.8, 1.0))
    image.SetOrigin((-18.0, -7.6, 0.0))
    sitk.WriteImage(image, str(tmp_path / "stack.mha"))
    assert same(read_geometry(tmp_path / "g.xml", projections=tmp_path / "stack.mha"), GEOMETRY)
    with pytest.raises(ValueError, match="does not say what the pixels are"):
        read_geometry(tmp_path / "g.xml")
    image.SetSpacing((1.0, 1.0, 1.0))
    sitk.WriteImage(image, str(tmp_path / "default.mha"))
    with pytest.raises(ValueError, match="does not say what the pixels are"):
        read_geometry(tmp_path / "g.xml", projections=tmp_path / "default.mha")


def test_the_command_line_converts(tmp_path, capsys):
    write_rtk(tmp_path / "g.xml", GEOMETRY.moved(gantry_about_z("y")))
    pixels = ["--rows", "20", "--cols", "31", "--pixel-pitch", "0.8", "1.2"]
    source, target = str(tmp_path / "g.xml"), str(tmp_path / "g.json")
    assert main(["convert", source, target, *pixels, "--gantry-axis", "y"]) == 0
    assert "12 views of 20 x 31 pixels" in capsys.readouterr().out
    assert same(read_geometry(target), GEOMETRY)
    assert main(["convert", source, target, *pixels]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["convert", source, str(tmp_path / "h.json")]) == 2
    assert "does not say what the pixels are" in capsys.readouterr().err
    assert main(["convert", target, str(tmp_path / "v.csv"), "--layout", "astra"]) == 0
    assert same(read_geometry(tmp_path / "v.csv", **SIZE, layout="astra"), GEOMETRY)


def test_a_registration_from_rtks_geometry_and_a_stack_is_that_from_json(small_case, tmp_path):
    """The same views, in RTK's XML and an MHA with a header: the same implant in the same place."""
    geometry = read_geometry(small_case / "geometry.json")
    with np.load(small_case / "projections.npz") as arrays:
        intensity, open_beam = arrays["intensity"], float(np.mean(arrays["open_beam"]))
    write_rtk(tmp_path / "geometry.xml", geometry)
    image = sitk.GetImageFromArray(intensity)
    (rows, cols), (dv, du) = geometry.det_shape, geometry.pixel_spacing
    image.SetSpacing((du, dv, 1.0))
    image.SetOrigin((-(cols - 1) / 2 * du, -(rows - 1) / 2 * dv, 0.0))
    sitk.WriteImage(image, str(tmp_path / "stack.mha"))
    common = ["--implant", str(small_case / "implant.stl"), "--config", str(small_case / "quick.yaml"), "--no-figures"]
    files = {
        "rtk": ["--geometry", tmp_path / "geometry.xml", "--projections", tmp_path / "stack.mha"],
        "json": ["--geometry", small_case / "geometry.json", "--projections", small_case / "projections.npz"],
    }
    moved = {}
    for name, own in files.items():
        arguments = [*common, *map(str, own), "--open-beam", str(open_beam), "--out", str(tmp_path / name)]
        assert main(["register", *arguments]) in (0, 3)
        moved[name] = read_run(tmp_path / name).warp(torch.tensor([[0.0, 0.0, 30.0], [0.0, 0.0, -30.0]]))
    assert torch.allclose(moved["rtk"], moved["json"], atol=0.01)


def test_meshes_and_projections_are_converted_by_the_targets_ending(tmp_path, capsys):
    counts = np.full((3, 6, 7), 1000.0, np.float32)
    counts[1, 2, 3] = np.nan
    np.save(tmp_path / "scan.npy", counts)
    flags = ["--open-beam", "2000", "--pixel-pitch", "0.5", "0.4"]
    assert main(["convert", str(tmp_path / "scan.npy"), str(tmp_path / "lines.mha"), *flags]) == 0
    assert "3 views of 6 x 7 pixels" in capsys.readouterr().out
    found = read_projections(tmp_path / "lines.mha")
    assert found.num_masked == {"not finite": 1} and not found.mask[1, 2, 3]
    assert float(found.line_integrals[0, 0, 0]) == pytest.approx(np.log(2), abs=1e-6)
    image = sitk.ReadImage(str(tmp_path / "lines.mha"))
    assert image.GetSpacing()[:2] == pytest.approx((0.4, 0.5)) and image.GetOrigin()[:2] == pytest.approx((-1.2, -1.25))
    write_mesh(tmp_path / "box.stl", trimesh.creation.box((30.0, 4.0, 90.0)))
    assert main(["convert", str(tmp_path / "box.stl"), str(tmp_path / "box.ply")]) == 0
    assert "12 triangles, 30 x 4 x 90 mm" in capsys.readouterr().out
    assert read_mesh(tmp_path / "box.ply").volume == pytest.approx(30 * 4 * 90)
    assert main(["convert", str(tmp_path / "lines.mha"), str(tmp_path / "lines.nii.gz")]) == 0
    for target in ("lines.npz", "lines.tif"):
        assert main(["convert", str(tmp_path / "lines.mha"), str(tmp_path / target)]) == 2
        assert "line integrals as .mha, .nrrd" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spacing", "origin", "flags", "expected"),
    [
        ((2.0, 2.0), (-30.0, -39.0), [], ((2.0, 2.0), (-30.0, -39.0))),
        ((2.0, 2.0), (-30.0, -39.0), ["--pixel-pitch", "2"], ((2.0, 2.0), (-30.0, -39.0))),
        ((1.0, 1.0), (0.0, 0.0), ["--pixel-pitch", "2"], ((2.0, 2.0), (-59.0, -39.0))),  # no header: centred
    ],
)
def test_a_converted_stack_keeps_where_its_detector_is(tmp_path, spacing, origin, flags, expected):
    stack = sitk.GetImageFromArray(np.full((3, 40, 60), 30000, np.uint16))
    stack.SetSpacing((*spacing, 1.0))
    stack.SetOrigin((*origin, 0.0))
    sitk.WriteImage(stack, str(tmp_path / "stack.mha"))
    arguments = ["convert", str(tmp_path / "stack.mha"), str(tmp_path / "lines.mha"), "--open-beam", "65535"]
    assert main([*arguments, *flags]) == 0
    lines = sitk.ReadImage(str(tmp_path / "lines.mha"))
    assert (lines.GetSpacing()[:2], lines.GetOrigin()[:2]) == expected
