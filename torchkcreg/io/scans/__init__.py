"""Measured projections: reads image files and folders of many formats as line integrals with a mask."""

from .dicom import is_dicom, read_dicom_geometry
from .images import image_header, read_image
from .measured import Projections
from .plausible import implausible_magnification
from .projections import ProjectionFile, read_projections, write_projections, write_stack

__all__ = [
    "ProjectionFile",
    "Projections",
    "image_header",
    "implausible_magnification",
    "is_dicom",
    "read_dicom_geometry",
    "read_image",
    "read_projections",
    "write_projections",
    "write_stack",
]
