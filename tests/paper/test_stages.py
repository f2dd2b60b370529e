"""The paper's stages: which rate of Adam trains what, and when it falls; the released code's epochs
of latents alone, and its weights of the lowest loss."""

import csv

import pytest
import torch
from interrupting import CPU, interrupted
from tiny_runs import tiny_config

from sceneprior.paper.stages import LayoutStage, ShapeStage
from sceneprior.training import callbacks
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint


def test_adam_has_a_rate_for_each_part_and_all_fall_tenfold_at_the_milestone(tmp_path):
    rates = {"learning_rate": 1e-4, "latent_learning_rate": 3e-4}
    rates["schedule"] = {"name": "steps", "milestones": [3], "decay": 0.1}
    config = tiny_config(tmp_path, **{f"layout__{key}": value for key, value in rates.items()})
    prior, latents = config.build_prior(), config.build_latents(2)
    stage = LayoutStage(config, config.layout, prior, latents)
    of = stage.configure_optimizers()
    groups, schedule = of["optimizer"].param_groups, of["lr_scheduler"]
    assert type(of["optimizer"]) is torch.optim.Adam
    assert {(group["betas"], group["weight_decay"]) for group in groups} == {((0.9, 0.999), 0)}
    seen = []
    for _ in range(4):
        seen.append([group["lr"] for group in groups])
        of["optimizer"].step()
        schedule.step()
    first = [1e-4, config.layout.shape_rate, 3e-4]
    assert seen[:3] == [first] * 3
    assert seen[3] == pytest.approx([rate / 10 for rate in first], rel=1e-12)
    trained = {id(p) for group in groups for p in group["params"] if p.requires_grad}
    shape = {id(p) for p in prior.shape.parameters()}
    assert id(latents.weight) in {id(p) for p in groups[2]["params"]}
    assert not trained & shape, "layouts are trained without decoding shapes"
    assert trained | shape >= {id(p) for p in (*prior.decoder.parameters(), latents.weight)}
    ShapeStage(config, config.shape, prior, latents)
    assert all(p.requires_grad for p in prior.shape.parameters())


def trained(config, run):
    """The weights that the layout stage ends with, and the loss of each epoch."""
    fit(config, run, trainer_options=CPU, loggers=("csv",), resume=run.exists())
    with (run / "layout" / "metrics.csv").open(newline="") as file:
        losses = [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]
    return read_checkpoint(run / "layout" / "final.ckpt")["state_dict"], losses


def test_the_last_epochs_train_the_latents_alone(toy_shards, tmp_path):
    few = {"layout__epochs": 2, "shape__epochs": 1}
    before, _ = trained(tiny_config(toy_shards, **few), tmp_path / "before")
    few |= {"layout__epochs": 4, "layout__latent_epochs": 2}
    after, _ = trained(tiny_config(toy_shards, **few), tmp_path / "after")
    changed = [name for name in before if not torch.equal(before[name], after[name])]
    assert changed == ["latents.weight"]


def test_the_weights_of_the_lowest_loss_are_kept_over_a_stop(toy_shards, tmp_path):
    """With too high a rate, the loss of the last epoch is not the lowest."""
    few = {"layout__learning_rate": 0.3, "layout__epochs": 5, "shape__epochs": 1}
    config = tiny_config(toy_shards, **few, layout__keep="lowest")
    interrupted(config, tmp_path / "kept", "layout", 4)
    kept, losses = trained(config, tmp_path / "kept")
    best = losses.index(min(losses))
    assert len(losses) == 5 and best < 4
    plain, _ = trained(
        tiny_config(toy_shards, **few | {"layout__epochs": best + 1}), tmp_path / "plain"
    )
    assert all(torch.equal(kept[name], plain[name]) for name in plain)


def test_a_run_stopped_between_two_checkpoints_keeps_the_lowest_loss_too(
    toy_shards, tmp_path, monkeypatch
):
    few = {"layout__learning_rate": 0.3, "layout__epochs": 5, "shape__epochs": 1}
    config, copies = tiny_config(toy_shards, **few, layout__keep="lowest"), []
    whole, losses = trained(config, tmp_path / "whole")
    falls = sum(loss < min(losses[:row], default=1e9) for row, loss in enumerate(losses))
    copy = callbacks.copy_checkpoint

    def stopped(*given):
        copies.append(given)
        if len(copies) == falls:
            raise KeyboardInterrupt
        copy(*given)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(callbacks, "copy_checkpoint", stopped)
        fit(config, tmp_path / "run", trainer_options=CPU)
    kept, _ = trained(config, tmp_path / "run")
    assert all(torch.equal(kept[name], whole[name]) for name in whole)
