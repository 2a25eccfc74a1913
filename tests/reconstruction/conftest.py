"""Exact line integrals of solids, for tests of reconstructions."""

import pytest
import torch

from torchkcreg.simulation.solids import chord_image


@pytest.fixture(scope="session")
def line_integrals_of():
    """Function of solids with their attenuation and a geometry: line integrals (V, rows, cols), float32."""

    def line_integrals(solids, geometry):
        images = torch.zeros(geometry.num_views, *geometry.det_shape, dtype=torch.float64)
        for solid, attenuation in solids:
            for view, matrix in enumerate(geometry.projection_matrices):
                images[view] += attenuation * chord_image(solid, matrix, geometry.det_shape)
        return images.float()

    return line_integrals
