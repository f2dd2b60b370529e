"""The permutation-invariant transformer: object features x_k from z (section 3.2, Eq. 3 and 4)."""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.paper.layers import (
    DecoderConfig,
    QuerySelfAttention,
    RepeatedLinear,
    StepOutputs,
    dropout,
)

Layer = Callable[[Tensor], Tensor]


class TransformerConfig(DecoderConfig):
    """Size of the transformer (supplement A), and optional parts of the released code."""

    name: Literal["transformer"] = "transformer"
    heads: int = Field(4, ge=1)
    """Attention heads; must divide D_z."""
    hidden: int = Field(1024, ge=8)
    """Inner width of the feed-forward layers."""
    dropout: float = Field(0.1, ge=0, lt=1)
    """Dropout rate, applied at the same places as in the library that the paper builds on; 0.1 is
    that library's default."""
    final_norm: bool = False
    """Add a layer norm after the encoder layer and after the decoder layer, as in the released code
    (a default of the library that it builds on)."""
    query_self_attention: bool = False
    """Give the decoder layer self-attention over its single query z, as in the released code."""
    step_mlps: bool = False
    """End each step k with a separate two-layer MLP, as in the released code: 0.5 million weights
    per step at width 512. Features then depend on k."""

    def build(self, width: int, max_objects: int) -> "SceneTransformer":
        return SceneTransformer(width, self, max_objects)


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
        self.start = nn.Parameter(torch.randn(width) / width**0.5)
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
        self.output = StepOutputs(max_objects, width) if config.step_mlps else None

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

    def _unroll(self, z: Tensor, going_on: list[int]) -> Tensor:
        """Object features; step k computes only the first `going_on[k]` rooms and leaves zeros
        elsewhere."""
        read, encode = self._reader(going_on), self._encoder(going_on)
        decode = self._decoder(going_on)
        query = self._query(z)
        key_query = self._key_query(query)
        newest = self.start.expand(len(z), -1)
        known: list[Tensor] = []
        features: list[Tensor] = []
        for step, rooms in enumerate(going_on):
            query, key_query, newest, *known = (
                _first(each, rooms) for each in (query, key_query, newest, *known)
            )
            added = read(newest)
            if known:
                added = [torch.cat(both, dim=-2) for both in zip(known, added, strict=True)]
            known = added
            newest = decode(query, key_query, encode(*known))
            if self.output is not None:
                newest = self.output(newest, step)
            features.append(newest)
        return torch.stack([F.pad(x, (0, 0, 0, len(z) - len(x))) for x in features], dim=1)

    def _query(self, z: Tensor) -> Tensor:
        """(rooms, width): z as the query of every step.

        Coordinates of a unit vector are about 1 / sqrt(width), far below the normalised features to
        which they are added, so z is scaled by sqrt(width). Without this scaling, the class loss
        falls far more slowly (git show 05a7b7d2:docs/experiments/2026-11-21-demo-settings.md).
        """
        return self.query(z * z.shape[-1] ** 0.5)

    def _reader(self, rows: Sequence[int]) -> Callable[[Tensor], list[Tensor]]:
        """Make a function that encodes the newest object x_k as a token, (rooms, 1, width), and its
        queries, keys, and values times the output projection, (rooms, heads, 1, *)."""
        project = repeated(self.encoder_qkv, rows)
        output = self.encoder_out.weight.T.unflatten(0, (self.heads, -1))
        projected = RepeatedLinear(output, None, rows)

        def read(x: Tensor) -> list[Tensor]:
            query, key, value = project(x).unflatten(-1, (3, self.heads, -1)).unbind(1)
            value = projected(value.transpose(0, 1)).transpose(0, 1)
            return [x.unsqueeze(1), *(part.unsqueeze(2) for part in (query, key, value))]

        return read

    def _encoder(self, rows: Sequence[int]) -> Callable[..., Tensor]:
        """Make a function that maps all tokens of `_reader` to the scene context F_k."""
        feed_forward = self.encoder_ff.repeated([k * rooms for k, rooms in enumerate(rows, 1)])

        def encode(tokens: Tensor, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
            # Attention is written out: on a dozen tokens torch's fused CPU attention is slower.
            scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
            shares = self._drop(scores.softmax(dim=-1)).transpose(1, 2).flatten(2)
            mixed = torch.baddbmm(self.encoder_out.bias, shares, value.flatten(1, 2))
            context = self.encoder_norm(tokens + self._drop(mixed))
            return self.encoder_end(feed_forward(context))

        return encode

    def _decoder(self, rows: Sequence[int]) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        """Make a function that maps z's queries and the context F_k to the next object x_k."""
        value = self.decoder_value.weight.unflatten(0, (self.heads, -1)).transpose(1, 2)
        values = RepeatedLinear(value, self.decoder_value.bias.view(self.heads, -1), rows)
        out, feed_forward = repeated(self.decoder_out, rows), self.decoder_ff.repeated(rows)

        def decode(z_query: Tensor, key_query: Tensor, context: Tensor) -> Tensor:
            weights = self._drop((key_query @ context.transpose(1, 2)).softmax(dim=-1))
            mixed = values((weights @ context).transpose(0, 1)).transpose(0, 1).flatten(1)
            x = z_query + self._drop(out(mixed))
            return self.decoder_end(feed_forward(self.decoder_norm(x)))

        return decode

    def _key_query(self, z_query: Tensor) -> Tensor:
        """(rooms, heads, width): each head's query from z, multiplied by the key projection.

        A bias of the key would add the same number to the scores of all tokens, which the softmax
        cancels.
        """
        query = self.decoder_query(z_query).unflatten(-1, (self.heads, -1))
        key = self.decoder_key.unflatten(0, (self.heads, -1))
        return torch.einsum("rhd,hdw->rhw", query, key) / query.shape[-1] ** 0.5

    def _drop(self, x: Tensor) -> Tensor:
        return dropout(x, self.dropout if self.training else 0.0)


def _first(values: Tensor, rooms: int) -> Tensor:
    """`values[:rooms]`; `values` itself if it has no more rooms, since a slice copies the gradient
    in the backward pass."""
    return values if len(values) == rooms else values[:rooms]


def repeated(layer: nn.Linear, rows: Sequence[int]) -> Layer:
    """The layer as a function for several inputs in turn, whose numbers of rows are `rows`."""
    product = RepeatedLinear(layer.weight.T.unsqueeze(0), layer.bias.unsqueeze(0), rows)
    return lambda x: product(x.flatten(0, -2).unsqueeze(0)).view(*x.shape[:-1], layer.out_features)
