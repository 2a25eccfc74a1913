"""Materials, spectra, intensity models and the detector: what turns path lengths in mm into measured line integrals."""

from torchkcreg.physics.beam import Beam
from torchkcreg.physics.blur import gaussian_blur, gaussian_kernel
from torchkcreg.physics.detector import COUNT_FLOOR, line_integrals_from_intensity
from torchkcreg.physics.elastic_constants import ElasticConstants, elastic_constants, is_elastic
from torchkcreg.physics.intensity import IdentityIntensity, PolyenergeticTransmission, intensity_from_dict
from torchkcreg.physics.intensity_model import FreeParameter, IntensityModel
from torchkcreg.physics.materials import (
    Material,
    calcium_attenuation,
    calcium_in_water,
    calcium_of,
    material,
    material_names,
    mixture,
)
from torchkcreg.physics.scatter import Veil, scatter_shapes, scattered_signal, veil_image
from torchkcreg.physics.spectra import Spectrum, tungsten_spectrum
from torchkcreg.physics.transmission import transmission

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
