"""The permutation-invariant transformer: object features x_k from z (section 3.2, Eq. 3 and 4)."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from sceneprior.core.settings import Section

Layer = Callable[[Tensor], Tensor]


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


class TransformerConfig(DecoderConfig):
    """Size of the transformer (supplement A), and optional parts of the released code."""

    name: Literal["transformer"] = "transformer"
    heads: int = Field(4, ge=1)
    """Attention heads; must divide D_z."""
    hidden: int = Field(1024, ge=8)
    """Inner width of the feed-forward layers; wider ones fit more rooms, slower."""
    dropout: float = Field(0.1, ge=0, lt=1)
    """Dropout rate, applied at the same places as in the library that the paper builds on; 0.1 is
    that library's default. More delays overfitting."""
    final_norm: bool = False
    """Add a layer norm after the encoder layer and after the decoder layer: the default of the
    library that the paper builds on, and the released code's."""
    unit_start: bool = False
    """Initialise the start token x_0 from N(0, 1), as in the released code, not N(0, 1 / D_z)."""
    query_self_attention: bool = False
    """Give the decoder layer self-attention over its single query z, as in the released code."""
    step_mlps: bool = False
    """End each step k with a separate two-layer MLP, a ReLU after each layer, as in the released
    code: 0.5 million weights per step at width 512. Features then depend on k."""

    def build(self, width: int, max_objects: int) -> "SceneTransformer":
        return SceneTransformer(width, self, max_objects)


class SceneTransformer(nn.Module):
    """Generate N object features x_k, each from z and the unordered set of the previous ones.

        P(x_1, ..., x_N | z) = P(x_1 | z) prod_k P(x_k | {x_1, ..., x_(k-1)}; z)    (Eq. 3)

    The order of x_1, ..., x_(k-1) does not matter, for any permutations p and q of them:

        P(x_k | x_p1, ..., x_p(k-1); z) = P(x_k | x_q1, ..., x_q(k-1); z)           (Eq. 4)

    Step k: one encoder layer (self-attention among x_0 .. x_(k-1), no positional encoding) gives
    the scene context F_k; one decoder layer attends to it with z as the query. Both layers apply
    the norm after the residual connection, as in the library that the paper builds on.

    Three shortcuts save time and are exact. Encoder: an object's query, key and value do not
    change, so each is computed once and appended; the value is stored multiplied by each head's
    share of the output projection. Attention and the later layers are computed again in each step,
    because earlier objects also attend to later ones, so their time grows with the square of the
    number of objects. Decoder: all steps share the one query z, so instead of projecting every
    context token to a key and a value, z's query is multiplied by the key projection once, and the
    value projection is applied to the single weighted sum. Gradients of the weights: one product
    over all steps (`RepeatedLinear`). `width` is D_z.
    """

    def __init__(self, width: int, config: TransformerConfig, max_objects: int):
        super().__init__()
        hidden = config.hidden
        self.heads = config.heads
        self.dropout = config.dropout
        self.start = nn.Parameter(torch.randn(width) / (1 if config.unit_start else width**0.5))
        self.encoder_qkv = nn.Linear(width, 3 * width)
        self.encoder_out = nn.Linear(width, width)
        self.encoder_norm = nn.LayerNorm(width)
        self.encoder_ff = FeedForward(width, hidden, config.dropout)
        self.decoder_query = nn.Linear(width, width)
        self.decoder_key = nn.Parameter(nn.Linear(width, width).weight.detach())
        self.decoder_value = nn.Linear(width, width)
        self.decoder_out = nn.Linear(width, width)
        self.decoder_norm = nn.LayerNorm(width)
        self.decoder_ff = FeedForward(width, hidden, config.dropout)
        self.encoder_end = nn.LayerNorm(width) if config.final_norm else nn.Identity()
        self.decoder_end = nn.LayerNorm(width) if config.final_norm else nn.Identity()
        self.query: nn.Module = nn.Identity()
        if config.query_self_attention:
            self.query = QuerySelfAttention(width, config.heads, config.dropout)
        self.output: nn.ModuleDict | None = None
        if config.step_mlps:  # the output of step k's MLP is x_k, which later steps read, too
            steps = [
                nn.Sequential(
                    nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
                )
                for _ in range(max_objects)
            ]
            self.output = nn.ModuleDict({"mlps": nn.ModuleList(steps)})

    def forward(
        self,
        z: Float[Tensor, "rooms width"],
        objects: int,
        needed: Int[Tensor, " rooms"] | None = None,
    ) -> Float[Tensor, "rooms objects width"]:
        """Generate `objects` features, starting from the start token x_0 (the empty room).

        `needed` is the number of features that each room needs; later features are meaningless.
        """
        if needed is not None and self.output is None:  # `step_mlps` are trained in every step
            # Sorted by need, so that rooms whose features are complete are dropped from the end.
            order = needed.argsort(descending=True)
            steps = torch.arange(objects, device=z.device)
            going_on = (needed[:, None] > steps).sum(dim=0).tolist()
            return self._unroll(z[order], going_on)[order.argsort()]
        return self._unroll(z, [len(z)] * objects)

    def _unroll(self, z: Tensor, rows: list[int]) -> Tensor:
        """Object features; step k computes only the first `rows[k]` rooms and leaves zeros
        elsewhere."""
        heads = self.heads
        encoder_qkv = repeated(self.encoder_qkv, rows)
        encoder_out = RepeatedLinear(
            self.encoder_out.weight.T.unflatten(0, (heads, -1)), None, rows
        )
        encoder_ff = self.encoder_ff.repeated([k * rooms for k, rooms in enumerate(rows, 1)])
        weight = self.decoder_value.weight.unflatten(0, (heads, -1)).transpose(1, 2)
        decoder_value = RepeatedLinear(weight, self.decoder_value.bias.view(heads, -1), rows)
        decoder_out, decoder_ff = repeated(self.decoder_out, rows), self.decoder_ff.repeated(rows)
        query, key_query = self.queries(z)
        newest = self.start.expand(len(z), -1)
        known: list[Tensor] = []
        features: list[Tensor] = []
        for step, rooms in enumerate(rows):
            query, key_query, newest, *known = (
                _first(each, rooms) for each in (query, key_query, newest, *known)
            )
            # The newest object as a token, (rooms, 1, width), and its query, key, and value times
            # the output projection, (rooms, heads, 1, *), are appended to those of the others.
            asks, key, value = encoder_qkv(newest).unflatten(-1, (3, heads, -1)).unbind(1)
            value = encoder_out(value.transpose(0, 1)).transpose(0, 1)
            added = [newest.unsqueeze(1), *(part.unsqueeze(2) for part in (asks, key, value))]
            if known:
                added = [torch.cat(both, dim=-2) for both in zip(known, added, strict=True)]
            known = added
            # Encoder layer: the scene context F_k. Attention is written out: on a dozen tokens
            # torch's fused CPU attention is slower.
            tokens, asks, key, value = known
            scores = asks @ key.transpose(-1, -2) / asks.shape[-1] ** 0.5
            shares = self._drop(scores.softmax(dim=-1)).transpose(1, 2).flatten(2)
            mixed = torch.baddbmm(self.encoder_out.bias, shares, value.flatten(1, 2))
            context = self.encoder_norm(tokens + self._drop(mixed))
            context = self.encoder_end(encoder_ff(context))
            # Decoder layer: z queries the context for the next object x_k.
            weights = self._drop((key_query @ context.transpose(1, 2)).softmax(dim=-1))
            mixed = decoder_value((weights @ context).transpose(0, 1)).transpose(0, 1).flatten(1)
            x = self.decoder_norm(query + self._drop(decoder_out(mixed)))
            newest = self.decoder_end(decoder_ff(x))
            if self.output is not None:
                newest = self.output.get_submodule(f"mlps.{step}")(newest)
            features.append(newest)
        return torch.stack([F.pad(x, (0, 0, 0, len(z) - len(x))) for x in features], dim=1)

    def queries(
        self, z: Float[Tensor, "rooms width"]
    ) -> tuple[Float[Tensor, "rooms width"], Float[Tensor, "rooms heads width"]]:
        """z as the query of every step, and each head's query multiplied by the key projection.

        Coordinates of a unit vector are about 1 / sqrt(width), far below the normalised features to
        which they are added, so z is scaled by sqrt(width). Without this scaling, the class loss
        falls far more slowly (git show 05a7b7d2:docs/experiments/2026-11-21-demo-settings.md). A
        bias of the key would add the same number to the scores of all tokens, which the softmax
        cancels.
        """
        query = self.query(z * z.shape[-1] ** 0.5)
        own = self.decoder_query(query).unflatten(-1, (self.heads, -1))
        key = self.decoder_key.unflatten(0, (self.heads, -1))
        return query, torch.einsum("rhd,hdw->rhw", own, key) / own.shape[-1] ** 0.5

    def _drop(self, x: Tensor) -> Tensor:
        return dropout(x, self.dropout if self.training else 0.0)


