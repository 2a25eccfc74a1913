"""Deformable known-component 3D-2D registration of metal implants in cone-beam CT."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .deformation import FreeFormDeformation
    from .geometry import ConeBeamGeometry, MultisourceScanner, VolumeGrid
    from .implant import Component, ImplantPointCloud
    from .io import read_run
    from .physics import PolyenergeticTransmission, line_integrals_from_intensity, tungsten_spectrum
    from .projector import PointCloudProjector, project_mesh, project_points
    from .registration import RegistrationConfig, RegistrationData, RegistrationResult, Stage, register
    from .similarity import GradientCorrelationLoss, gradient_correlation

__version__ = "0.1.0"

_HOMES = {
    "Component": "implant",
    "ConeBeamGeometry": "geometry",
    "FreeFormDeformation": "deformation",
    "GradientCorrelationLoss": "similarity",
    "ImplantPointCloud": "implant",
    "MultisourceScanner": "geometry",
    "PointCloudProjector": "projector",
    "PolyenergeticTransmission": "physics",
    "RegistrationConfig": "registration",
    "RegistrationData": "registration",
    "RegistrationResult": "registration",
    "Stage": "registration",
    "VolumeGrid": "geometry",
    "gradient_correlation": "similarity",
    "line_integrals_from_intensity": "physics",
    "project_mesh": "projector",
    "project_points": "projector",
    "read_run": "io",
    "register": "registration",
    "tungsten_spectrum": "physics",
}

_FOLDERS = (
    "deformation",
    "evaluation",
    "experiments",
    "geometry",
    "implant",
    "io",
    "physics",
    "kernels",
    "optimization",
    "projector",
    "reconstruction",
    "registration",
    "scene",
    "similarity",
    "simulation",
    "splines",
    "visualization",
)

__all__ = [
    "Component",
    "ConeBeamGeometry",
    "FreeFormDeformation",
    "GradientCorrelationLoss",
    "ImplantPointCloud",
    "MultisourceScanner",
    "PointCloudProjector",
    "PolyenergeticTransmission",
    "RegistrationConfig",
    "RegistrationData",
    "RegistrationResult",
    "Stage",
    "VolumeGrid",
    "__version__",
    "gradient_correlation",
    "line_integrals_from_intensity",
    "project_mesh",
    "project_points",
    "read_run",
    "register",
    "tungsten_spectrum",
]


def __getattr__(name: str) -> Any:
    """A public name or folder, imported when it is first asked for (PEP 562): the package alone does not load torch."""
    if name in _FOLDERS:
        return importlib.import_module(f".{name}", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_FOLDERS})
