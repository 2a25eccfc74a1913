from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchkcreg.implant import Component, cylinder_cloud, cylinder_mesh

_START, _END, _RADIUS = (1.0, -2.0, 3.0), (7.0, 10.0, 7.0), 1.75


def test_a_cylinder_has_its_volume_centre_and_axis() -> None:
    cloud = cylinder_cloud(_START, _END, _RADIUS, 0.3, dtype=torch.float64)
    assert cloud.volume == pytest.approx(math.pi * _RADIUS**2 * 14.0, rel=1e-7)
    center, axes, extents = cloud.principal_axes()
    np.testing.assert_allclose(center.numpy(), [4.0, 4.0, 5.0], atol=0.01)
    np.testing.assert_allclose(axes[2].numpy(), np.array([6.0, 12.0, 4.0]) / 14, atol=0.01)
    assert extents[2].item() == pytest.approx(14.0, abs=0.6)


def test_a_cylinder_mesh_is_closed_whatever_its_sections() -> None:
    for sections in (3, 7, 64):
        mesh = cylinder_mesh(_START, _END, _RADIUS, sections=sections)
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(math.pi * _RADIUS**2 * 14.0, rel=1e-9)


def test_a_screw_points_from_its_head_to_its_tip() -> None:
    screw = Component.screw("s1", _START, _END, _RADIUS, material="titanium", pitch=0.5)
    torch.testing.assert_close(screw.head, torch.tensor(_START))
    torch.testing.assert_close(screw.axis, torch.tensor([6.0, 12.0, 4.0]) / 14)
    assert screw.material == "titanium" and screw.cloud.volume == pytest.approx(134.7, rel=1e-3)


def test_cylinders_without_extent_are_refused() -> None:
    for arguments in ((_START, _START, 1.0), (_START, _END, 0.0), (_START, _END[:2], 1.0), (_START, _END, math.nan)):
        with pytest.raises(ValueError):
            cylinder_mesh(*arguments)
    with pytest.raises(ValueError, match="sections"):
        cylinder_mesh(_START, _END, 1.0, sections=2)
    cloud = cylinder_cloud(_START, _END, 1.0, 0.5)
    with pytest.raises(ValueError, match="axis must not be zero"):
        Component("s", cloud, "steel", torch.zeros(3), torch.zeros(3))
    with pytest.raises(ValueError, match="head and axis"):
        Component("s", cloud, "steel", torch.zeros(2), torch.ones(3))
