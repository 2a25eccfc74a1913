"""A registration with finite elements: it finds the bend and the load, and its run folder gives both back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_scene import RIGID, image, plate

from torchkcreg.io import RunFolder, read_run
from torchkcreg.mechanics import CarriedLoad, Hold
from torchkcreg.registration import Implant, RegistrationConfig, RegistrationResult, Stage, build_scene, register
from torchkcreg.registration.implant import deformation_of

HOLDS = [Hold(f"at {z:.0f}", (0.0, 0.0, z), 4.0) for z in (-22.0, -7.0, 7.0, 22.0)]
BENDING = Stage(groups=20, modes=12, oversampling=1, tolerance=1e-4)
# Twice the default loads are expected, so that the images say more about the load than its prior does.
CONFIG = RegistrationConfig(
    stages=(*RIGID, BENDING), deformation="fe", hold_weight=1e-9, hold_force_n=400.0, hold_moment_nmm=3000.0
)


@pytest.fixture(scope="module")
def found() -> tuple[RegistrationResult, torch.Tensor, torch.Tensor]:
    """A result, the true loads, and the true positions of the nodes."""
    implant = Implant(plate(), material="titanium", holds=HOLDS)
    truth = build_scene(implant, CONFIG)
    bent = truth.assemblies[0].deformation
    bent.amounts.data[:2] = torch.tensor([-0.4, -0.2]).double()
    result = register(implant, image(truth), CONFIG)
    return result, bent.loads, truth.assemblies[0].warp(plate().points).detach()


def test_the_bend_and_the_load_are_found(found) -> None:
    result, loads, points = found
    error = (result.warp(plate().points.double()) - points).norm(dim=-1)
    assert float(error.max()) < 0.02
    assert float((result.deformation.loads - loads)[:, 3:].abs().max()) < 0.1 * float(loads[:, 3:].abs().max())


def test_the_truth_lies_about_as_far_off_as_the_loads_say(found) -> None:
    result, loads, _ = found
    carried = CarriedLoad.of(
        result.deformation.superelement, result.deformation.amounts.detach(), result.deformation.covariance
    )
    off = carried.hold_loads - loads @ torch.block_diag(carried.axes, carried.axes).mT
    assert float((off.abs() / carried.hold_std).max()) < 4
    nothing_seen = CarriedLoad.of(result.deformation.superelement, result.deformation.amounts.detach())
    assert float((carried.section_std / nothing_seen.section_std)[60, [3, 5]].max()) < 0.9  # less than without images


def test_a_run_folder_keeps_the_body_beside_its_json(found, tmp_path) -> None:
    result = found[0]
    RunFolder.create(tmp_path / "run").write_result(result, [plate().points])
    again = read_run(tmp_path / "run")
    torch.testing.assert_close(again.warp(plate().points), result.warp(plate().points), atol=1e-6, rtol=0)
    torch.testing.assert_close(again.deformation.loads, result.deformation.loads, rtol=1e-9, atol=1e-6)
    assert (tmp_path / "run" / "deformation.json").stat().st_size < 200_000


def test_damaged_or_missing_arrays_are_named(found, tmp_path) -> None:
    RunFolder.create(tmp_path / "run").write_result(found[0], [plate().points])
    arrays = tmp_path / "run" / "arrays.npz"
    whole = arrays.read_bytes()
    with np.load(arrays) as stored:
        others = {name: stored[name] for name in stored if not name.endswith("nodal")}
    np.savez(arrays, **others)
    with pytest.raises(ValueError, match=r"has no array '.*nodal'"):
        read_run(tmp_path / "run")
    arrays.write_bytes(whole[:500])
    with pytest.raises(ValueError, match=r"arrays file .* cannot be read"):
        read_run(tmp_path / "run")
    arrays.unlink()
    with pytest.raises(FileNotFoundError, match=r"arrays file .* does not exist"):
        read_run(tmp_path / "run")


def test_a_body_of_nothing_known_is_refused() -> None:
    with pytest.raises(ValueError, match="finite elements need the implant's material"):
        build_scene(plate(), CONFIG)
    with pytest.raises(ValueError, match="elastic constants are available for"):
        build_scene(Implant(plate(), material="water", holds=HOLDS), CONFIG)


def test_groups_alone_make_the_free_form_schedule() -> None:
    schedule = RegistrationConfig(deformation="ffd").schedule()
    assert all(stage.modes is None for stage in schedule) and schedule[-1].groups == 10
    assert RegistrationConfig(deformation="fe").schedule()[-1].modes == 40


def test_auto_is_finite_elements_where_the_stiffness_is_known() -> None:
    config = CONFIG.model_copy(update={"deformation": "auto"})
    models = [deformation_of(Implant(plate(), material=m, holds=HOLDS), config).model for m in ("steel", "water", None)]
    assert models == ["fe", "ffd", "ffd"]
    assert RegistrationConfig(deformation="auto").schedule() == RegistrationConfig(deformation="fe").schedule()
