"""The sampler's stage: what is kept, what is resumed, and what is refused."""

from pathlib import Path

import pytest
import torch
from lightning.pytorch import Trainer
from rooms_of_boxes import TINY, lifted_rooms, sampler_rooms, small_sampler
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny_runs import tiny_lifted, tiny_sampler_config
from torch import nn

from sceneprior.apps.config import load_any_run
from sceneprior.core.errors import ConfigError
from sceneprior.lifted.sampler.network import SamplerConfig
from sceneprior.lifted.sampler.rooms import SamplerRooms
from sceneprior.lifted.sampler.stage import SamplerStage, negative_log_likelihood
from sceneprior.training.fit import fit
from sceneprior.training.steps import make_loader

CPU = {"accelerator": "cpu"}


def stage_of(rooms: SamplerRooms, val: SamplerRooms | None, **settings) -> SamplerStage:
    config = SamplerConfig.model_validate({**TINY, "val_every": 1, **settings})
    prior = tiny_lifted(Path("nowhere")).build_prior()
    return SamplerStage(prior, nn.Embedding(1, 1), small_sampler(rooms), config, val, seed=0)


def train(stage: SamplerStage, rooms: SamplerRooms, epochs: int) -> None:
    trainer = Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(stage, make_loader(rooms, 4, 0, 0))


def test_rooms_become_likelier():
    rooms = sampler_rooms(12)
    stage = stage_of(rooms, None, epochs=40, learning_rate=5e-3)

    def unlikely() -> float:
        plain = torch.zeros(len(rooms), dtype=torch.int64)
        parts = negative_log_likelihood(
            stage.sampler, rooms.rooms, plain, torch.Generator().manual_seed(0)
        )
        return float(torch.stack(list(parts.values())).sum(dim=0).mean())

    before = unlikely()
    train(stage, rooms, 40)
    assert unlikely() < before - 5


def test_with_val_rooms_the_likeliest_is_kept(monkeypatch):
    rooms = sampler_rooms()
    val = sampler_rooms(4, seed=1)
    stage = stage_of(rooms, val, epochs=4)
    losses, states = iter([3.0, 1.0, 2.0, 1.0]), []

    def val_loss() -> torch.Tensor:
        states.append({k: v.clone() for k, v in stage.learner.state_dict().items()})
        return torch.tensor(next(losses))

    monkeypatch.setattr(stage, "val_loss", val_loss)
    train(stage, rooms, 4)
    assert float(stage.least) == 1.0
    for name, value in stage.sampler.state_dict().items():
        assert torch.equal(value, states[1][name])
    assert not all(torch.equal(v, states[2][k]) for k, v in states[1].items())


def test_val_rooms_are_scored_in_full_precision():
    rooms = sampler_rooms()
    stage = stage_of(rooms, sampler_rooms(4, seed=1), epochs=1)
    plain = stage.val_loss()
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(stage.val_loss(), plain)


def test_val_rooms_without_an_object_that_is_known_have_a_likelihood():
    """The prototypes are those of one room, which has no pole."""
    lifted = lifted_rooms(4, seed=1)
    lifted.object_classes[:] = 3
    val = SamplerRooms(lifted).assign_prototypes(lifted_rooms(1).find_prototypes(99))
    assert not val.rooms.is_object.any()
    assert stage_of(sampler_rooms(), val, epochs=1).val_loss().isfinite()


def test_a_run_ends_with_a_sampler(sampler_run):
    trained = load_any_run(sampler_run)
    assert trained.stage == "sampler"
    assert trained.sampler is not None and not trained.sampler.training
    assert trained.distribution == "sampler"
    assert trained.latent_distribution == "paper"
    assert len(trained.room_ids) == len(trained.logits) == 12


def test_a_resumed_run_ends_as_one_that_was_never_stopped(toy_shards, tmp_path, monkeypatch):
    class StopError(Exception):
        pass

    class Stopped(SamplerStage):
        def on_train_epoch_start(self) -> None:
            if self.current_epoch == 2:
                raise StopError

    whole, again = tmp_path / "whole", tmp_path / "run"
    fit(tiny_sampler_config(toy_shards), whole, trainer_options=CPU)
    events = EventAccumulator(str(whole / "sampler")).Reload()
    assert events.Images("rooms/drawn")[0].step == 1
    with monkeypatch.context() as patch, pytest.raises(StopError):
        patch.setattr("sceneprior.lifted.sampler.stage.SamplerStage", Stopped)
        fit(tiny_sampler_config(toy_shards), again, trainer_options=CPU)
    fit(tiny_sampler_config(toy_shards), again, resume=True, trainer_options=CPU)
    for one, other in zip(
        load_any_run(whole).sampler.parameters(),
        load_any_run(again).sampler.parameters(),
        strict=True,
    ):
        assert torch.equal(one, other)


def test_turned_copies_keep_their_latents(toy_shards, tmp_path):
    turned = tiny_sampler_config(toy_shards, epochs=1)
    data = turned.data.model_copy(update={"augment_rotations": True})
    fit(turned.model_copy(update={"data": data}), tmp_path / "run", trainer_options=CPU)
    trained = load_any_run(tmp_path / "run")
    assert len(trained.room_ids) == len(trained.logits) == 48


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"sampling": {"distribution": "sampler"}}, "there is no section `sampler`"),
        ({"sampler": {"epochs": 2, "width": 10, "heads": 4}}, "multiple of heads"),
    ],
)
def test_what_does_not_fit_is_refused(toy_shards, changes, says):
    with pytest.raises(ConfigError, match=says):
        tiny_lifted(toy_shards, **changes)


def test_there_are_as_many_prototypes_as_classes_at_least(toy_shards, tmp_path):
    with pytest.raises(
        ConfigError, match=r"prototypes is 2, but the rooms have objects of \d class"
    ):
        fit(
            tiny_lifted(toy_shards, model__shape__prototypes=2),
            tmp_path / "run",
            trainer_options=CPU,
        )
