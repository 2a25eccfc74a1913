import math

import pytest
import torch

from torchkcreg.geometry import rigid_matrix, transform_points, vector_from_rotation
from torchkcreg.registration import RegistrationConfig, Stage
from torchkcreg.studies.capture import CaptureStudy, CaptureTrial, capture_study, random_pose, rigid_stages


def trial(offset, error, basin):
    return CaptureTrial(offset, 1.2 * offset, error, basin, 0.9, 1.0)


def test_a_random_pose_is_off_by_so_many_mm_and_degrees_about_the_centre():
    pose = rigid_matrix(torch.tensor([0.1, 0.2, 0.3]).double(), torch.tensor([5.0, 6.0, 7.0]).double())
    center = torch.tensor([1.0, -2.0, 30.0]).double()
    start = random_pose(pose, 10.0, center, torch.Generator().manual_seed(0))
    turn = torch.linalg.inv(pose) @ start
    assert math.degrees(vector_from_rotation(turn[:3, :3]).norm()) == pytest.approx(10)
    moved = transform_points(start, center[None]) - transform_points(pose, center[None])
    assert moved.norm().item() == pytest.approx(10)


def test_shares_count_what_ends_below_the_limit_and_in_the_right_minimum():
    study = CaptureStudy((trial(5.0, 0.1, 0.0), trial(5.0, 0.3, 0.1), trial(10.0, 18.0, 18.0), trial(10.0, 0.1, 0.0)))
    assert study.offsets == (5.0, 10.0)
    assert (study.captured_share(5.0), study.basin_share(5.0), study.captured_share(10.0)) == (0.5, 1.0, 0.5)
    assert "| 10 mm, 10 deg | 2 | 12.0 | 50 % | 50 % | 9.050 | 18.000 | 1.0 |" in study.table()


def test_only_the_rigid_stages_run():
    config = RegistrationConfig(stages=(Stage(bin=4), Stage(bin=2), Stage(groups=2)))
    assert [stage.bin for stage in rigid_stages(config).stages] == [4, 2]
    with pytest.raises(ValueError, match="no rigid stage"):
        rigid_stages(RegistrationConfig(stages=(Stage(groups=2),)))


def test_small_offsets_are_captured():
    config = RegistrationConfig(material="steel", pitch_mm=1.0, stages=(Stage(pitch_factor=2, oversampling=1),))
    seen = []
    study = capture_study(offsets=[1.0], num_starts=2, config=config, binning=4, on_trial=seen.append)
    assert tuple(seen) == study.trials
    assert study.basin_share(1.0) == 1.0
    assert all(t.error_mm < 0.5 * t.start_mm for t in study.trials)


def test_a_study_needs_offsets_and_starts():
    for wrong in ({"offsets": []}, {"num_starts": 0}, {"offsets": [-1.0]}):
        with pytest.raises(ValueError, match="offsets must be"):
            capture_study(**wrong)
