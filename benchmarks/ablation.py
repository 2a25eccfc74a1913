"""Ablation study: BB and node errors on simulated plates, leaving out one part of the registration at a time.

    python benchmarks/ablation.py            # all cases, about 15 minutes on two cores
    python benchmarks/ablation.py --quick    # one case

`torchkcreg.simulation` makes the cases: a plate under axial load, seen obliquely and face on, and a plate on four
screws bent at every hole. The table is written to `benchmarks/results/ablation.md`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from common import write_report
from tqdm import tqdm

from torchkcreg.evaluation import bb_rmse
from torchkcreg.implant import find_holes
from torchkcreg.registration import RegistrationConfig, Stage, preset_stages, register
from torchkcreg.simulation import SimulatedCase, weight_bearing_case
from torchkcreg.simulation.bench import LoadRecipe
from torchkcreg.studies.capture import registration_inputs

CASES = {
    "axial load, 48 degrees": {"load": 1.0, "seed": 0, "views": (47, 48, 49)},
    "axial load, face on": {"load": 1.0, "seed": 1, "views": (91, 92, 93)},
    "S-bend, 48 degrees": {
        "load": LoadRecipe.of(
            {"s_bend": "6 deg", "torsion": "2 deg", "zone": "63 mm", "translation": "[0.6, -0.8, 0.5] mm"}
        ),
        "seed": 3,
        "views": (47, 48, 49),
        "mode": "s_bend",
    },
}


@dataclass(frozen=True)
class Variant:
    """A registration with one part left out."""

    name: str
    config: RegistrationConfig
    knows_screws: bool = True
    knows_spectrum: bool = True
    finds_screws: bool = True


def variants() -> Iterator[Variant]:
    """All variants, the full registration first."""
    default = RegistrationConfig(material="steel")
    stages = preset_stages("gauss-newton")

    def without(*names: str) -> RegistrationConfig:
        stage_updates = [
            {field: tuple(x for x in getattr(s, field) if x not in names) for field in ("before", "estimate")}
            for s in stages
        ]
        changed = tuple(s.model_copy(update=update) for s, update in zip(stages, stage_updates, strict=True))
        return default.model_copy(update={"stages": changed})

    groups = (
        *(s for s in stages if s.modes is None),
        Stage(groups=5, pitch_factor=2, estimate=stages[-1].estimate, before=stages[-1].before),
        Stage(groups=10, pitch_factor=2, estimate=stages[-1].estimate, before=stages[-1].before),
    )
    yield Variant("everything; screws and spectrum given", default)
    yield Variant("everything; screws found, spectrum assumed", default, knows_screws=False, knows_spectrum=False)
    yield Variant("no weights of pixels", without("reweight"))
    yield Variant("no background", without("background"))
    yield Variant("no estimate of scatter and blur", without("scatter", "removed", "blur", "hardness"))
    yield Variant("5 and 10 groups in place of modes", default.model_copy(update={"stages": groups}))
    yield Variant("no charge for loads", default.model_copy(update={"load_weight": 0.0}))
    yield Variant("screws neither given nor looked for", default, knows_screws=False, finds_screws=False)
    yield Variant("line integrals in place of materials", default.model_copy(update={"material": None}))


def errors(case: SimulatedCase, variant: Variant) -> tuple[float, float]:
    """BB RMSE and node RMSE in mm."""
    config = variant.config
    data, cloud, screws = registration_inputs(case, config.pitch_mm)
    if config.material is None:
        screws = [replace(screw, material="implant") for screw in screws]
    result = register(
        cloud,
        data,
        config,
        spectrum=case.spectrum if variant.knows_spectrum and config.material else None,
        components=screws if variant.knows_screws else (),
        holes=find_holes(case.implant) if variant.finds_screws else (),
    )
    nodes = cloud.coarsened(8).points.double()
    bb = bb_rmse(result.warp(case.beads_before.double()), case.beads_after.double())
    node = bb_rmse(result.warp(nodes), case.deform(nodes))
    return float(bb), float(node)


def main() -> None:
    """Run all variants and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="run only the first case")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "ablation.md")
    options = parser.parse_args()
    names = list(CASES)[:1] if options.quick else list(CASES)
    cases = {name: weight_bearing_case(**CASES[name]) for name in names}
    heads = [f"{name}: BB / nodes (mm)" for name in names]
    lines = [f"| registration | {' | '.join(heads)} |", "| --- |" + " --- |" * len(names)]
    for variant in tqdm(list(variants()), desc="variants"):
        case_errors = [errors(case, variant) for case in cases.values()]
        cells = " | ".join(f"{bb:.3f} / {node:.3f}" for bb, node in case_errors)
        lines.append(f"| {variant.name} | {cells} |")
        tqdm.write(lines[-1])
    setup = f"Three views each; {torch.get_num_threads()} threads, torch {torch.__version__}."
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_report(options.out, "\n".join([*lines, "", f"{setup} Made by `python benchmarks/ablation.py`.", ""]))


if __name__ == "__main__":
    main()
