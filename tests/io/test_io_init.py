import json
import math

import pytest
import torch

from torchkcreg.geometry import rigid_matrix
from torchkcreg.io import read_init, read_tra, write_init, write_tra


@pytest.fixture
def pose():
    return rigid_matrix(
        torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64), torch.tensor([12.0, -246.6, 0.5], dtype=torch.float64)
    )


def written(tmp_path, content):
    (tmp_path / "init.json").write_text(json.dumps(content))
    return tmp_path / "init.json"


def test_a_pose_comes_back_as_it_was_written(tmp_path, pose):
    write_init(tmp_path / "init.json", pose)
    torch.testing.assert_close(read_init(tmp_path / "init.json"), pose, rtol=0, atol=1e-14)


def test_bare_rows_are_a_pose_too(tmp_path, pose):
    torch.testing.assert_close(read_init(written(tmp_path, pose.tolist())), pose, rtol=0, atol=1e-14)


@pytest.mark.parametrize("decimals", [3, 5, 8])
def test_rounded_rows_become_an_exact_rotation_nearby(tmp_path, pose, decimals):
    rounded = pose.clone()
    rounded[:3, :3] = pose[:3, :3].round(decimals=decimals)
    read = read_init(written(tmp_path, {"implant_to_world": rounded.tolist()}))
    rotation = read[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)
    assert torch.linalg.det(rotation) == pytest.approx(1)
    assert (rotation - pose[:3, :3]).abs().max() < 2 * 10**-decimals
    assert torch.equal(read[:, 3], pose[:, 3])


def scaled(pose):
    pose[:3, :3] *= 1.01


def sheared(pose):
    pose[:3, 0] += 0.01 * pose[:3, 1]


def mirrored(pose):
    pose[:3, 0] *= -1


def projective(pose):
    pose[3, 0] = 0.1


def unbounded(pose):
    pose[0, 3] = math.inf


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (scaled, "rigid, but its axes have lengths 1.01"),
        (sheared, "scalar products up to 0.01"),
        (mirrored, "not mirror"),
        (projective, "last row 0 0 0 1"),
        (unbounded, "finite"),
    ],
)
def test_a_matrix_that_is_not_rigid_is_refused_with_the_reason(tmp_path, pose, spoil, message):
    spoil(pose)
    with pytest.raises(ValueError, match=rf"^initial pose file .*init\.json: implant_to_world must .*{message}"):
        read_init(written(tmp_path, {"implant_to_world": pose.tolist()}))


def test_a_file_without_a_pose_is_refused(tmp_path):
    with pytest.raises(ValueError, match="has no 'implant_to_world'"):
        read_init(written(tmp_path, {"pose": 1}))
    with pytest.raises(ValueError, match="must be 4 x 4 numbers"):
        read_init(written(tmp_path, [[1, 0, 0, 0]] * 3))


def test_poses_over_frames_are_read_back_with_their_gaps(tmp_path):
    turn = rigid_matrix(torch.tensor([0.3, -0.2, 0.5]).double(), torch.tensor([1.0, 2.0, 3.0]).double())
    poses = torch.stack([turn, torch.full((4, 4), torch.nan).double()])
    write_tra(tmp_path / "bone.tra", poses)
    torch.testing.assert_close(read_tra(tmp_path / "bone.tra"), poses, equal_nan=True, atol=1e-7, rtol=0)
    torch.testing.assert_close(read_init(tmp_path / "bone.tra"), turn, atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("1,2,3\n", "line 1: 16 numbers"),
        ("1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n" + "2,0,0,0,0,2,0,0,0,0,2,0,0,0,0,1\n", "line 2: the matrix"),
        (",".join(["NaN"] * 16), "no pose in its first line"),
        ("\n", "is empty"),
    ],
)
def test_poses_over_frames_that_are_none_are_refused(tmp_path, text, problem):
    (tmp_path / "bone.tra").write_text(text)
    with pytest.raises(ValueError, match=problem):
        read_init(tmp_path / "bone.tra")