def _first(values: Tensor, rooms: int) -> Tensor:
    """`values[:rooms]`; `values` itself if it has no more rooms, since a slice copies the gradient
    in the backward pass."""
    return values if len(values) == rooms else values[:rooms]


class FeedForward(nn.Module):
    """MLP[hidden, width] with GELU, a residual connection and a layer norm (supplement A)."""

    def __init__(self, width: int, hidden: int, dropout: float):
        super().__init__()
        self.expand = nn.Linear(width, hidden)
        self.contract = nn.Linear(hidden, width)
        self.norm = nn.LayerNorm(width)
        self.dropout = dropout

    def repeated(self, rows: Sequence[int]) -> Layer:
        """This block as a function for several inputs in turn, whose numbers of rows are `rows`."""
        expand, contract = (repeated(layer, rows) for layer in (self.expand, self.contract))
        p = self.dropout if self.training else 0.0

        def forward(x: Tensor) -> Tensor:
            inner = dropout(F.gelu(expand(x)), p)
            return self.norm(x + dropout(contract(inner), p))

        return forward


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


def repeated(layer: nn.Linear, rows: Sequence[int]) -> Layer:
    """The layer as a function for several inputs in turn, whose numbers of rows are `rows`."""
    product = RepeatedLinear(layer.weight.T.unsqueeze(0), layer.bias.unsqueeze(0), rows)
    return lambda x: product(x.flatten(0, -2).unsqueeze(0)).view(*x.shape[:-1], layer.out_features)


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
