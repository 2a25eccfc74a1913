#!/usr/bin/env bash
# Builds an sdist and, from it, a wheel; then runs the installed wheel's self-test under other releases of torch.
#
#     scripts/try_wheel.sh OUT torch==2.10.0 torch==2.14.1
#
# OUT is the folder for sdist and wheel. The build uses PYTHON (default: python on the path), which needs torch, setuptools,
# wheel and ninja. Each torch takes several GB, unless pip finds builds without CUDA.
set -euo pipefail
out="$(realpath -m "$1")"
shift
python="${PYTHON:-python}"
root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
scratch="$(mktemp -d)"
trap 'rm -rf "$scratch"' EXIT
mkdir -p "$out"

git -C "$root" archive HEAD | tar -x -C "$scratch"
(cd "$scratch" && "$python" setup.py --quiet sdist --dist-dir "$out")
"$python" -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$out" "$out"/torchkcreg-*.tar.gz
wheel="$(ls -t "$out"/torchkcreg-*.whl | head -1)"
for torch in "$@"; do
    venv="$scratch/$torch"
    "$python" -m venv "$venv"
    "$venv/bin/pip" --disable-pip-version-check install --quiet "$torch" numpy
    echo "$torch" > "$scratch/constraint"
    "$venv/bin/pip" --disable-pip-version-check install --quiet -c "$scratch/constraint" "$wheel"
    (cd "$scratch" && mkdir -p elsewhere && cd elsewhere && "$venv/bin/torchkcreg" doctor)
done
