"""Public measured scans: FDK against a vendor's slice, a limited-angle disc, a geometry calibrated from beads.

    python benchmarks/real_scans.py DATA [--out benchmarks/results]

DATA holds the data sets as published: `axitom/` (radiogram and the vendor's slice, github.com/PolymerGuy/AXITOM),
`htc2022/` (Helsinki tomography challenge 2022, github.com/TomographicImaging/CIL-HTC2022-Algo2) and `pellegrin_cbct/`
(180 views of a printed cylinder with two beads, github.com/thmspllgr/CBCT-Reconstruction). Writes real_scans.md and
one figure per data set.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from common import processor
from matplotlib import pyplot as plt
from scipy.io import loadmat

from torchkcreg.evaluation import track_beads
from torchkcreg.geometry import VolumeGrid, calibrate, circular_geometry
from torchkcreg.reconstruction import PWLSConfig, VoxelSystem, fdk, pwls, statistical_weights

Picture = dict[str, np.ndarray]


def axitom(data: Path) -> tuple[str, Picture]:
    """FDK from one radiogram of an axially symmetric specimen; the vendor's slice used 3142 views."""
    image = np.load(data / "radiogram_bin4_f32.npz")["radiogram"]
    lines = -np.log(np.clip(image, 1e-3, None))
    profile = lines[20:180].mean(0)
    covered = np.flatnonzero(profile > 0.3 * profile.max())  # the axis is midway between the specimen's edges
    offset_mm = ((image.shape[1] - 1) / 2 - (covered[0] + covered[-1]) / 2) * 0.8
    geometry = circular_geometry(
        range(0, 360, 2),
        sad=76.7511959,
        sdd=1127.464,
        det_shape=image.shape,
        pixel_spacing=(0.8, 0.8),
        det_offset_mm=(0, offset_mm),
    )
    views = torch.from_numpy(lines).float().expand(geometry.num_views, *image.shape).contiguous()
    pitch = 4 * 0.013614837863123
    grid = VolumeGrid((499, 1, 100), pitch, (pitch / 2, 0.0, -249 * pitch))
    slice_image = fdk(views, geometry, grid)[:, 0].flip(0).numpy()
    vendor = sitk.GetArrayFromImage(sitk.ReadImage(str(data / "recon_by_external_software.tif")))
    vendor_slice = vendor[:1996].astype(float).reshape(499, 4, 100, 4).mean((1, 3))
    inner = (slice(30, 470), slice(3, 95))  # without the cone's truncated ends and the rings on the axis
    correlation = np.corrcoef(slice_image[inner].ravel(), vendor_slice[inner].ravel())[0, 1]
    slope, base = np.polyfit(vendor_slice[inner].ravel(), slice_image[inner].ravel(), 1)
    scaled = slope * vendor_slice + base
    relative_error = np.sqrt(np.mean((slice_image - scaled)[inner] ** 2)) / np.ptp(
        np.percentile(slice_image[inner], [2, 98])
    )
    text = (
        f"FDK of one radiogram, repeated for 180 views, against the vendor's slice from 3142 views: correlation "
        f"{correlation:.3f}, root mean square difference {100 * relative_error:.1f} % of the range of grey "
        "values (the vendor's fitted to ours by a factor and an offset)."
    )
    return text, {"torchkcreg, one view": slice_image[inner].T, "vendor, 3142 views": scaled[inner].T}


def htc2022(data: Path) -> tuple[str, Picture]:
    """PWLS of an acrylic disc with holes, from a limited range of angles."""
    content = loadmat(data / "htc2022_ta_sparse_example.mat", struct_as_record=False, squeeze_me=True)["CtDataLimited"]
    lines = torch.from_numpy(content.sinogram).float()[:, None]
    angles = np.atleast_1d(content.parameters.angles)
    geometry = circular_geometry(angles, sad=410.66, sdd=553.74, det_shape=(1, 560), pixel_spacing=(0.2, 0.2))
    grid = VolumeGrid.centered((1, 240, 240), 0.353)
    system = VoxelSystem(geometry, grid)
    config = PWLSConfig(iterations=40, subsets=10, beta=1.0)
    volume = pwls(system, lines, statistical_weights(torch.exp(-lines)), config).volume
    residual = (system.project(volume, range(geometry.num_views)) - lines).abs().mean() / lines.max()
    text = (
        f"{len(angles)} views over {np.ptp(angles):.0f} degrees of an acrylic disc: PWLS explains the line integrals "
        f"to {100 * residual:.1f} % of their maximum. Structures seen only in the missing views are "
        "not recovered."
    )
    return text, {"line integrals, one row per view": lines[:, 0].numpy(), "PWLS": volume[0].numpy()}


