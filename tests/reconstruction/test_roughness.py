import torch

from torchkcreg.reconstruction.system import VoxelRoughness, quadratic_roughness

SPACING = (0.5, 0.7, 1.0)
ROUGHNESS = VoxelRoughness(SPACING)


def test_the_gradient_is_that_of_the_roughness():
    volume = torch.randn(4, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    (expected,) = torch.autograd.grad(quadratic_roughness(volume, spacing=SPACING), volume)
    assert torch.allclose(ROUGHNESS.gradient(volume.detach()), expected)


def test_the_curvature_bounds_the_roughness_from_above():
    generator = torch.Generator().manual_seed(1)
    volume, step = (torch.randn(4, 5, 6, dtype=torch.float64, generator=generator) for _ in range(2))
    bound = quadratic_roughness(volume, spacing=SPACING) + (ROUGHNESS.gradient(volume) * step).sum()
    bound = bound + 0.5 * (ROUGHNESS.curvature(volume) * step**2).sum()
    assert quadratic_roughness(volume + step, spacing=SPACING) <= bound
    checkerboard = (torch.arange(4)[:, None, None] + torch.arange(5)[:, None] + torch.arange(6)) % 2 * 2.0 - 1
    curved = 0.5 * (ROUGHNESS.curvature(checkerboard) * checkerboard**2).sum()
    assert torch.allclose(ROUGHNESS.value(checkerboard).float(), curved)


def test_a_constant_volume_is_not_rough():
    assert quadratic_roughness(torch.full((3, 3, 3), 7.0)) == 0
    assert (VoxelRoughness().gradient(torch.full((3, 1, 3), 7.0)) == 0).all()
