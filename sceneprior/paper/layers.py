"""Building blocks that several modules share: layers, and base classes of the decoders."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from sceneprior.core.scene import Mesh, Solid
from sceneprior.core.settings import Section
from sceneprior.core.views import DecodedScenes


def mlp(*layers: nn.Module, slope: float = 0.0) -> nn.Sequential:
    """The layers in sequence, with a ReLU between them, or a leaky ReLU if `slope` is not 0."""
    between = nn.LeakyReLU(slope) if slope else nn.ReLU()
    return nn.Sequential(*[part for layer in layers for part in (layer, between)][:-1])


def dropout(x: Float[Tensor, "*shape"], p: float) -> Float[Tensor, "*shape"]:
    """Set each number to 0 with probability `p` and divide the others by 1 - p, as `F.dropout` in
    training.

    On a CPU, this function samples the positions of the zeros instead of deciding for every number,
    which takes a quarter of the time. For n numbers, Poisson(-n ln(1 - p)) positions are drawn
    uniformly with replacement. Each number is then drawn Poisson(-ln(1 - p)) times, independently
    of the others, so the probability that it is never drawn is 1 - p.
    """
    if p == 0 or x.device.type != "cpu":
        return F.dropout(x, p)
    hits = torch.poisson(torch.tensor(-x.numel() * math.log1p(-p), dtype=torch.float64))
    scale = x.new_full((x.numel(),), 1 / (1 - p))
    scale.scatter_(0, torch.randint(max(x.numel(), 1), (int(hits),)), 0)
    return x * scale.view(x.shape)


class ShapeModule(nn.Module, ABC):
    """A shape decoder: maps an object's feature to its shape, and the shape to a mesh."""

    faces: Tensor | None
    """(faces, 3) triangles, if all meshes of the decoder share them; else None."""

    @abstractmethod
    def add_shapes(
        self,
        scenes: DecodedScenes,
        features: Float[Tensor, "rooms objects features"],
        with_shape: bool | Bool[Tensor, "rooms shaped"],
        wanted: Bool[Tensor, "rooms wanted"] | None,
    ) -> DecodedScenes:
        """The decoded layouts with shapes added; the arguments are those of `ScenePrior.decode`."""

    def along_path(
        self,
        rooms: DecodedScenes,
        places: Float[Tensor, " rooms"],
        path: DecodedScenes,
        kept: Bool[Tensor, "steps objects"],
    ) -> DecodedScenes:
        """Rooms at places (0 to 1) of a path, with shapes that change gradually along it.

        `path` has the rooms at equal steps from 0 to 1, and `kept` selects the predictions that are
        objects. Deformed meshes change gradually anyway, so by default `rooms` stays unchanged.
        """
        return rooms

    @abstractmethod
    def mesh_of(self, decoded: DecodedScenes, room: int, item: int) -> Mesh | None:
        """The mesh of prediction `item`; None if shapes were not decoded."""

    def solids_of(self, decoded: DecodedScenes, room: int, item: int) -> tuple[Solid, ...]:
        """The convex solids of prediction `item`; none for shapes that are not made of solids."""
        return ()


class ShapeModuleConfig(Section, ABC):
    """A config section that builds a shape decoder."""

    @abstractmethod
    def build(self, features: int) -> ShapeModule:
        """The module for object features of width `features`, freshly initialised."""


class DecoderConfig(Section, ABC):
    """A config section that builds the decoder from a latent z to object features x_k.

    The module maps (z of shape (rooms, D_z), N) to features of shape (rooms, N, D_z). It also
    accepts the number of features that each room needs; features beyond that number are
    meaningless.
    """

    name: str

    @abstractmethod
    def build(self, width: int, max_objects: int) -> nn.Module:
        """The module for features of D_z = `width`, freshly initialised."""


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


class StepOutputs(nn.Module):
    """A separate two-layer MLP at the end of each step k, so that features depend on k.

    The output of the MLP is x_k, which later steps read, too. `steps` is N, and `width` the size of
    a feature.
    """

    def __init__(self, steps: int, width: int):
        super().__init__()
        self.mlps = nn.ModuleList(
            mlp(nn.Linear(width, width), nn.Linear(width, width)) for _ in range(steps)
        )

    def forward(self, x: Float[Tensor, "rooms width"], step: int) -> Float[Tensor, "rooms width"]:
        return self.mlps[step](x)


class QuerySelfAttention(nn.Module):
    """The decoder layer's self-attention over its single query z: a residual layer and its norm.

    The softmax over a single score is always 1, so the layer has no query and key projections.
    """

    def __init__(self, width: int, heads: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, z: Float[Tensor, "rooms width"]) -> Float[Tensor, "rooms width"]:
        share = self.dropout(z.new_ones(len(z), self.heads, 1))  # one attention weight per head
        value = (share * self.value(z).unflatten(-1, (self.heads, -1))).flatten(1)
        return self.norm(z + self.dropout(self.out(value)))
