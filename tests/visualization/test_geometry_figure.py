"""Focal spots and detectors of a scan, drawn where they are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchkcreg.geometry import DetectorFrames, MultisourceScanner, circular_geometry
from torchkcreg.visualization import geometry_figure


def test_spots_stand_where_the_geometry_has_them_by_source():
    geometry = MultisourceScanner().geometry().select([46, 47, 48, 49])
    axes = geometry_figure(geometry, points=torch.rand(5, 3)).axes[0]
    drawn = {
        cloud.get_label(): np.stack(cloud._offsets3d, -1) for cloud in axes.collections if hasattr(cloud, "_offsets3d")
    }
    places = geometry.source_positions.numpy()
    for name in ("T1", "T2", "T3"):
        own = [view for view in range(4) if geometry.sources[view] == name]
        np.testing.assert_allclose(np.asarray(drawn[f"focal spot {name}"]), places[own])
    assert len(drawn["implant"]) == 5
    assert {"columns, u", "rows, v", "47°"} <= {text.get_text() for text in axes.texts}


def test_detectors_are_outlined_and_many_views_have_no_labels():
    geometry = circular_geometry(range(0, 360, 10), sad=400, sdd=600, det_shape=(20, 30), pixel_spacing=(2.0, 1.0))
    axes = geometry_figure(geometry).axes[0]
    outline = np.stack(axes.lines[0].get_data_3d(), -1)
    np.testing.assert_allclose(outline[:4].mean(0), DetectorFrames.of(geometry).centers[0].numpy(), atol=1e-9)
    assert np.ptp(outline, axis=0)[1:].tolist() == pytest.approx([30.0, 40.0])
    assert not any("°" in text.get_text() for text in axes.texts)
