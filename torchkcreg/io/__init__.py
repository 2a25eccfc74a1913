"""Reading and writing files: geometry, projections, meshes, spectra, points, poses, configurations, runs, figures.

Only this package accesses the disk. Input is validated, and an error message is one line that names the file and the
key. Files are written atomically: a file is either complete or absent.
"""

from .config import read_config, write_config
from .files import read_json, write_figure, write_json, write_text
from .geometry import geometry_from_dict, geometry_to_dict, read_geometry, write_geometry
from .implants import read_components, read_init, read_tra, write_components, write_init, write_tra
from .matrix_tables import read_matrix_table, write_matrix_table
from .mayacam import read_mayacam, write_mayacam
from .meshes import MESH_SUFFIXES, WRITTEN_SUFFIXES, read_mesh, write_mesh
from .point_clouds import (
    read_point_cloud_ply,
    read_reference,
    write_point_cloud_ply,
    write_points_vtp,
    write_surface_vtu,
)
from .rtk_geometry import read_rtk, write_rtk
from .runs import (
    LAYERS,
    RECONSTRUCTION,
    REPORT,
    RunFolder,
    implant_of_run,
    mesh_of_run,
    read_layers,
    read_run,
    versions,
    write_layers,
)
from .scans import (
    ProjectionFile,
    Projections,
    implausible_magnification,
    read_projections,
    write_projections,
    write_stack,
)
from .tables import is_points_table, read_points, read_spectrum, write_points, write_spectrum
from .transforms import displacement_field, itk_transform, write_displacement_field, write_itk_transform
from .volumes import read_volume, write_volume

__all__ = [
    "LAYERS",
    "MESH_SUFFIXES",
    "RECONSTRUCTION",
    "REPORT",
    "WRITTEN_SUFFIXES",
    "ProjectionFile",
    "Projections",
    "RunFolder",
    "displacement_field",
    "geometry_from_dict",
    "geometry_to_dict",
    "implant_of_run",
    "implausible_magnification",
    "is_points_table",
    "itk_transform",
    "mesh_of_run",
    "read_components",
    "read_config",
    "read_geometry",
    "read_init",
    "read_json",
    "read_layers",
    "read_matrix_table",
    "read_mayacam",
    "read_mesh",
    "read_point_cloud_ply",
    "read_points",
    "read_projections",
    "read_reference",
    "read_rtk",
    "read_run",
    "read_spectrum",
    "read_tra",
    "read_volume",
    "versions",
    "write_components",
    "write_config",
    "write_displacement_field",
    "write_figure",
    "write_geometry",
    "write_init",
    "write_itk_transform",
    "write_json",
    "write_layers",
    "write_matrix_table",
    "write_mayacam",
    "write_mesh",
    "write_point_cloud_ply",
    "write_points",
    "write_points_vtp",
    "write_projections",
    "write_rtk",
    "write_spectrum",
    "write_stack",
    "write_surface_vtu",
    "write_text",
    "write_tra",
    "write_volume",
]
