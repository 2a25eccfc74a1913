"""Study of the tibial plate under several loads, numbers of quanta and sets of views."""

from __future__ import annotations

import time
from functools import cache

import numpy as np

from torchkcreg.evaluation import bb_rmse
from torchkcreg.geometry import MultisourceScanner
from torchkcreg.implant import ImplantPointCloud
from torchkcreg.physics import line_integrals_from_intensity, tungsten_spectrum
from torchkcreg.registration import RegistrationConfig, RegistrationData, register
from torchkcreg.simulation.bench import ElasticConstruct, Recipe, acquisitions, specimen, views_of

from .paper import packaged
from .sweeps import Job, Row

LOADS_N = (0.0, 200.0, 400.0, 600.0, 800.0, 1000.0)
VIEWS = ("3", "12")
PHOTONS = (5e3, 2e4)  # quanta per pixel of the open beam
_SHIFT_MM, _TURN_DEG = 0.8, 0.5  # standard deviations of the limb's position
_NODES_COARSER = 4


def load_jobs(seeds: range, *, known: bool, options: dict[str, object]) -> list[Job]:
    """Jobs for all combinations of seed, load, set of views and number of quanta."""
    return [
        {"seed": seed, "load_n": load, "views": views, "photons": photons, "known": known, "options": options}
        for seed in seeds
        for load in LOADS_N
        for views in VIEWS
        for photons in PHOTONS
    ]


def registered_load(job: Job) -> Row:
    """Simulate and register the tibial plate for one job, and return its row of errors in mm and diagnostics.

    Args:
        job: `load_n`; `views` ("3" or "12", the paper's); `photons`; `seed` of the noise and of the limb's position;
            `known`: screws and spectrum are given to the registration; `options` of the registration.
    """
    recipe = recipe_of(job)
    made = specimen(recipe)
    spectrum, geometry = tungsten_spectrum(recipe.tube.voltage), views_of(recipe.scanner)
    taken = next(
        acquisitions(made, geometry, spectrum, progress=False, construct=_construct() if job["load_n"] else None)
    )
    config = RegistrationConfig(material=recipe.implant.material, **job["options"])
    lines, mask = line_integrals_from_intensity(taken.counts.float(), recipe.panel.open_beam)
    cloud = ImplantPointCloud.from_mesh(made.implant, config.pitch_mm)
    start = time.perf_counter()
    result = register(
        cloud,
        RegistrationData(geometry, lines, mask),
        config,
        spectrum=spectrum if job["known"] else None,
        components=made.screws if job["known"] else (),
        holes=made.holes,
    )
    nodes = cloud.coarsened(_NODES_COARSER).points.double()
    return {
        **{name: job[name] for name in ("seed", "load_n", "views", "photons")},
        "nodes": round(float(bb_rmse(result.warp(nodes), taken.loaded.implant(nodes))), 4),
        "beads": round(float(bb_rmse(result.warp(made.beads()), made.beads_after(taken.loaded.fragments))), 4),
        "node_std_mm": result.diagnostics.get("node_std_mm"),
        "status": result.status,
        "seconds": round(time.perf_counter() - start, 1),
    }


@cache
def _construct() -> ElasticConstruct:
    """Elastic model of the plate on its bone, built once per process because it takes seconds."""
    return ElasticConstruct(specimen(Recipe.of(packaged("tibial_plate"))))


def recipe_of(job: Job) -> Recipe:
    """Recipe of a job: the tibial plate's, with the job's load, quanta, views and random position of the limb."""
    rng = np.random.default_rng([job["seed"], 41])
    shift, turn = (rng.normal(scale=scale, size=3).tolist() for scale in (_SHIFT_MM, _TURN_DEG))
    load = {"force": f"[0, 0, {-job['load_n']}] N", "translation": f"{shift} mm", "rotation": f"{turn} deg"}
    changes = {
        "configurations": {"loaded": load},
        "panel": {"photons": job["photons"]},
        "scanner": {"views": MultisourceScanner().paper_views(job["views"])},
        "seed": job["seed"],
    }
    return Recipe.of({**packaged("tibial_plate"), **changes})
