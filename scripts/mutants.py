"""Mutation score of the numerical core: how many small faults in it the tests notice (cosmic-ray).

    pip install cosmic-ray
    python scripts/mutants.py --work /tmp/mutants --sample 60              # seven parts, about 80 minutes
    python scripts/mutants.py --work /tmp/mutants --report                 # score, and each surviving mutant

Mutants are drawn at random with a fixed seed, the same number from each part, and put into a clone of the last
commit, never into these files. A run that was stopped goes on. The score has a 95 % Wilson interval.
"""

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
from math import sqrt
from pathlib import Path

PARTS = {
    "similarity": ("torchkcreg/similarity", "tests/similarity"),
    "splines": ("torchkcreg/splines", "tests/splines tests/deformation/test_ffd.py tests/test_derivatives.py"),
    "deformation": ("torchkcreg/deformation", "tests/deformation"),
    "projector": ("torchkcreg/projector", "tests/projector tests/test_derivatives.py"),
    "fdk": (
        "torchkcreg/reconstruction/fdk.py",
        "tests/reconstruction/test_fdk.py tests/reconstruction/test_redundancy.py "
        "tests/reconstruction/test_filtering.py",
    ),
    "pwls": (
        "torchkcreg/reconstruction/pwls.py",
        "tests/reconstruction/test_pwls.py tests/reconstruction/test_subsets.py "
        "tests/reconstruction/test_two_levels.py",
    ),
    "verdict": ("torchkcreg/registration/verdict.py", "tests/registration/test_verdict.py"),
}
# Annotations such as "int | None" and decorators such as "@property" are no arithmetic.
NO_ARITHMETIC = ["core/ReplaceBinaryOperator_BitOr_.*", "core/RemoveDecorator"]


def main() -> None:
    """Run or report the mutants of the chosen parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of the clone and of the results")
    parser.add_argument("--sample", type=int, default=60, help="mutants of each part (default 60)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw: tests that a draw led to need another one")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--report", action="store_true", help="run nothing, report the results that are there")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    if not options.report:
        clone = options.work / "clone"
        if not clone.exists():
            subprocess.run(["git", "clone", "--quiet", ".", str(clone)], check=True)
            for kernels in Path("torchkcreg").glob("_C*"):  # built by pip install --editable
                shutil.copy(kernels, clone / kernels)
        for part in options.parts:
            run(part, options.work, options.sample, options.seed)
    report(options.parts, options.work)


def run(part: str, work: Path, sample: int, seed: int) -> None:
    """Draw ``sample`` mutants of a part, unless they were drawn before, and test those that are left."""
    from cosmic_ray.work_db import WorkDB, use_db
    from cosmic_ray.work_item import WorkerOutcome, WorkResult

    module, tests = PARTS[part]
    config, session = (work / f"{part}.toml").resolve(), (work / f"{part}.sqlite").resolve()
    config.write_text(
        f'[cosmic-ray]\nmodule-path = "{module}"\ntimeout = 150.0\nexcluded-modules = []\n'
        f'test-command = "{sys.executable} -m pytest -q -x -p no:cacheprovider {tests}"\n'
        f'[cosmic-ray.distributor]\nname = "local"\n'
        f"[cosmic-ray.filters.operators-filter]\nexclude-operators = {json.dumps(NO_ARITHMETIC)}\n"
    )
    tools = Path(sys.executable).parent
    clone = work / "clone"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(clone.resolve()), "MPLBACKEND": "Agg"}

    def tool(*command: str) -> None:
        subprocess.run([str(tools / command[0]), *command[1:]], cwd=clone, env=environment, check=True)

    subprocess.run(["git", "checkout", "--quiet", "."], cwd=clone, check=True)
    if not session.exists():
        tool("cosmic-ray", "init", str(config), str(session))
        tool("cr-filter-operators", str(session), str(config))
        with use_db(str(session), WorkDB.Mode.open) as database:
            waiting = sorted(item.job_id for item in database.pending_work_items)
            order = {item.job_id: repr(item.mutations[0]) for item in database.work_items}
            waiting.sort(key=order.__getitem__)  # not by job_id, which is random
            chosen = set(random.Random(seed).sample(waiting, min(sample, len(waiting))))
            left_out = [job for job in waiting if job not in chosen]
            database.set_multiple_results(left_out, WorkResult(WorkerOutcome.SKIPPED))
    tool("cosmic-ray", "baseline", str(config))  # the tests must pass without a mutant
    tool("cosmic-ray", "exec", str(config), str(session))


def report(parts: list[str], work: Path) -> None:
    """Print the survivors and the score of each part."""
    from cosmic_ray.work_db import WorkDB, use_db
    from cosmic_ray.work_item import TestOutcome

    totals = [0, 0]
    for part in parts:
        if not (work / f"{part}.sqlite").exists():
            continue
        with use_db(str(work / f"{part}.sqlite"), WorkDB.Mode.open) as database:
            items = {item.job_id: item.mutations[0] for item in database.work_items}
            tested = [(job, result) for job, result in database.results if result.test_outcome is not None]
        survivors = [(items[job], result) for job, result in tested if result.test_outcome == TestOutcome.SURVIVED]
        for mutation, result in survivors:
            print(f"\n{mutation.module_path}:{mutation.start_pos[0]} {mutation.operator_name}")
            print(
                "\n".join(
                    line for line in (result.diff or "").splitlines() if line[:1] in "+-" and line[1:2] not in "+-"
                )
            )
        killed = len(tested) - len(survivors)
        totals = [totals[0] + killed, totals[1] + len(tested)]
        print(f"\n{part}: {score(killed, len(tested))}")
    print(f"all: {score(*totals)}")


def score(killed: int, total: int) -> str:
    """Share of killed mutants with its 95 % Wilson interval."""
    if total == 0:
        return "no mutant tested"
    share, z = killed / total, 1.96
    centre = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z * sqrt(share * (1 - share) / total + z**2 / (4 * total**2)) / (1 + z**2 / total)
    return f"{killed} of {total} mutants noticed, {share:.0%} ({centre - half:.0%} to {centre + half:.0%})"


if __name__ == "__main__":
    main()
