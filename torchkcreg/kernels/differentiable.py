"""Fast operations with all derivatives of torch: forward and reverse mode, any order, `torch.func`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor


class Kernel(Protocol):
    """Operation with a fast result and gradient, and a reference in plain torch for both."""

    @property
    def forward(self) -> Callable[..., Tensor]:
        """Fast computation of the result; need not be differentiable."""

    @property
    def reference(self) -> Callable[..., Tensor]:
        """Computation of the result in plain torch, differentiable by autograd."""

    def pullback(self, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]) -> Sequence[Tensor | None]:
        """Fast gradients to the inputs that need one; need not be differentiable."""


def differentiable(kernel: Kernel, *inputs: Tensor) -> Tensor:
    """Result of the kernel. First derivatives in reverse mode are fast; all others are those of the reference."""
    return _Fast.apply(kernel, *inputs)


def linear(images: Tensor, apply: Callable[[Tensor], Tensor], transpose: Callable[[Tensor], Tensor]) -> Tensor:
    """Apply a linear operation. Its forward derivative is the operation itself, its reverse derivative the transpose.

    Args:
        images: Images, independent of each other along the first axis.
        apply: The operation; need not be differentiable.
        transpose: The transposed operation.
    """
    return _Linear.apply(images, apply, transpose)


def is_transformed(tensor: Tensor) -> bool:
    """True inside a transform of `torch.func`, where checkpointing does not work."""
    return torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def one_by_one(apply: Callable, info: Any, in_dims: tuple, inputs: tuple) -> tuple[Any, Any]:
    """Apply a function to the elements of a batch, one after the other (for `vmap`)."""
    results = [
        apply(*(x if d is None else x.select(d, i) for x, d in zip(inputs, in_dims))) for i in range(info.batch_size)
    ]
    if isinstance(results[0], Tensor):
        return torch.stack(results), 0
    stacked = tuple(torch.stack(parts) for parts in zip(*results))
    return stacked, (0,) * len(stacked)


def _pushed(function: Callable, inputs: Sequence[Tensor], tangents: Sequence[Tensor | None]) -> Any:
    """Forward derivative from reverse mode only, as the transpose of the transpose."""
    result, pull, *_ = torch.func.vjp(function, *inputs)
    zero = torch.zeros_like(result) if isinstance(result, Tensor) else tuple(torch.zeros_like(r) for r in result)
    _, push, *_ = torch.func.vjp(pull, zero)
    return push(tuple(torch.zeros_like(x) if t is None else t for x, t in zip(inputs, tangents)))[0]


class _Fast(torch.autograd.Function):
    """See `differentiable`."""

    @staticmethod
    def forward(kernel: Kernel, *inputs: Tensor) -> Tensor:
        return kernel.forward(*inputs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.kernel, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple:
        needed = ctx.needs_input_grad[1:]
        gradients = _FastGradient.apply(ctx.kernel, needed, gradient, *ctx.saved_tensors)
        return None, *(g if need else None for g, need in zip(gradients, needed))

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> Tensor:
        return _pushed(ctx.kernel.reference, ctx.saved_tensors, tangents)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *inputs: Any) -> tuple:
        return one_by_one(_Fast.apply, info, in_dims, inputs)


class _FastGradient(torch.autograd.Function):
    """Gradient of `_Fast`, itself differentiable; zeros for inputs that need none."""

    @staticmethod
    def forward(kernel: Kernel, needed: Sequence[bool], gradient: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        gradients = kernel.pullback(gradient, inputs, needed)
        return tuple(torch.zeros_like(x) if g is None else g for g, x in zip(gradients, inputs))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.kernel, ctx.needed, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def _reference(ctx: Any) -> Callable:
        def gradients(gradient: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
            all_gradients = torch.func.vjp(ctx.kernel.reference, *inputs)[1](gradient)
            return tuple(g if need else torch.zeros_like(g) for g, need in zip(all_gradients, ctx.needed))

        return gradients

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple:
        return None, None, *torch.func.vjp(_FastGradient._reference(ctx), *ctx.saved_tensors)[1](gradients)

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        return _pushed(_FastGradient._reference(ctx), ctx.saved_tensors, tangents)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *inputs: Any) -> tuple:
        flat = (in_dims[0], None, *in_dims[2:])  # `needed` is a tuple of booleans, not a tensor
        return one_by_one(_FastGradient.apply, info, flat, inputs)


class _Linear(torch.autograd.Function):
    """See `linear`."""

    @staticmethod
    def forward(images: Tensor, apply: Callable[[Tensor], Tensor], transpose: Callable[[Tensor], Tensor]) -> Tensor:
        return apply(images)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        _, ctx.one_way, ctx.other_way = inputs

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple:
        return _Linear.apply(gradient, ctx.other_way, ctx.one_way), None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:
        return _Linear.apply(tangent, ctx.one_way, ctx.other_way)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, images: Tensor, *maps: Callable[[Tensor], Tensor]) -> tuple[Tensor, int]:
        batch = images.movedim(in_dims[0], 0)
        result = _Linear.apply(batch.flatten(0, 1), *maps)
        return result.unflatten(0, batch.shape[:2]), 0
