"""Simulations of the two experiments of Cao et al. 2020 (section 2.4), with their tables and figures."""

from .experiment import packaged
from .femoral import femoral_plate
from .tibial import tibial_plate

__all__ = ["femoral_plate", "packaged", "tibial_plate"]
