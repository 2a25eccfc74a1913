"""X-ray physics: materials, spectra, scatter and intensity models that turn path lengths in mm into line integrals."""

from .beam import Beam
from .blur import gaussian_blur, gaussian_kernel
from .detector import COUNT_FLOOR, line_integrals_from_intensity
from .intensity import FreeParameter, IdentityIntensity, IntensityModel, PolyenergeticTransmission, intensity_from_dict
from .materials import (
    ElasticConstants,
    Material,
    calcium_attenuation,
    calcium_in_water,
    calcium_of,
    elastic_constants,
    is_elastic,
    material,
    material_names,
    mixture,
)
from .scatter import Veil, scatter_shapes, scattered_signal, veil_image
from .spectra import Spectrum, tungsten_spectrum
from .transmission import transmission

__all__ = [
    "COUNT_FLOOR",
    "Beam",
    "ElasticConstants",
    "FreeParameter",
    "IdentityIntensity",
    "IntensityModel",
    "Material",
    "PolyenergeticTransmission",
    "Spectrum",
    "Veil",
    "calcium_attenuation",
    "calcium_in_water",
    "calcium_of",
    "elastic_constants",
    "gaussian_blur",
    "gaussian_kernel",
    "intensity_from_dict",
    "is_elastic",
    "line_integrals_from_intensity",
    "material",
    "material_names",
    "mixture",
    "scatter_shapes",
    "scattered_signal",
    "transmission",
    "tungsten_spectrum",
    "veil_image",
]
