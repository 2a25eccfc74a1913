"""STEP files as surfaces, by OpenCASCADE (cascadio) in a process of its own: it does not survive some damaged files."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import trimesh

STEP_SUFFIXES = (".step", ".stp")
DEFLECTION_MM, DEFLECTION_RAD = 0.005, 0.05  # of the surface's triangles from the true one
SECONDS = 300  # given to a file
_CONVERT = "import sys, cascadio; _, a, b, mm, rad = sys.argv; cascadio.step_to_glb(a, b, float(mm), float(rad))"


def load_step(path: Path) -> trimesh.Trimesh:
    """The surface of all bodies of a STEP file, in mm whatever unit it says, within 5 micrometres.

    Raises:
        ValueError: damaged, without a body, or cascadio is not installed.
    """
    if importlib.util.find_spec("cascadio") is None:
        raise ValueError("STEP files need cascadio: pip install 'torchkcreg[cad]'")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "surface.glb"
        command = [sys.executable, "-c", _CONVERT, str(path), str(target), str(DEFLECTION_MM), str(DEFLECTION_RAD)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=SECONDS, check=False)
        except subprocess.TimeoutExpired:
            raise ValueError(f"it takes longer than {SECONDS} s to be made a surface") from None
        if done.returncode != 0 or not target.is_file() or target.stat().st_size == 0:
            raise ValueError("it is no STEP file with a body")
        try:
            scene = trimesh.load(str(target), force="mesh", process=False)
        except Exception as error:  # of a scene without a surface
            raise ValueError("it holds no surface") from error
    if not isinstance(scene, trimesh.Trimesh) or len(scene.faces) == 0:
        raise ValueError("it holds no surface")
    scene.apply_scale(1000.0)  # GLB is in metres
    return scene
