"""A linear layer used in several steps, whose weights get their gradient in one product."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


class RepeatedLinear:
    """The layers x @ weight[g] + bias[g], applied to several x one after the other.

    Autograd alone computes the gradient of the weights once per use and adds it to the sum of the
    previous gradients. For layers of a million weights and a few rows per use, reading and writing
    these gradients takes as long as the products. Here each use passes on the gradient of its
    output, and after the last use a single product of all rows gives the gradient of the weights.
    This is the same sum in another order. It cannot be differentiated again.

    Args:
        weight: One matrix per group.
        bias: None for no bias.
        rows: Number of rows of each x, in the order of use.
    """

    def __init__(
        self,
        weight: Float[Tensor, "groups inputs outputs"],
        bias: Float[Tensor, "groups outputs"] | None,
        rows: Sequence[int],
    ):
        if torch.is_autocast_enabled(weight.device.type):
            weight = weight.to(torch.get_autocast_dtype(weight.device.type))
        if bias is None:
            bias = weight.new_zeros(len(weight), weight.shape[2])
        self.weight = weight.detach()
        self._inputs: list[Tensor] | None = None
        if torch.is_grad_enabled() and weight.requires_grad:
            self._inputs = []
        biases = _Gather.apply(weight, bias.to(weight.dtype), rows, self._inputs)
        self._biases = iter(biases)

    def __call__(
        self, x: Float[Tensor, "groups rows inputs"]
    ) -> Float[Tensor, "groups rows outputs"]:
        """Apply the layer to the next x."""
        x = x.to(self.weight.dtype)
        if self._inputs is not None:
            self._inputs.append(x.detach())
        return torch.baddbmm(next(self._biases), x, self.weight)


class _Gather(torch.autograd.Function):
    """The bias, once per use. Its backward pass gets the gradients of all outputs."""

    @staticmethod
    def forward(
        ctx: Any, weight: Tensor, bias: Tensor, rows: Sequence[int], inputs: list[Tensor] | None
    ) -> tuple[Tensor, ...]:
        ctx.inputs = inputs
        return tuple(bias.unsqueeze(1).expand(-1, count, -1) for count in rows)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        gradient = torch.cat(upstream[: len(ctx.inputs)], dim=1)  # unused calls are left out
        weight = gradient.transpose(1, 2) @ torch.cat(ctx.inputs, dim=1)
        return weight.transpose(1, 2), gradient.sum(dim=1), None, None
