"""What is known of how an implant bends, whatever the images say."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BendingPrior:
    """Weights of what speaks against a free-form deformation, in units of the loss.

    Attributes:
        beta: Of the diffusion penalty (eq. 5 of Cao et al. 2020), where groups move freely.
        stiffness: Of the implant's elastic energy, as its mean density over Young's modulus, where groups move freely.
        load_weight: Loss for a load of 1 kN along an elastic mode; it grows with the load's square.
        youngs_modulus_gpa: Young's modulus of the implant, GPa.
    """

    beta: float = 1e-4
    stiffness: float = 30.0
    load_weight: float = 3e-9
    youngs_modulus_gpa: float = 200.0
