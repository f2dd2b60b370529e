"""The released code's parts: each against torch's own layers or the definition."""

import torch
from references.scene_decoder import next_object
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.paper.decoders import SeparateHeads
from sceneprior.paper.transformer import SceneTransformer, TransformerConfig


def shaken(model: nn.Module) -> nn.Module:
    """Weights, biases and norms as different from their start as after training."""
    torch.manual_seed(5)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    return model.double().eval()


def released_decoder(width=24, steps=7) -> SceneTransformer:
    parts = TransformerConfig(
        heads=3, hidden=40, final_norm=True, query_self_attention=True, step_mlps=True
    )
    torch.manual_seed(0)
    return shaken(SceneTransformer(width, parts, steps))


def points(torch_rng, rooms=3, width=24) -> torch.Tensor:
    return F.normalize(torch.randn(rooms, width, generator=torch_rng, dtype=torch.float64), dim=-1)


def test_a_step_is_torchs_encoder_and_decoder_layer_their_norms_and_the_steps_mlp(torch_rng):
    """The released network as torch.nn builds it, with our weights."""
    model, width = released_decoder(), 24
    torch.manual_seed(1)
    shape = {"dim_feedforward": 40, "activation": "gelu", "batch_first": True}
    encoder = nn.TransformerEncoderLayer(width, 3, **shape).double().eval()
    decoder = nn.TransformerDecoderLayer(width, 3, **shape).double().eval()
    query, key, value = model.decoder_query, model.decoder_key, model.decoder_value
    own = model.query
    with torch.no_grad():
        for theirs, ours in (
            (encoder.self_attn.in_proj_weight, model.encoder_qkv.weight),
            (encoder.self_attn.in_proj_bias, model.encoder_qkv.bias),
            (decoder.self_attn.in_proj_weight[2 * width :], own.value.weight),
            (decoder.self_attn.in_proj_bias[2 * width :], own.value.bias),
            (decoder.multihead_attn.in_proj_weight, torch.cat([query.weight, key, value.weight])),
            (
                decoder.multihead_attn.in_proj_bias,
                torch.cat([query.bias, torch.ones(width).double(), value.bias]),
            ),
        ):
            theirs.copy_(ours)
        for theirs, ours in (
            (encoder.self_attn.out_proj, model.encoder_out),
            (encoder.linear1, model.encoder_ff.expand),
            (encoder.linear2, model.encoder_ff.contract),
            (encoder.norm1, model.encoder_norm),
            (encoder.norm2, model.encoder_ff.norm),
            (decoder.self_attn.out_proj, own.out),
            (decoder.multihead_attn.out_proj, model.decoder_out),
            (decoder.linear1, model.decoder_ff.expand),
            (decoder.linear2, model.decoder_ff.contract),
            (decoder.norm1, own.norm),
            (decoder.norm2, model.decoder_norm),
            (decoder.norm3, model.decoder_ff.norm),
        ):
            theirs.load_state_dict(ours.state_dict())
        z = points(torch_rng)
        previous = torch.randn(3, 4, width, generator=torch_rng, dtype=torch.float64)
        tokens = torch.cat([model.start.expand(3, 1, -1), previous], dim=1)
        context = model.encoder_end(encoder(tokens))
        answer = model.decoder_end(decoder((z * width**0.5)[:, None], context))[:, 0]
        wanted = model.output.mlps[4](answer)
        assert_close(next_object(model, z, previous), wanted, rtol=0, atol=1e-12)
        assert (answer - wanted).abs().max() > 0.1


def test_unrolling_feeds_each_steps_output_back_and_order_still_does_not_matter(torch_rng):
    model = released_decoder()
    z = points(torch_rng)
    unrolled = model(z, 7)
    features = z.new_zeros(3, 0, 24)
    for _ in range(7):
        newest = next_object(model, z, features)
        features = torch.cat([features, newest.unsqueeze(1)], dim=1)
    assert_close(unrolled, features, rtol=0, atol=1e-11)
    shuffled = next_object(model, z, features[:, [3, 0, 5, 1, 4, 2]])
    assert_close(shuffled, unrolled[:, 6], rtol=0, atol=1e-11)


def test_every_weight_of_the_released_decoder_has_a_gradient():
    model = released_decoder(width=12, steps=3)
    z = F.normalize(torch.randn(2, 12, dtype=torch.float64), dim=-1)
    model(z, 3).pow(3).sum().backward()
    assert [n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_separate_heads_give_each_coordinate_an_mlp(torch_rng):
    model = shaken(SeparateHeads(8, 4))
    shared = torch.randn(2, 3, 8, generator=torch_rng, dtype=torch.float64)
    out = model(shared)
    assert out.shape == (2, 3, 11)
    for room in range(2):
        for item in range(3):
            x = shared[room, item].clamp(min=0)
            wanted = [*(model.classes.weight @ x + model.classes.bias)]
            for first, _, last in model.coordinates:
                hidden = (first.weight @ x + first.bias).clamp(min=0)
                wanted.append(last.weight[0] @ hidden + last.bias[0])
            wanted.append(model.completeness.weight[0] @ x + model.completeness.bias[0])
            assert_close(out[room, item], torch.stack(wanted), rtol=0, atol=1e-12)
