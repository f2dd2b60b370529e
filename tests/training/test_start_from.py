"""Training a stage longer, and starting from another run's weights."""

import shutil
from pathlib import Path

import pytest
import torch
from interrupting import CPU
from refusals import refused
from tiny_runs import tiny_config

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputWarning
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint
from sceneprior.training.start_from import start_from

COSINE = {"layout__schedule": {"name": "cosine"}, "shape__epochs": 1}


@pytest.fixture(scope="module")
def short_run(toy_shards, tmp_path_factory) -> Path:
    """A run whose layout stage is finished, and whose shape stage has not begun."""
    run = tmp_path_factory.mktemp("short") / "run"
    fit(tiny_config(toy_shards, layout__epochs=2, **COSINE), run, False, ("csv",), CPU)
    shutil.rmtree(run / "shape")
    return run


def test_a_finished_stage_trains_longer(toy_shards, short_run, tmp_path):
    run = shutil.copytree(short_run, tmp_path / "run")
    longer = tiny_config(toy_shards, layout__epochs=4, trainer={"benchmark": False}, **COSINE)
    with pytest.warns(InputWarning, match="cosine schedule is stretched"):
        fit(longer, run, True, ("csv",), CPU)
    before, after = (read_checkpoint(each / "layout" / "final.ckpt") for each in (short_run, run))
    assert (before["epoch"], after["epoch"], after["global_step"]) == (2, 4, 12)
    (schedule,) = after["lr_schedulers"]
    assert schedule["total_steps"] == 13 and schedule["_last_lr"][0] < 1e-6
    assert (run / "shape" / "final.ckpt").is_file()
    with refused("training/longer too late", tmp=tmp_path):
        fit(tiny_config(toy_shards, layout__epochs=5, **COSINE), run, True, (), CPU)
    with refused("training/shorter", tmp=tmp_path):
        fit(tiny_config(toy_shards, layout__epochs=1, **COSINE), run, True, (), CPU)
    with refused("training/other settings named", tmp=tmp_path):
        fit(tiny_config(toy_shards, layout__epochs=4, seed=4, **COSINE), run, True, (), CPU)


def test_a_run_starts_from_the_weights_of_another(toy_shards, short_run, tmp_path):
    start = read_checkpoint(short_run / "layout" / "final.ckpt")["state_dict"]
    config = tiny_config(
        toy_shards, init_from=str(short_run), layout__epochs=1, layout__learning_rate=1e-9,
        layout__latent_learning_rate=1e-9, shape__epochs=1,
    )  # fmt: skip
    fit(config, tmp_path / "run", False, (), CPU)
    reached = read_checkpoint(tmp_path / "run" / "layout" / "final.ckpt")["state_dict"]
    assert all(torch.allclose(start[name], reached[name], atol=1e-6) for name in start)


@pytest.mark.parametrize("heads", ["joint", "separate"])
def test_classes_are_found_by_name_and_latents_by_room(toy_shards, tmp_path, heads):
    config = tiny_config(toy_shards, model__layout_heads=heads)
    path, mine = tmp_path / "one.ckpt", "void,armchair,chair,throne"
    other = torch.nn.ModuleDict({"prior": config.build_prior(), "latents": config.build_latents(3)})
    with torch.no_grad():
        other.prior.bevels.logits.copy_(torch.rand(22, 2))
    said = {"room_ids": ["a", "b", "c"], "label_set": config.label_set}
    torch.save({"state_dict": other.state_dict(), "sceneprior": said}, path)
    own = tiny_config(toy_shards, model__layout_heads=heads, label_set=mine, seed=9)
    module = torch.nn.ModuleDict({"prior": own.build_prior(), "latents": own.build_latents(2)})
    initial = module.latents.weight[1].clone()
    start_from(path, module, mine, ["c", "new"])
    assert torch.equal(module.latents.weight[0], other.latents.weight[2])
    assert torch.equal(module.latents.weight[1], initial)
    at = [label_set(config.label_set).index(name) for name in ("void", "armchair", "chair")]
    assert torch.equal(module.prior.bevels.logits[:3], other.prior.bevels.logits[at])
    assert (module.prior.bevels.logits[3] == -2).all()
    rows, others = module.prior.layout.mlp2.rows(), other.prior.layout.mlp2.rows()
    for row, wanted in [*zip(range(3), at, strict=True), *((-k, -k) for k in range(1, 8))]:
        assert all(map(torch.equal, rows[row], others[wanted]))
    small = torch.nn.ModuleDict({"prior": torch.nn.Linear(2, 2)})
    with refused("training/init_from network", tmp=tmp_path):
        start_from(path, small, config.label_set, [])
    with refused("training/init_from classes", tmp=tmp_path):
        start_from(path, small, mine, [])
    without = tiny_config(tmp_path / "no shards", init_from=str(tmp_path / "no"))
    with refused("training/init_from nothing", tmp=tmp_path):
        fit(without, tmp_path / "run", False, (), CPU)
    assert not (tmp_path / "run").exists()
