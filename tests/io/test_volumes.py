import math

import pytest
import SimpleITK as sitk
import torch

from torchkcreg.geometry import VolumeGrid
from torchkcreg.io import read_volume, write_volume

TURNED = ((math.cos(0.3), -math.sin(0.3), 0.0), (math.sin(0.3), math.cos(0.3), 0.0), (0.0, 0.0, 1.0))
GRID = VolumeGrid((3, 4, 5), (0.5, 0.6, 0.8), (-10.0, 20.0, 3.5), TURNED)


@pytest.mark.parametrize("name", ["v.mha", "v.nrrd", "v.nii", "v.nii.gz"])
def test_a_volume_comes_back_with_its_grid(tmp_path, name):
    volume = torch.randn(GRID.shape, generator=torch.Generator().manual_seed(0))
    write_volume(tmp_path / name, volume, GRID)
    values, grid = read_volume(tmp_path / name)
    assert torch.equal(values, volume)
    assert grid.shape == GRID.shape
    assert torch.allclose(grid.voxel_to_world, GRID.voxel_to_world, atol=1e-4)


def test_other_programs_see_the_voxels_where_we_do(tmp_path):
    volume = torch.zeros(GRID.shape)
    volume[2, 1, 3] = 1.0
    write_volume(tmp_path / "v.mha", volume, GRID)
    image = sitk.ReadImage(str(tmp_path / "v.mha"))
    index = image.TransformPhysicalPointToIndex(GRID.points(dtype=torch.float64)[2, 1, 3].tolist())
    assert image.GetPixel(index) == 1.0


def test_what_is_no_volume_is_named(tmp_path):
    with pytest.raises(ValueError, match="must have the grid's shape"):
        write_volume(tmp_path / "v.mha", torch.zeros(2, 2, 2), GRID)
    with pytest.raises(ValueError, match="volumes are written as"):
        write_volume(tmp_path / "v.png", torch.zeros(GRID.shape), GRID)
    (tmp_path / "broken.mha").write_text("nothing")
    with pytest.raises(ValueError, match=r"broken\.mha cannot be read"):
        read_volume(tmp_path / "broken.mha")
    with pytest.raises(FileNotFoundError):
        read_volume(tmp_path / "none.mha")


@pytest.mark.parametrize("name", ["v.mha", "v.nrrd"])
def test_a_header_that_asks_for_more_than_its_file_holds_is_refused_before_anything_is_allocated(tmp_path, name):
    write_volume(tmp_path / name, torch.zeros(3, 4, 5), VolumeGrid((3, 4, 5), 1.0))
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content.replace(b"5 4 3", b"90000 90000 900"))
    with pytest.raises(ValueError, match="its header asks for 7290000000000 values"):
        read_volume(tmp_path / name)


def test_an_empty_volume_packs_well_and_is_read(tmp_path):
    write_volume(tmp_path / "v.mha", torch.zeros(120, 128, 128), VolumeGrid((120, 128, 128), 1.0))
    assert (tmp_path / "v.mha").stat().st_size < 20_000
    assert float(read_volume(tmp_path / "v.mha")[0].abs().max()) == 0
