"""Surface of an implant from a bench scan (CT volume), as in Cao et al. 2020 (section 2.4)."""

from __future__ import annotations

import warnings

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from torchkcreg.geometry import VolumeGrid

_SAMPLE = 2_000_000  # values, enough for a histogram
_BINS = 512
_DIM = 6.0  # least contrast of metal to surroundings, in standard deviations of the noise
_SMALL = 0.01  # of the implant's volume: smaller bodies are noise
_SMOOTHINGS = 10


def scanned_surface(volume: Tensor, grid: VolumeGrid) -> trimesh.Trimesh:
    """Closed surface of the implant in a volume at half the metal's value, in world coordinates, mm.

    The metal's value is taken from its outer layers, so that beam hardening (a centre that is too dark) does not change
    the size. Cavities and small bodies are treated as artefacts and left out. Of several large bodies the largest is
    used, with a warning. The surface is smoothed without shrinking (Taubin 1995), by less than a tenth of a voxel.

    Args:
        volume: (D, H, W), attenuation or any unit that is linear in it.
        grid: Voxel grid of the volume.

    Raises:
        ValueError: If no metal stands out in the volume, or scikit-image is not installed.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        raise ValueError("an implant's volume needs scikit-image: pip install 'torchkcreg[io]'") from None
    values = volume.detach().cpu().double().numpy()
    if not np.isfinite(values).all():
        raise ValueError("a volume must hold finite numbers")
    air, metal = _levels(values)
    level = (air + metal) / 2
    padded = np.pad(values, 1, constant_values=air)
    if any((values.take(side, axis) > level).any() for axis in range(3) for side in (0, -1)):
        warnings.warn("the implant reaches the edge of its volume: it is cut off there", stacklevel=3)
    corners, faces, *_ = marching_cubes(padded, level)
    moved = (corners[:, ::-1] - 1.0) @ grid.voxel_to_world[:3, :3].numpy().T + grid.voxel_to_world[:3, 3].numpy()
    whole = trimesh.Trimesh(moved, faces)
    if whole.volume < 0:
        whole.invert()
    return trimesh.smoothing.filter_taubin(_body(whole), iterations=_SMOOTHINGS)


def _levels(values: NDArray[np.float64]) -> tuple[float, float]:
    """Values of the surroundings of the implant, and of its metal."""
    step = max(1, values.size // _SAMPLE)
    counts, edges = np.histogram(values.ravel()[::step], _BINS)
    middles = (edges[1:] + edges[:-1]) / 2
    below = np.cumsum(counts)
    above, sums = below[-1] - below, np.cumsum(counts * middles)
    with np.errstate(divide="ignore", invalid="ignore"):  # Otsu 1979
        between = np.nan_to_num(below * above * (sums / below - (sums[-1] - sums) / above) ** 2)
    bright = values > middles[int(between.argmax())]
    around = values[~bright]
    if not bright.any() or not around.size:
        raise ValueError("nothing in the volume stands out as metal")
    air = float(np.median(around))
    inner = ndimage.binary_erosion(bright)
    layer = inner & ~ndimage.binary_erosion(inner)
    metal = float(np.median(values[layer if layer.any() else bright]))
    noise = 1.4826 * float(np.median(np.abs(around - air)))
    if metal - air < _DIM * noise:
        raise ValueError(f"nothing in the volume stands out as metal: {metal:.3g} against {air:.3g} +- {noise:.2g}")
    return air, metal


def _body(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    bodies = sorted(surface.split(only_watertight=True), key=lambda body: -body.volume)
    if not bodies or bodies[0].volume <= 0:
        raise ValueError("the metal in the volume has no closed surface")
    large = [body for body in bodies if body.volume > _SMALL * bodies[0].volume]
    if len(large) > 1:
        warnings.warn(f"the volume holds {len(large)} bodies: the largest is taken for the implant", stacklevel=4)
    return bodies[0]
