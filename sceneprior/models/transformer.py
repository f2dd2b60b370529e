"""A latent in, a sequence of object features out: the permutation-invariant transformer (3.2)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.models.released import QuerySelfAttention, SharedOutput, StepOutputs


class FeedForward(nn.Module):
    """MLP[hidden, width] with GELU, the residual and the norm around it (supplement A)."""

    def __init__(self, width: int, hidden: int, dropout: float):
        super().__init__()
        self.expand = nn.Linear(width, hidden)
        self.contract = nn.Linear(hidden, width)
        self.norm = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Float[Tensor, "*batch width"]) -> Float[Tensor, "*batch width"]:
        inner = self.dropout(F.gelu(self.expand(x)))
        return self.norm(x + self.dropout(self.contract(inner)))


class SceneDecoder(nn.Module):
    """Generate N object features, each from z and the unordered set of those before it.

    Per step k: one encoder layer (self attention among x_0 .. x_{k-1}, no positional
    encoding) gives the scene context F_k; one decoder layer asks it with z as the query. Both
    layers normalise after the residual, as the library does that the paper builds on.

    In the encoder, an object's query, key and value never change once it is there: each is
    computed once and appended, and only the attention is taken anew, since old objects see
    new ones. In the decoder there is one query, z, for all steps: instead of projecting every
    context token to a key and a value, z's query is carried through the key projection once,
    and the value projection is applied to the one weighted sum. Both are exact.

    Args:
        width: D_z, the size of z and of every object feature.
        heads: Attention heads; must divide `width`.
        hidden: Inner width of the feed-forward layers (paper: 1,024 for a width of 512).
        dropout: Applied where the library applies it; 0.1 is its default.
        final_norm: Normalise once more after each of the two layers (the library's default).
        query_self_attention: Let z attend to itself before it asks (released code).
        step_outputs: N gives each of N steps an MLP of its own (released code); 0 gives none.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        hidden: int,
        dropout: float,
        final_norm: bool = False,
        query_self_attention: bool = False,
        step_outputs: int = 0,
    ):
        super().__init__()
        self.heads = heads
        self.dropout = dropout
        self.start = nn.Parameter(torch.randn(width) / width**0.5)
        self.encoder_qkv = nn.Linear(width, 3 * width)
        self.encoder_out = nn.Linear(width, width)
        self.encoder_norm = nn.LayerNorm(width)
        self.encoder_ff = FeedForward(width, hidden, dropout)
        self.decoder_query = nn.Linear(width, width)
        self.decoder_key = nn.Parameter(nn.Linear(width, width).weight.detach())
        self.decoder_value = nn.Linear(width, width)
        self.decoder_out = nn.Linear(width, width)
        self.decoder_norm = nn.LayerNorm(width)
        self.decoder_ff = FeedForward(width, hidden, dropout)
        self.encoder_end = nn.LayerNorm(width) if final_norm else nn.Identity()
        self.decoder_end = nn.LayerNorm(width) if final_norm else nn.Identity()
        self.query = (
            QuerySelfAttention(width, heads, dropout) if query_self_attention else nn.Identity()
        )
        self.output = StepOutputs(step_outputs, width) if step_outputs else SharedOutput()

    def forward(
        self, z: Float[Tensor, "rooms width"], objects: int
    ) -> Float[Tensor, "rooms objects width"]:
        """Unroll `objects` steps from the start token (the empty room)."""
        wish = self._wish(z)
        tokens = self.start.expand(len(z), 1, -1)
        qkv = self._split(self.encoder_qkv(tokens))
        question = self._question(wish)
        features: list[Tensor] = []
        for step in range(objects):
            features.append(self._next(wish, question, tokens, qkv))
            if step + 1 < objects:
                newest = features[-1].unsqueeze(1)
                tokens = torch.cat([tokens, newest], dim=1)
                added = self._split(self.encoder_qkv(newest))
                qkv = [torch.cat(pair, dim=2) for pair in zip(qkv, added, strict=True)]
        return torch.stack(features, dim=1)

    def next_object(
        self,
        z: Float[Tensor, "rooms width"],
        previous: Float[Tensor, "rooms objects width"],
    ) -> Float[Tensor, "rooms width"]:
        """The feature that follows a set of objects, in whatever order they are given."""
        wish = self._wish(z)
        tokens = torch.cat([self.start.expand(len(z), 1, -1), previous], dim=1)
        qkv = self._split(self.encoder_qkv(tokens))
        return self._next(wish, self._question(wish), tokens, qkv)

    def _wish(self, z: Tensor) -> Tensor:
        """(rooms, width): z as the query of every step.

        Coordinates of a unit vector are about 1 / sqrt(width), far below the normalised
        features they are added to; scaled to about 1 they are heard. Without it the
        class loss falls far more slowly (docs/results.md).
        """
        return self.query(z * z.shape[-1] ** 0.5)

    def _next(self, wish: Tensor, question: Tensor, tokens: Tensor, qkv: list[Tensor]) -> Tensor:
        query, key, value = qkv
        # Written out: on a dozen tokens torch's fused CPU attention is slower.
        scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
        mixed = (self._drop(scores.softmax(dim=-1)) @ value).transpose(1, 2).flatten(2)
        context = self.encoder_norm(tokens + self._drop(self.encoder_out(mixed)))
        context = self.encoder_end(self.encoder_ff(context))
        answer = wish + self._drop(self.decoder_out(self._ask(question, context)))
        answer = self.decoder_end(self.decoder_ff(self.decoder_norm(answer)))
        return self.output(answer, step=tokens.shape[1] - 1)

    def _question(self, wish: Tensor) -> Tensor:
        """(rooms, heads, width): z's query of each head, carried through the key projection.

        The key's bias would add the same to every token's score, which a softmax does not see.
        """
        query = self.decoder_query(wish).unflatten(-1, (self.heads, -1))
        key = self.decoder_key.unflatten(0, (self.heads, -1))
        return torch.einsum("rhd,hdw->rhw", query, key) / query.shape[-1] ** 0.5

    def _ask(self, question: Tensor, context: Tensor) -> Tensor:
        """(rooms, width): the values of the context, weighted per head by its answer to z."""
        weights = self._drop((question @ context.transpose(1, 2)).softmax(dim=-1))
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
        return F.dropout(x, self.dropout, self.training)
