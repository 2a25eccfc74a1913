"""Deformable known-component 3D-2D registration of metal implants in cone-beam CT."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .commands import VisitFiles, assess
    from .deformation import FreeFormDeformation
    from .geometry import ConeBeamGeometry, MultisourceScanner, VolumeGrid, circular_geometry
    from .implant import Component, ImplantPointCloud, KnownComponent, Screw, find_holes
    from .io import read_components, read_geometry, read_mesh, read_projections, read_run
    from .physics import PolyenergeticTransmission, line_integrals_from_intensity, material, tungsten_spectrum
    from .projector import PointCloudProjector, project_mesh, project_points
    from .reconstruction import fdk, reconstruct
    from .registration import Implant, RegistrationConfig, RegistrationResult, Stage, build_scene, register
    from .scene import Assembly, RegistrationData, Scene
    from .similarity import GradientCorrelationLoss, gradient_correlation

__version__ = "0.1.0"

_HOMES = {
    "Assembly": "scene",
    "Component": "implant",
    "ConeBeamGeometry": "geometry",
    "FreeFormDeformation": "deformation",
    "GradientCorrelationLoss": "similarity",
    "Implant": "registration",
    "ImplantPointCloud": "implant",
    "KnownComponent": "implant",
    "MultisourceScanner": "geometry",
    "PointCloudProjector": "projector",
    "PolyenergeticTransmission": "physics",
    "RegistrationConfig": "registration",
    "RegistrationData": "scene",
    "RegistrationResult": "registration",
    "Scene": "scene",
    "Screw": "implant",
    "Stage": "registration",
    "VisitFiles": "commands",
    "VolumeGrid": "geometry",
    "assess": "commands",
    "build_scene": "registration",
    "circular_geometry": "geometry",
    "fdk": "reconstruction",
    "find_holes": "implant",
    "gradient_correlation": "similarity",
    "line_integrals_from_intensity": "physics",
    "material": "physics",
    "project_mesh": "projector",
    "project_points": "projector",
    "read_components": "io",
    "read_geometry": "io",
    "read_mesh": "io",
    "read_projections": "io",
    "read_run": "io",
    "reconstruct": "reconstruction",
    "register": "registration",
    "tungsten_spectrum": "physics",
}

_FOLDERS = (
    "commands",
    "deformation",
    "evaluation",
    "geometry",
    "implant",
    "io",
    "kernels",
    "mechanics",
    "optimization",
    "physics",
    "projector",
    "reconstruction",
    "registration",
    "scene",
    "search",
    "similarity",
    "simulation",
    "splines",
    "studies",
    "visualization",
)

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    """Import a public name or folder when it is first used (PEP 562): `import torchkcreg` alone does not load torch."""
    if name in _FOLDERS:
        return importlib.import_module(f".{name}", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_FOLDERS])
