"""Time and memory of a registration, stage by stage.

    python benchmarks/registration_time.py [--rounds 3] [--threads 2] [--out benchmarks/results]

The simulated tibial plate in three views and in twelve, with and without known screws and spectrum. Each registration
runs in a separate process, from files to result, as `torchkcreg register` does. The fastest of the rounds is reported.
Peak memory is that of the process. Writes registration_time.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from common import processor, write_report

CASES = {
    "3 views, known": {"views": "3", "known": True},
    "3 views": {"views": "3", "known": False},
    "12 views, known": {"views": "12", "known": True},
}


def simulate(folder: Path) -> None:
    """Simulate the tibial plate under 600 N in the paper's views."""
    from torchkcreg.studies.paper.experiment import ViewSets, packaged, simulated, start_of

    content = packaged("tibial_plate")
    content["configurations"] = {"cfg3": content["configurations"]["cfg3"]}
    simulated(content, folder, scanner={"views": ViewSets.of_paper(quick=False).imaged})
    start_of(folder)


def register(folder: Path, out: Path, views: str, known: bool, threads: int) -> None:
    """Run one registration in this process and print its times and peak memory as JSON."""
    started = time.perf_counter()
    from torchkcreg.commands.register import register_files
    from torchkcreg.commands.register_inputs import RegistrationFiles
    from torchkcreg.studies.paper.experiment import ViewSets

    imported = time.perf_counter() - started
    torch.set_num_threads(threads)
    files = RegistrationFiles(
        implant=folder / "implant.stl",
        geometry=folder / "geometry.json",
        projections=folder / "cfg3.npz",
        spectrum=folder / "spectrum.csv" if known else None,
        components=folder / "screws.json" if known else None,
        init=folder / "start.json",
        views=ViewSets.of_paper(quick=False).places(int(views)),
    )
    result = register_files(files, out, overrides={"material": "steel"})
    costs = {
        "import": imported,
        "whole": time.perf_counter() - started,
        "stages": list({record["stage"]: record["seconds"] for record in result.history}.values()),
        "gib": peak_gib(),
    }
    print(json.dumps(costs))


def peak_gib() -> float:
    """Peak memory of this process in GiB. `getrusage` would include the process that it was forked from."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 2**20


def table(rows: dict[str, list[dict]], threads: int) -> str:
    best = {name: min(runs, key=lambda run: run["whole"]) for name, runs in rows.items()}
    lines = [
        "# Registration",
        "",
        f"The tibial plate under 600 N, from files to result and figures; best of {len(next(iter(rows.values())))}. "
        f"{processor()}, {threads} threads; torch {torch.__version__}.",
        "",
        "| registration | seconds | of that imports | stages | peak memory, GiB |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, run in best.items():
        stages = ", ".join(f"{seconds:.1f}" for seconds in run["stages"])
        lines.append(f"| {name} | {run['whole']:.1f} | {run['import']:.1f} | {stages} | {run['gib']:.2f} |")
    return "\n".join([*lines, ""])


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--one", nargs=4, help=argparse.SUPPRESS)  # folder, run, views, known: in this process
    options = parser.parse_args(arguments)
    if options.one:
        folder, out, views, known = options.one
        return register(Path(folder), Path(out), views, known == "True", options.threads)
    rows: dict[str, list[dict]] = {name: [] for name in CASES}
    with tempfile.TemporaryDirectory() as scratch:
        simulate(Path(scratch) / "case")
        for number in range(options.rounds):
            for name, case in CASES.items():
                run = [str(Path(scratch) / f"{name}-{number}"), case["views"], str(case["known"])]
                command = [sys.executable, __file__, "--threads", str(options.threads), "--one", f"{scratch}/case"]
                done = subprocess.run([*command, *run], capture_output=True, text=True, check=True)
                rows[name].append(json.loads(done.stdout.splitlines()[-1]))
                print(f"{name}: {rows[name][-1]['whole']:.1f} s", flush=True)
    text = table(rows, options.threads)
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    write_report(options.out / "registration_time.md", text)


if __name__ == "__main__":
    main()
