"""The transformer one room, one token and one head at a time: as the supplement describes it."""

import math

import torch


def next_object(model, z, previous):
    """The feature that a SceneTransformer says follows a set of objects, in whatever order."""
    query = model._query(z)
    tokens = torch.cat([model.start.expand(len(z), 1, -1), previous], dim=1)
    qkv = model._split(model.encoder_qkv(tokens))
    return model._next(query, model._key_query(query), tokens, qkv)


def next_object_loop(decoder, z, previous, key_bias):
    """`next_object` in float64; `key_bias` is any (width,) bias of its keys.

    Args:
        decoder: A SceneTransformer in evaluation mode, in float64.
        z: (rooms, width), points on the unit sphere.
        previous: (rooms, objects, width).
        key_bias: Attention does not see it.
    """
    width = z.shape[1]
    query_w, key_w, value_w = decoder.encoder_qkv.weight.split(width)
    query_b, key_b, value_b = decoder.encoder_qkv.bias.split(width)
    answers = []
    for room in range(len(z)):
        wish = z[room] * math.sqrt(width)
        tokens = [decoder.start, *previous[room]]
        context = []
        for token in tokens:
            mixed = attend(
                query_w @ token + query_b,
                [key_w @ other + key_b for other in tokens],
                [value_w @ other + value_b for other in tokens],
                decoder.heads,
            )
            out = decoder.encoder_out.weight @ mixed + decoder.encoder_out.bias
            x = normalise(token + out, decoder.encoder_norm)
            context.append(feed_forward(x, decoder.encoder_ff))
        value = decoder.decoder_value
        mixed = attend(
            decoder.decoder_query.weight @ wish + decoder.decoder_query.bias,
            [decoder.decoder_key @ token + key_bias for token in context],
            [value.weight @ token + value.bias for token in context],
            decoder.heads,
        )
        out = decoder.decoder_out.weight @ mixed + decoder.decoder_out.bias
        x = normalise(wish + out, decoder.decoder_norm)
        answers.append(feed_forward(x, decoder.decoder_ff))
    return torch.stack(answers)


def attend(query, keys, values, heads):
    size = len(query) // heads
    parts = []
    for head in range(heads):
        part = slice(head * size, (head + 1) * size)
        scores = [float(query[part] @ key[part]) / math.sqrt(size) for key in keys]
        shares = [math.exp(score - max(scores)) for score in scores]
        mixed = torch.zeros(size, dtype=query.dtype)
        for share, value in zip(shares, values, strict=True):
            mixed = mixed + share / sum(shares) * value[part]
        parts.append(mixed)
    return torch.cat(parts)


def normalise(x, norm):
    centred = x - x.mean()
    return centred / torch.sqrt((centred**2).mean() + norm.eps) * norm.weight + norm.bias


def feed_forward(x, layer):
    inner = layer.expand.weight @ x + layer.expand.bias
    inner = inner * 0.5 * (1 + torch.erf(inner / math.sqrt(2)))  # GELU
    return normalise(x + layer.contract.weight @ inner + layer.contract.bias, layer.norm)
