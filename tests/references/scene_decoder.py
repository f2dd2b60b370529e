"""The transformer in plain layers, and one room, one token and one head at a time, as in the
supplement."""

import math

import torch
from torch.nn import functional as F

from sceneprior.paper.transformer import dropout


def unroll(model, z, objects):
    """The features of a SceneTransformer in evaluation or training, where it draws the same zeros.

    Each step uses `torch.nn`'s layers, so autograd adds up the gradients of their weights.
    """
    query, key_query = model.queries(z)
    tokens = model.start.expand(len(z), 1, -1)
    qkv = _split(model, model.encoder_qkv(tokens))
    features = []
    for _ in range(objects):
        if features:
            newest = features[-1].unsqueeze(1)
            tokens = torch.cat([tokens, newest], dim=1)
            added = _split(model, model.encoder_qkv(newest))
            qkv = [torch.cat(both, dim=2) for both in zip(qkv, added, strict=True)]
        features.append(_next(model, query, key_query, tokens, qkv))
    return torch.stack(features, dim=1)


def next_object(model, z, previous):
    """The feature that a SceneTransformer says follows a set of objects, in whatever order."""
    tokens = torch.cat([model.start.expand(len(z), 1, -1), previous], dim=1)
    qkv = _split(model, model.encoder_qkv(tokens))
    return _next(model, *model.queries(z), tokens, qkv)


def _next(model, z_query, key_query, tokens, qkv):
    query, key, value = qkv
    scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
    mixed = (_drop(model, scores.softmax(dim=-1)) @ value).transpose(1, 2).flatten(2)
    context = model.encoder_norm(tokens + _drop(model, model.encoder_out(mixed)))
    context = model.encoder_end(_feed_forward(model.encoder_ff, context))
    weights = _drop(model, (key_query @ context.transpose(1, 2)).softmax(dim=-1))
    summed = (weights @ context).transpose(0, 1)
    value = model.decoder_value.weight.unflatten(0, (model.heads, -1)).transpose(1, 2)
    bias = model.decoder_value.bias.view(model.heads, 1, -1)
    mixed = torch.baddbmm(bias, summed, value).transpose(0, 1).flatten(1)
    x = model.decoder_norm(z_query + _drop(model, model.decoder_out(mixed)))
    x = model.decoder_end(_feed_forward(model.decoder_ff, x))
    return x if model.output is None else model.output.mlps[tokens.shape[1] - 1](x)


def _feed_forward(layer, x):
    inner = _drop(layer, F.gelu(layer.expand(x)))
    return layer.norm(x + _drop(layer, layer.contract(inner)))


def _drop(layer, x):
    return dropout(x, layer.dropout if layer.training else 0.0)


def _split(model, packed):
    shape = (*packed.shape[:2], 3, model.heads, packed.shape[-1] // 3 // model.heads)
    return list(packed.reshape(shape).permute(2, 0, 3, 1, 4).unbind(0))


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
