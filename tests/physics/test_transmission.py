"""The transmitted signal: every backend against the definition, its gradients, and analytic truth."""

from __future__ import annotations

import math

import pytest
import torch

from torchkcreg.kernels import unavailable_reason
from torchkcreg.physics import Beam, Spectrum, gaussian_kernel, material, transmission, tungsten_spectrum

SIZES = [(6, 10, 3, 2), (5, 37, 1, 1), (4, 4, 9, 4), (1, 3, 5, 1)]
STEEL, BONE, WATER = material("steel"), material("cortical_bone"), material("water")


@pytest.fixture(autouse=True)
def _kernels() -> None:
    if unavailable_reason() is not None:
        pytest.skip(f"no C++ kernels: {unavailable_reason()}")


def problem(*, rows: int = 6, cols: int = 10, taps: int = 3, dtype=torch.float64, seed: int = 0):
    """Two candidates, three materials, two views, four energies."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    kernel = random(2, taps)
    return (
        (8 * random(2, 3, 2, rows, cols)).to(dtype),
        (0.3 * random(3, 4)).to(dtype),
        random(2, 2, 4).to(dtype),
        (kernel / kernel.sum(-1, keepdim=True)).to(dtype),
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-13), (torch.float32, 3e-6)])
@pytest.mark.parametrize(
    ("rows", "cols", "taps", "pooling"), [(6, 10, 3, 2), (5, 37, 1, 1), (4, 4, 9, 4), (1, 3, 5, 1)]
)
def test_the_kernel_is_the_definition(rows, cols, taps, pooling, dtype, tolerance) -> None:
    lengths, attenuation, weights, kernel = problem(rows=rows, cols=cols, taps=taps, dtype=dtype)
    found, expected = (
        transmission(lengths, attenuation, weights, kernel=kernel, pooling=pooling, backend=backend)
        for backend in ("cpp", "torch")
    )
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("rows", "cols", "taps", "pooling"), [(6, 10, 3, 2), (3, 19, 1, 1), (2, 2, 5, 1)])
def test_its_gradients_are_the_definitions(rows, cols, taps, pooling) -> None:
    inputs = [t.requires_grad_() for t in problem(rows=rows, cols=cols, taps=taps)]
    lengths, attenuation, weights, kernel = inputs
    upstream = torch.rand(2, 2, rows // pooling, cols // pooling, dtype=torch.float64)
    gradients = [
        torch.autograd.grad(
            transmission(lengths, attenuation, weights, kernel=kernel, pooling=pooling, backend=backend),
            inputs,
            upstream,
        )
        for backend in ("cpp", "torch")
    ]
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected)
    alone = torch.autograd.grad(
        transmission(lengths, attenuation.detach(), weights, kernel=kernel, pooling=pooling), lengths, upstream
    )
    torch.testing.assert_close(alone[0], gradients[0][0])


def test_all_inputs_can_be_differentiated_twice_and_forward() -> None:
    inputs = [t.requires_grad_() for t in problem(rows=2, cols=4)]

    def function(*tensors: torch.Tensor) -> torch.Tensor:
        return transmission(*tensors[:3], kernel=tensors[3], pooling=2)

    assert torch.autograd.gradcheck(function, inputs, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(function, inputs)


def test_a_batch_of_vmap_is_one_by_one() -> None:
    lengths, attenuation, weights, kernel = problem()
    many = torch.stack([lengths, 0.5 * lengths, 2 * lengths])
    together = torch.func.vmap(lambda x: transmission(x, attenuation, weights, kernel=kernel))(many)
    torch.testing.assert_close(together[2], transmission(many[2], attenuation, weights, kernel=kernel))


def test_the_operators_pass_opcheck() -> None:
    inputs = problem(rows=4, cols=6)
    torch.library.opcheck(torch.ops.torchkcreg.transmission, (*inputs, 2))
    grad = torch.rand(2, 2, 2, 3, dtype=torch.float64)
    for need in (True, False):
        torch.library.opcheck(torch.ops.torchkcreg.transmission_backward, (grad, *inputs, 2, need))


def test_exponentials_are_right_to_the_last_digits_over_their_whole_range() -> None:
    for dtype, eps, low in ((torch.float32, 2e-7, -80.0), (torch.float64, 5e-16, -700.0)):
        exponents = torch.linspace(low, 3.0, 4001, dtype=torch.float64).to(dtype)
        one = torch.ones(1, 1, dtype=dtype)
        found = transmission(-exponents[None, None, None, None], one, one[0], backend="cpp").flatten()
        expected = exponents.double().exp()
        assert float(((found.double() - expected) / expected).abs().max()) < eps


def test_what_is_no_number_stays_none_and_starvation_ends_at_nothing() -> None:
    lengths = torch.tensor([math.nan, 1e6, 0.0]).reshape(1, 1, 1, 1, 3)
    found = transmission(lengths, torch.ones(1, 1), torch.ones(1), backend="cpp").flatten()
    assert math.isnan(found[0]) and 0 <= found[1] < 1e-37 and found[2] == 1


def test_threads_change_no_bit() -> None:
    lengths, attenuation, weights, kernel = problem(rows=64, cols=90, dtype=torch.float32)
    threads = torch.get_num_threads()
    results = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        leaf = lengths.clone().requires_grad_()
        image = transmission(leaf, attenuation, weights, kernel=kernel)
        results.append((image, torch.autograd.grad(image.square().sum(), leaf)[0]))
    torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for result in results[1:] for a, b in zip(result, results[0], strict=True))


def test_wrong_shapes_are_named() -> None:
    lengths, attenuation, weights, kernel = problem()
    with pytest.raises(ValueError, match=r"path_lengths must have shape \(K, 2, V, rows, cols\)"):
        transmission(lengths, attenuation[:2], weights)
    with pytest.raises(ValueError, match=r"weights must broadcast to \(K, V, E\) = \(2, 2, 4\), got \(3,\)"):
        transmission(lengths, attenuation, torch.ones(3))
    with pytest.raises(ValueError, match="pooling must divide rows and cols, got 4 for 6 x 10"):
        transmission(lengths, attenuation, weights, kernel=kernel, pooling=4)


def test_a_beam_lets_through_what_beer_and_lambert_say() -> None:
    beam = Beam.of([STEEL], Spectrum((60.0,), (1.0,)))
    passed = beam.transmission(torch.full((1, 1, 1, 1, 1), 3.0, dtype=torch.float64))
    assert float(passed) == pytest.approx(math.exp(-3.0 * float(STEEL.attenuation(60.0))))


def test_each_source_has_its_own_spectrum() -> None:
    soft, hard = tungsten_spectrum(70), tungsten_spectrum(120)
    beam = Beam.of([STEEL, WATER], {"T1": soft, "T2": hard})
    lengths = torch.rand(1, 2, 3, 2, 2, dtype=torch.float64) * 5
    found = beam.transmission(lengths, weights=beam.weights_of(["T2", "T1", "T2"]))
    for view, spectrum in enumerate((hard, soft, hard)):
        alone = Beam.of([STEEL, WATER], spectrum).transmission(lengths[:, :, view : view + 1])
        torch.testing.assert_close(found[:, view : view + 1], alone, atol=1e-3, rtol=0)
    with pytest.raises(ValueError, match="spectra of the sources T1, T2, but got a view of source T3"):
        beam.weights_of(["T1", "T3"])
    with pytest.raises(ValueError, match="but the views have no sources"):
        beam.weights_of(None)


def test_a_beam_keeps_its_precision_and_follows_to_other_devices() -> None:
    beam = Beam.of([STEEL], tungsten_spectrum(90)).float()
    assert beam.attenuation.dtype == torch.float64
    assert beam.to("meta").attenuation.is_meta


def test_attenuation_can_be_learned() -> None:
    lengths = torch.linspace(0, 9, 30, dtype=torch.float64).reshape(1, 1, 1, 5, 6)
    measured = transmission(lengths, torch.tensor([[0.4, 0.1]]), torch.tensor([0.5, 0.5]))
    found = torch.tensor([[0.2, 0.15]], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([found], lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        (transmission(lengths, found, torch.tensor([0.5, 0.5])) - measured).square().sum().backward()
        optimizer.step()
    assert found.detach().flatten().tolist() == pytest.approx([0.4, 0.1], abs=0.01)


def test_the_blur_of_a_candidate_is_its_own() -> None:
    lengths = 4 * torch.rand(2, 1, 1, 8, 8, dtype=torch.float64)
    kernels = gaussian_kernel(torch.tensor([0.4, 1.1], dtype=torch.float64))
    together = transmission(lengths, torch.ones(1, 1), torch.ones(1), kernel=kernels)
    alone = transmission(lengths[1:], torch.ones(1, 1), torch.ones(1), kernel=kernels[1:])
    torch.testing.assert_close(together[1:], alone)
