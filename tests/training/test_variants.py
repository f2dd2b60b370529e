"""Ablations and released-code variants: each trains, resumes, is decoded and is sampled."""

import shutil

import pytest
import torch
from interrupting import CPU, interrupted
from tiny_runs import tiny_config, tiny_lifted

from sceneprior.apps.api import load
from sceneprior.apps.decoders import AnyPaperModel
from sceneprior.apps.experiments.report import (
    UNFOLDING_STEPS,
    read_curves,
    unfold,
)
from sceneprior.apps.sample import sample_rooms
from sceneprior.lifted.lifting import dataset as lifted
from sceneprior.paper.sampling import DISTRIBUTIONS, decode_training_rooms
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint

RELEASED = {
    "model__decoder__hidden": 16,
    "model__decoder__final_norm": True,
    "model__decoder__unit_start": True,
    "model__decoder__query_self_attention": True,
    "model__decoder__step_mlps": True,
    "model__layout_heads": "separate",
    "model__completeness_target": "stop",
    "loss__passing_masks_only": True,
    "layout__keep": "lowest",
    "shape__latent_epochs": 1,
}
VARIANTS = {
    "uniform_one_stage": {  # c1 and c3
        "model__latent_space": {"name": "cube"},
        "layout": None,
        "shape__latent_noise": 0.1,
    },
    "lstm_beveled_box": {  # c2
        "model__decoder": {"name": "lstm"},
        "layout__proxy": "beveled_box",
        "shape__box_from": "proxy",
        "shape__proxy": "beveled_box",
    },
    "released": RELEASED,
    "lifted": {"loss__latents": 1.0, "model__latent_space": {"name": "cube"}},
}


@pytest.fixture(scope="module", params=VARIANTS)
def variant(request, toy_shards, tmp_path_factory):
    """Config and a finished run."""
    changes = VARIANTS[request.param]
    if request.param == "lifted":
        config = tiny_lifted(toy_shards, shape__epochs=6, **changes)
    else:
        epochs = {} if "layout" in changes else {"layout__epochs": 3}
        config = tiny_config(toy_shards, shape__epochs=3, **epochs, **changes)
    run = tmp_path_factory.mktemp(request.param) / "run"
    fit(config, run, trainer_options=CPU)
    return config, run


def test_a_variant_learns_and_is_decoded_sampled_and_interpolated(variant):
    config, run = variant
    curves = read_curves(run)
    assert [k.split("/")[0] for k in curves if k.endswith("/loss")] == (list(config.stage_names))
    losses = [value for _, value in curves[f"{config.stage_names[0]}/loss"]]
    assert losses[-1] < losses[0]
    trained = load(run).with_latents
    assert trained.stage == "shape" and trained.config == config
    layout = getattr(config, "layout", None)
    learnt = layout is not None and layout.proxy == "beveled_box"
    moved = (trained.prior.bevels.logits != -2).any(dim=1)
    assert moved.any() if learnt else not moved.any()
    assert trained.logits.shape == (12, config.model.logits_per_room)
    rooms = decode_training_rooms(trained)
    assert [room.name for room in rooms] == list(trained.room_ids)
    for distribution in DISTRIBUTIONS:
        one, other = (sample_rooms(trained, 4, 0, distribution) for _ in range(2))
        assert [s.centers_m.tolist() for s in one] == [s.centers_m.tolist() for s in other]
    steps = unfold(trained)
    assert len(steps) == UNFOLDING_STEPS
    assert [item.label for item in steps[0].objects] == [item.label for item in rooms[0].objects]


def test_a_stopped_variant_resumes_to_the_same_weights(variant, tmp_path, monkeypatch):
    config, whole = variant
    found = lifted.choose_prototypes
    run = shutil.copytree(whole, tmp_path / "run")
    shutil.rmtree(run / "shape")
    interrupted(config, run, "shape", 1, resume=True)
    assert not (run / "shape" / "final.ckpt").exists()
    # Another processor finds prototypes in another order; the checkpoint's are taken.
    monkeypatch.setattr(
        lifted,
        "choose_prototypes",
        lambda *given: tuple(part[::-1].copy() for part in found(*given)),
    )
    fit(config, run, resume=True, trainer_options=CPU)
    wanted = read_checkpoint(whole / "shape" / "final.ckpt")["state_dict"]
    reached = read_checkpoint(run / "shape" / "final.ckpt")["state_dict"]
    assert wanted.keys() == reached.keys()
    for name, value in wanted.items():
        assert torch.equal(reached[name], value), name


@pytest.mark.parametrize(
    ("changes", "millions"),
    [
        ({}, 6.928),
        ({"decoder": {"name": "lstm"}}, 4.824),
        ({"decoder": {"name": "transformer", "hidden": 512, "final_norm": True,
                      "query_self_attention": True, "step_mlps": True},
          "layout_heads": "separate"}, 18.549),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)  # fmt: skip
def test_docs_and_weights_count_alike(changes, millions):
    """The table of docs/paper_map.md: weights at the paper's size, bedrooms."""
    from sceneprior.paper.prior import ScenePrior

    plain = {"max_objects": 13, "decoder": {"name": "transformer"}, "shape": {"level": 0}}
    prior = ScenePrior(AnyPaperModel.model_validate(plain | changes), classes=22)
    count = sum(p.numel() for p in prior.parameters())
    assert count / 1e6 == pytest.approx(millions, abs=0.0005)
