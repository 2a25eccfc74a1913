"""The demo's case: errors of `torchkcreg demo`, and of the method in one file on the same files.

    python benchmarks/demo.py [--out benchmarks/results]

Writes demo.csv: RMS error of the eight beads, in mm, and seconds from files to result.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ONE_FILE = Path(__file__).resolve().parents[1] / "examples" / "kcreg_in_one_file.py"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "demo"
        subprocess.run([sys.executable, "-m", "torchkcreg", "demo", "--out", folder, "--quiet"], check=True)
        evaluation = json.loads((folder / "evaluation.json").read_text())
        metrics = json.loads((folder / "run" / "metrics.json").read_text())
        start = time.perf_counter()
        command = [sys.executable, ONE_FILE, folder / "case", "--screws"]
        lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        seconds = time.perf_counter() - start
    one_file = float(re.findall(r"registered: ([\d.]+) mm", lines)[0])
    rows = [
        ("start", evaluation["beads at the start"]["rmse_mm"], None),
        ("one file with Adam", one_file, seconds),
        ("torchkcreg demo", evaluation["beads"]["rmse_mm"], metrics["seconds"]),
    ]
    with (options.out / "demo.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["registration", "bead error (mm)", "seconds"])
        writer.writerows([name, f"{error:.2f}", "" if took is None else f"{took:.0f}"] for name, error, took in rows)


if __name__ == "__main__":
    main()
