"""What ParaView and 3D Slicer open: read back by VTK's own readers where they are, and by their bytes."""

from __future__ import annotations

import base64
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh

from torchkcreg.io import write_point_cloud_ply, write_points_vtp, write_surface_vtu

POINTS = torch.rand(7, 3, generator=torch.Generator().manual_seed(0))


def test_points_and_values_are_what_the_bytes_say(tmp_path):
    write_points_vtp(tmp_path / "p.vtp", POINTS, {"displacement_mm": 2 * POINTS, "expected_error_mm": POINTS[:, 0]})
    tree = ElementTree.parse(tmp_path / "p.vtp").getroot()
    found = {}
    for array in tree.iter("DataArray"):
        raw = base64.b64decode(array.text)
        kind = "<i8" if array.get("type") == "Int64" else "<f4"
        assert int(np.frombuffer(raw[:8], "<u8")[0]) == len(raw) - 8
        found[array.get("Name")] = np.frombuffer(raw[8:], kind)
    np.testing.assert_array_equal(found["Points"].reshape(-1, 3), POINTS.numpy())
    np.testing.assert_array_equal(found["displacement_mm"].reshape(-1, 3), 2 * POINTS.numpy())
    assert found["offsets"].tolist() == [1, 2, 3, 4, 5, 6, 7]
    with pytest.raises(ValueError, match="a value for each of 7 points, got 3"):
        write_points_vtp(tmp_path / "q.vtp", POINTS, {"x": torch.zeros(3)})


def test_vtk_reads_both(tmp_path):
    vtk = pytest.importorskip("vtk", reason="the reader of ParaView and 3D Slicer is not installed")
    from vtk.util.numpy_support import vtk_to_numpy

    write_points_vtp(tmp_path / "p.vtp", POINTS, {"displacement_mm": 2 * POINTS, "expected_error_mm": POINTS[:, 0]})
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    write_surface_vtu(tmp_path / "s.vtu", box, {"stress": torch.arange(8.0)})
    write_point_cloud_ply(tmp_path / "p.ply", POINTS, 2 * POINTS, POINTS[:, 0])
    cloud = vtk.vtkPLYReader()
    cloud.SetFileName(str(tmp_path / "p.ply"))
    cloud.Update()
    np.testing.assert_allclose(vtk_to_numpy(cloud.GetOutput().GetPoints().GetData()), POINTS.numpy())
    for reader, path in ((vtk.vtkXMLPolyDataReader(), "p.vtp"), (vtk.vtkXMLUnstructuredGridReader(), "s.vtu")):
        reader.SetFileName(str(tmp_path / path))
        reader.Update()
        assert reader.GetErrorCode() == 0
        data = reader.GetOutput()
        points = vtk_to_numpy(data.GetPoints().GetData())
        if path == "p.vtp":
            np.testing.assert_allclose(points, POINTS.numpy())
            assert data.GetNumberOfVerts() == 7
            moved = vtk_to_numpy(data.GetPointData().GetArray("displacement_mm"))
            np.testing.assert_allclose(moved, 2 * POINTS.numpy())
        else:
            np.testing.assert_allclose(points, box.vertices)
            assert data.GetNumberOfCells() == 12
            assert vtk_to_numpy(data.GetPointData().GetArray("stress")).tolist() == list(range(8))
