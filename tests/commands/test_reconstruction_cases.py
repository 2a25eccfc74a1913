"""Whole scans of independent cases; they lie beside the repository, where they are at all."""

import json
from pathlib import Path

import pytest
import torch

from torchkcreg.cli import main
from torchkcreg.commands import registered_components
from torchkcreg.evaluation import cylinder_region, distance_to, find_beads, region_statistics
from torchkcreg.geometry import VolumeGrid
from torchkcreg.io import read_geometry, read_projections, read_volume
from torchkcreg.reconstruction import fdk, fit_veil, floored_line_integrals, unknown_share, veil_image

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason="no ../shared/cases")
VIEWS = "15,30,45,59,74,89,103,120,133,151,164,181"
FROM_SCREWS_MM, FROM_METAL_MM, NEAR_MM, HALF_LENGTH_MM = 3.0, 1.6, 10.0, 60.0
INSIDE_MM = {"water": 4.0, "ca50": 2.0, "ca100": 2.0, "ca200": 2.0}


@pytest.mark.slow
@needs_cases
@pytest.mark.parametrize("name", ["cfg0", "cfg4"])
def test_the_eight_beads_of_a_scan_are_found_to_a_twentieth_of_a_millimetre(name):
    geometry = read_geometry(CASES / "lcp_scan" / "geometry.json")
    transmission = torch.exp(-read_projections(CASES / "lcp_scan" / f"{name}.npz").line_integrals)
    unsaturated = transmission < 0.9999 * transmission.max()
    veil = fit_veil(transmission, geometry.pixel_spacing, mask=unsaturated)
    primary = transmission - veil_image(transmission, veil, geometry.pixel_spacing)
    grid = VolumeGrid.centered((420, 160, 160), 0.5)
    found = find_beads(fdk(floored_line_integrals(primary), geometry, grid), grid)
    truth = json.loads((CASES / "lcp_scan" / "truth.json").read_text())
    beads = next(torch.tensor(c["bb_mm"]) for c in truth["cfg"] if c["name"] == name).double()
    assert len(found.centers) == 8
    assert torch.cdist(beads, found.centers).min(1).values.max() < 0.05


def regions(grid, components):
    """Rods and water without metal, and what of it is near; fixed before any volume was looked at."""
    content = json.loads((CASES / "femoral_scan" / "background.json").read_text())["cylinders"]
    metal = distance_to(1 - unknown_share(components, grid), grid)
    screws = distance_to(1 - unknown_share(components[1:], grid), grid)
    kept = (screws > FROM_SCREWS_MM) & (metal > FROM_METAL_MM)

    def rod(part, margin):
        (x, y, _), radius = part["a"], part["r"]
        return cylinder_region(grid, (x, y, -HALF_LENGTH_MM), (x, y, HALF_LENGTH_MM), radius + margin)

    found = {part["material"]: rod(part, -INSIDE_MM[part["material"]]) & kept for part in content}
    for part in content[1:]:
        found["water"] &= ~rod(part, 2.0)
    return found, metal < NEAR_MM


@pytest.mark.slow
@needs_cases
def test_knowing_the_implant_cleans_the_water_bath(tmp_path):
    """Register from the scan's own views, then reconstruct everything alike; the truth is the scan without metal."""
    case = CASES / "femoral_scan"
    scan = ["--geometry", case / "geometry.json", "--projections", case / "deformed.npz"]
    known = ["--spectrum", case / "spectrum.csv", "--components", case / "screws.json"]
    files = ["--implant", case / "implant.stl", "--material", "titanium", *scan, *known, "--views", VIEWS]
    assert main(["register", *map(str, files), "--out", str(tmp_path / "run"), "--no-figures"]) == 0
    volumes = {}
    size = ["--size", "110.4", "110.4", "224", "--spacing", "1.6", "--iterations", "12", "--no-figures"]
    spectrum = ["--spectrum", str(case / "spectrum.csv")]
    for name in ("truth", "fdk", "pwls", "kcrec"):
        source = CASES / "femoral_scan_no_metal" if name == "truth" else case
        files = ["--geometry", source / "geometry.json", "--projections", source / "deformed.npz"]
        method = ["--method", "pwls" if name == "truth" else name, "--run", str(tmp_path / "run")]
        out = str(tmp_path / name)
        assert main(["reconstruct", *method, *map(str, files), *spectrum, *size, "--out", out]) == 0
        volumes[name], grid = read_volume(tmp_path / name / "volume.mha")
    found, near = regions(grid, registered_components(tmp_path / "run"))

    def measured(name, region):
        return region_statistics(volumes[name], region, reference=volumes["truth"])

    for material, region in found.items():
        assert abs(measured("kcrec", region).mean_error) < abs(measured("fdk", region).mean_error) / 3
        assert abs(measured("kcrec", region).mean_error) < 0.01 * measured("truth", region).mean
        if material in ("water", "ca50"):  # in the other two the errors of plain PWLS cancel
            assert abs(measured("kcrec", region).mean_error) < 0.5 * abs(measured("pwls", region).mean_error)
    for material in ("water", "ca100"):  # those that come near the metal
        close = found[material] & near
        assert measured("kcrec", close).std < (0.5 if material == "water" else 0.7) * measured("pwls", close).std
        assert measured("kcrec", close).std < measured("fdk", close).std / 3
