"""Overlays of the registered implant on the measured projections (fig. 3A of the paper)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray
from torch import Tensor

GREEN = np.array([0.10, 0.95, 0.40])
_OPACITY = 0.6
_PANEL_HEIGHT_IN = 5.0
_NARROWEST_IN, _WIDEST_IN = 1.15, 5.0


def overlay_figure(
    measured: Tensor,
    after: Tensor,
    *,
    before: Tensor | None = None,
    view_labels: Sequence[str] | None = None,
    gc_before: Tensor | None = None,
    gc_after: Tensor | None = None,
    pixel_spacing: tuple[float, float] | None = None,
    margin_px: int = 20,
    crop: bool = True,
    label: str = "after",
) -> Figure:
    """A figure of projections in grey with the implant's DRR in green, one column for each view.

    The row of the start (if `before` is given) is above that of the result. Dense is bright, as on a radiograph. Where
    the DRR covers the implant's shadow, the shadow is green; elsewhere it is white, and green lies on the background.
    A misfit is thus visible on both sides. A thin line follows the DRR's outline.

    Args:
        measured: Line integrals (V, rows, cols).
        after: DRRs of the registered implant, same shape, any unit.
        before: DRRs at the start, same shape.
        view_labels: Title of each column ("91 deg, T1").
        gc_before: Gradient correlations (V,) at the start, written into the panels.
        gc_after: Gradient correlations (V,) at the end.
        pixel_spacing: (dv, du) in mm, for the aspect ratio and a scale bar at the detector.
        margin_px: Margin around the implant, pixels.
        crop: Show only the implant's surroundings, the same size in each view.
        label: Label of the row of `after`.

    Raises:
        ValueError: The shapes differ.
    """
    given = {"measured": measured, "before": before, label: after}
    for name, tensor in given.items():
        if tensor is not None and (tensor.ndim != 3 or tensor.shape != after.shape):
            raise ValueError(
                f"{name} must have shape (V, rows, cols) = {tuple(after.shape)}, got {tuple(tensor.shape)}"
            )
    arrays = {name: tensor.detach().cpu().double().numpy() for name, tensor in given.items() if tensor is not None}
    images = arrays.pop("measured")
    gc = {"before": gc_before, label: gc_after}
    windows = _windows(list(arrays.values()), margin_px) if crop else [(slice(None), slice(None))] * len(images)
    dv, du = pixel_spacing or (1.0, 1.0)

    height, width = images[0][windows[0]].shape
    panel_in = float(np.clip(_PANEL_HEIGHT_IN * width * du / (height * dv), _NARROWEST_IN, _WIDEST_IN))
    panel_height_in = min(_PANEL_HEIGHT_IN, panel_in * height * dv / (width * du))
    figure = Figure(
        figsize=(len(images) * (panel_in + 0.12) + 0.4, len(arrays) * (panel_height_in + 0.1) + 0.4),
        layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, wspace=0.01, hspace=0.01),
        facecolor="white",
    )
    axes = figure.subplots(len(arrays), len(images), squeeze=False)
    for i, (name, drr) in enumerate(arrays.items()):
        axes[i, 0].set_ylabel(name, fontsize=11)
        similarity = gc[name]
        for view, window in enumerate(windows):
            _draw(axes[i, view], images[view][window], drr[view][window], dv / du)
            if similarity is not None:
                _write(axes[i, view], f"GC {float(similarity[view]):.3f}")
    for view in range(len(images)):
        axes[0, view].set_title(f"view {view}" if view_labels is None else view_labels[view], fontsize=10)
    if pixel_spacing is not None:
        _scale_bar(axes[-1, 0], height, width * du, du)
    return figure


def overlay_layers(measured: Tensor, drr: Tensor, *, margin_px: int = 20) -> tuple[NDArray, NDArray]:
    """Image layers for an HTML page: measured views (V, h, w) in grey, and with the DRR in green (V, h, w, 3).

    Both are uint8 and show the implant's surroundings, the same size in each view.

    Args:
        measured: Line integrals (V, rows, cols).
        drr: DRRs of the registered implant, same shape, any unit.
        margin_px: Margin around the implant, pixels.
    """
    images, shadows = (tensor.detach().cpu().double().numpy() for tensor in (measured, drr))
    cut = [
        (_grey(images[view][window]), shadows[view][window])
        for view, window in enumerate(_windows([shadows], margin_px))
    ]
    grey = np.stack([image[..., 0] for image, _ in cut])
    green = np.stack([_composite(image, _thickness(shadow)) for image, shadow in cut])
    return (255 * grey).round().astype(np.uint8), (255 * green).round().clip(0, 255).astype(np.uint8)


def _windows(drrs: list[NDArray], margin_px: int) -> list[tuple[slice, slice]]:
    """Rows and columns around the implant, of the same size in each view."""
    shadow = np.max([drr > 0.02 * max(drr.max(), 1e-12) for drr in drrs], axis=0)
    _, num_rows, num_cols = shadow.shape
    boxes = []
    for view in shadow:
        v, u = np.nonzero(view.any(1))[0].tolist(), np.nonzero(view.any(0))[0].tolist()
        boxes.append((v[0], v[-1] + 1, u[0], u[-1] + 1) if v else (0, num_rows, 0, num_cols))
    height = min(num_rows, max(box[1] - box[0] for box in boxes) + 2 * margin_px)
    width = max(box[3] - box[2] for box in boxes) + 2 * margin_px
    width = min(num_cols, max(width, height // 4))  # room for text if a slim plate is seen edge on
    windows = []
    for top, bottom, left, right in boxes:
        first_row = int(np.clip((top + bottom - height) // 2, 0, num_rows - height))
        first_col = int(np.clip((left + right - width) // 2, 0, num_cols - width))
        windows.append((slice(first_row, first_row + height), slice(first_col, first_col + width)))
    return windows


def _draw(axes: Axes, image: NDArray, drr: NDArray, aspect: float) -> None:
    thickness = _thickness(drr)
    axes.imshow(_composite(_grey(image), thickness), origin="upper", aspect=aspect)
    if drr.max() > 0:
        axes.contour(thickness, levels=[0.15], colors=[GREEN], linewidths=0.6)
    axes.set(xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_visible(False)


def _grey(image: NDArray) -> NDArray:
    """Grey levels (h, w, 1) from 0 to 1."""
    low, high = np.percentile(image, [1.0, 99.5])
    return np.clip((image - low) / max(high - low, 1e-12), 0, 1)[..., None]


def _thickness(drr: NDArray) -> NDArray:
    """Relative thickness of metal, from 0 to 1."""
    most = float(np.percentile(drr[drr > 0], 90)) if (drr > 0).any() else 1.0
    return np.clip(drr / max(most, 1e-12), 0, 1)


def _composite(grey: NDArray, thickness: NDArray) -> NDArray:
    """Colours (h, w, 3) of a view with metal in green."""
    alpha = _OPACITY * np.sqrt(thickness)[..., None]
    return grey * (1 - alpha) + GREEN * (0.25 + 0.75 * grey) * alpha


def _write(axes: Axes, text: str) -> None:
    box = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none", "boxstyle": "round,pad=0.25"}
    axes.text(0.03, 0.985, text, transform=axes.transAxes, color="white", fontsize=8, va="top", ha="left", bbox=box)


def _scale_bar(axes: Axes, height: int, width_mm: float, du: float) -> None:
    length = max((mm for mm in (1, 2, 5, 10, 20, 50, 100) if mm <= 0.5 * width_mm), default=1)
    left, bottom = 0.06 * width_mm / du, 0.975 * height
    axes.plot([left, left + length / du], [bottom, bottom], color="white", linewidth=2.5, solid_capstyle="butt")
    axes.text(left + length / du / 2, bottom - 0.012 * height, f"{length} mm", color="white", fontsize=8, ha="center")
