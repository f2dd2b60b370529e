"""The permutation-invariant transformer: object features x_k from z (section 3.2, Eq. 3 and 4)."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.paper.layers import DecoderConfig, dropout
from sceneprior.paper.released import QuerySelfAttention, StepOutputs


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
    """End each step k with a two-layer MLP of its own, as in the released code: 0.5 million weights
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

    def forward(self, x: Float[Tensor, "*batch width"]) -> Float[Tensor, "*batch width"]:
        p = self.dropout if self.training else 0.0
        inner = dropout(F.gelu(self.expand(x)), p)
        return self.norm(x + dropout(self.contract(inner), p))


class SceneTransformer(nn.Module):
    """Generate N object features x_k, each from z and the unordered set of the previous ones.

        P(x_1, ..., x_N | z) = P(x_1 | z) prod_k P(x_k | {x_1, ..., x_(k-1)}; z)    (Eq. 3)

    The order of x_1, ..., x_(k-1) does not matter, for any permutations p and q of them:

        P(x_k | x_p1, ..., x_p(k-1); z) = P(x_k | x_q1, ..., x_q(k-1); z)           (Eq. 4)

    Step k: one encoder layer (self-attention among x_0 .. x_(k-1), no positional encoding) gives
    the scene context F_k; one decoder layer attends to it with z as the query. Both layers apply
    the norm after the residual connection, as in the library that the paper builds on.

    Two shortcuts save time and are exact. Encoder: an object's query, key and value do not change,
    so each is computed once and appended; only the attention is recomputed in each step, since
    earlier objects also attend to later ones. Decoder: all steps share the one query z, so instead
    of projecting every context token to a key and a value, z's query is multiplied by the key
    projection once, and the value projection is applied to the single weighted sum. `width` is D_z.
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
        query = self._query(z)
        tokens = self.start.expand(len(z), 1, -1)
        qkv = self._split(self.encoder_qkv(tokens))
        key_query = self._key_query(query)
        features: list[Tensor] = []
        for rooms in going_on:
            query, key_query, tokens = (_first(each, rooms) for each in (query, key_query, tokens))
            qkv = [_first(part, rooms) for part in qkv]
            if features:
                newest = _first(features[-1], rooms).unsqueeze(1)
                tokens = torch.cat([tokens, newest], dim=1)
                added = self._split(self.encoder_qkv(newest))
                qkv = [torch.cat(both, dim=2) for both in zip(qkv, added, strict=True)]
            features.append(self._next(query, key_query, tokens, qkv))
        return torch.stack([F.pad(x, (0, 0, 0, len(z) - len(x))) for x in features], dim=1)

    def _query(self, z: Tensor) -> Tensor:
        """(rooms, width): z as the query of every step.

        Coordinates of a unit vector are about 1 / sqrt(width), far below the normalised features to
        which they are added, so z is scaled by sqrt(width). Without this scaling, the class loss
        falls far more slowly (docs/experiments/2026-11-21-demo-settings.md).
        """
        return self.query(z * z.shape[-1] ** 0.5)

    def _next(
        self, z_query: Tensor, key_query: Tensor, tokens: Tensor, qkv: list[Tensor]
    ) -> Tensor:
        query, key, value = qkv
        # Attention is written out: on a dozen tokens torch's fused CPU attention is slower.
        scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
        mixed = (self._drop(scores.softmax(dim=-1)) @ value).transpose(1, 2).flatten(2)
        context = self.encoder_norm(tokens + self._drop(self.encoder_out(mixed)))
        context = self.encoder_end(self.encoder_ff(context))
        x = z_query + self._drop(self.decoder_out(self._cross_attend(key_query, context)))
        x = self.decoder_end(self.decoder_ff(self.decoder_norm(x)))
        return x if self.output is None else self.output(x, step=tokens.shape[1] - 1)

    def _key_query(self, z_query: Tensor) -> Tensor:
        """(rooms, heads, width): each head's query from z, multiplied by the key projection.

        A bias of the key would add the same number to the scores of all tokens, which the softmax
        cancels.
        """
        query = self.decoder_query(z_query).unflatten(-1, (self.heads, -1))
        key = self.decoder_key.unflatten(0, (self.heads, -1))
        return torch.einsum("rhd,hdw->rhw", query, key) / query.shape[-1] ** 0.5

    def _cross_attend(self, key_query: Tensor, context: Tensor) -> Tensor:
        """(rooms, width): the values of the context F_k, weighted per head by z's attention."""
        weights = self._drop((key_query @ context.transpose(1, 2)).softmax(dim=-1))
        summed = (weights @ context).transpose(0, 1)
        value = self.decoder_value.weight.unflatten(0, (self.heads, -1))
        values = torch.baddbmm(
            self.decoder_value.bias.view(self.heads, 1, -1), summed, value.transpose(1, 2)
        )
        return values.transpose(0, 1).flatten(1)

    def _split(self, packed: Tensor) -> list[Tensor]:
        shape = (*packed.shape[:2], 3, self.heads, packed.shape[-1] // 3 // self.heads)
        return list(packed.reshape(shape).permute(2, 0, 3, 1, 4).unbind(0))

    def _drop(self, x: Tensor) -> Tensor:
        return dropout(x, self.dropout if self.training else 0.0)


def _first(values: Tensor, rooms: int) -> Tensor:
    """`values[:rooms]`; `values` itself if it has no more rooms, since a slice copies the gradient
    in the backward pass."""
    return values if len(values) == rooms else values[:rooms]
