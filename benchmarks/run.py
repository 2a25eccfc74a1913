"""Run all benchmarks that compare with other libraries, on one machine, and write tables and plots to a folder.

    python benchmarks/run.py [--quick] [--out benchmarks/results]

Compares the point-cloud projector with nanodrr and DiffDRR, and the voxel projector with itk-rtk and mbirtorch, and
measures the time of a registration, stage by stage. Install the other libraries with
`pip install nanodrr diffdrr itk-rtk mbirtorch`; those not installed are left out with a message. `--quick`: one round,
small images.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import point_projector
import registration_time
import voxel_projector


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    out, rounds = ["--out", str(options.out)], ["--rounds", "1"] if options.quick else []
    point_projector.main([*out, *rounds, *(["--binning", "8"] if options.quick else [])])
    voxel_projector.main([*out, *rounds])
    registration_time.main([*out, *rounds])


if __name__ == "__main__":
    main()