def pellegrin(data: Path) -> tuple[str, Picture]:
    """A home-made scanner, measured with a ruler; its axis is horizontal, along the detector rows."""
    counts = torch.from_numpy(np.load(data / "proj180_bin2_u16.npz")["proj"].astype(np.float32))
    lines = -(counts / counts[:, :, 2:10].median()).clamp_min(1e-3).log().transpose(1, 2).contiguous()
    pixel, rows, calibrations = 2 * 127 / 343, lines.shape[1], {}
    tracks = track_beads(lines, diameter_px=4.6)
    for sense in (1, -1):
        nominal = circular_geometry(
            [sense * 2.0 * i for i in range(len(lines))],
            sad=308.7,
            sdd=308.7 + 149,
            det_shape=(rows, lines.shape[2]),
            pixel_spacing=(pixel, pixel),
        )
        calibrations[sense] = nominal, calibrate(nominal, tracks)
    sense = min(calibrations, key=lambda s: calibrations[s][1].median_px)
    nominal, calibration = calibrations[sense]
    grid = VolumeGrid.centered((150, 160, 160), 0.5)
    shown = {
        "as measured by hand": fdk(lines, nominal, grid),
        "calibrated from two beads": fdk(lines, calibration.geometry, grid),
    }
    contrasts = [
        " and ".join(f"{_peak(volume, grid, bead):.3f}" for bead in calibration.beads) for volume in shown.values()
    ]
    moved = calibration.detector
    text = (
        f"Two beads, tracked through {len(lines)} views: {calibration.before_px:.2f} pixels (median) off in the given "
        f"geometry, {calibration.median_px:.2f} after calibration ({calibrations[-sense][1].median_px:.2f} with "
        f"angles in the other sense). The detector is shifted by {moved['shift_u_mm']:.2f} mm "
        f"(+/- {calibration.deviations['shift_u_mm']:.2f}) and rotated by {moved['turn_normal_deg']:.2f} degrees "
        f"(+/- {calibration.deviations['turn_normal_deg']:.2f}) in its plane. The beads' attenuation rises from "
        f"{contrasts[0]} to {contrasts[1]} per mm. The remaining error comes from the beads: they lie loosely in "
        "their holders and roll by two pixels as the cylinder turns about its horizontal axis."
    )
    height = int(((calibration.beads[0, 2] - grid.origin[2]) / 0.5).round())
    return text, {name: volume[height].numpy() for name, volume in shown.items()}


def _peak(volume: torch.Tensor, grid: VolumeGrid, place: torch.Tensor) -> float:
    """Mean of the 27 brightest voxels within 3 mm of a place."""
    near = volume[(grid.points() - place.float()).norm(dim=-1) < 3.0]
    return float(near.topk(27).values.mean())


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    lines = ["# Public measured scans", "", f"`python benchmarks/real_scans.py DATA`; {processor()}.", ""]
    cases = {"axitom": axitom, "htc2022": htc2022, "pellegrin_cbct": pellegrin}
    for name, case in cases.items():
        text, images = case(options.data / name)
        lines += [f"## {name}", "", text, "", f"![{name}](real_{name}.png)", ""]
        print(f"{name}: {text}", flush=True)
        rows, columns = next(iter(images.values())).shape
        down = columns > 2 * rows
        shape = (len(images), 1) if down else (1, len(images))
        figure, axes = plt.subplots(*shape, figsize=(9, 4.5 if down else 5), layout="constrained")
        alike = len({image.shape for image in images.values()}) == 1
        for panel, (title, image) in zip(axes, images.items(), strict=True):
            low, high = np.percentile(np.stack(list(images.values())) if alike else image, [0.5, 99.7])
            panel.imshow(image, cmap="gray", vmin=low, vmax=high, aspect="equal" if alike else "auto")
            panel.set_title(title)
            panel.set_axis_off()
        figure.savefig(options.out / f"real_{name}.png", dpi=90)
        plt.close(figure)
    (options.out / "real_scans.md").write_text("\n".join(lines))


if __name__ == "__main__":
    main()
