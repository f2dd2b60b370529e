"""Steps with static shapes, without a GPU: a plain call replaces the capture of CUDA graphs."""

import contextlib
import warnings

import lightning
import pytest
import torch
from interrupting import CPU
from tiny_runs import tiny_config
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from sceneprior.core.errors import InputWarning
from sceneprior.paper import static_step
from sceneprior.paper.stages import LayoutStage, PaperStage
from sceneprior.training import graphs
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint

WAITS = {"_local_scalar_dense", "nonzero", "masked_select", "lift_fresh", "_unique2", "equal"}
"""Operations for which torch waits for a GPU, or copies from the host: they cannot be captured."""


class CheckedForWaits(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        assert name not in WAITS, f"{func} waits for a GPU"
        if name in ("index", "index_put", "index_put_"):
            used = [index for index in args[1] if index is not None]
            assert not any(index.dtype == torch.bool for index in used), f"{func} counts a mask"
        return func(*args, **(kwargs or {}))


def checked_call(function, samples):
    """A stand-in for `captured`: one call, forward and backward, checked as a capture checks it."""
    # Constants are made in the first call, as in a capture's warm-up.
    for checks in (contextlib.nullcontext(), CheckedForWaits()):
        with checks:
            found = function(*samples)
            outputs = found if isinstance(found, tuple) else (found,)
            needing = [output for output in outputs if output.requires_grad]
            if needing:
                inputs = [sample for sample in samples if sample.requires_grad]
                ones = [torch.ones_like(output) for output in needing]
                torch.autograd.grad(needing, inputs, ones, allow_unused=True)
    return function


def trained(config, run, static: bool, monkeypatch, capture=checked_call) -> dict[str, dict]:
    """Weights after training in float64, in which sums in another order differ by 1e-16."""

    def use_graphs(self, trainer: lightning.Trainer) -> bool:
        self.double()
        if static:
            settings = self.prior, self.stage, self.loss, self.completeness_target
            self.static = static_step.StaticStep(*settings)
        return static

    transfer = PaperStage.on_before_batch_transfer

    def as_doubles(self, batch, dataloader_idx: int):
        batch = batch.changed(lambda part: part.double() if part.is_floating_point() else part)
        return transfer(self, batch, dataloader_idx)

    monkeypatch.setattr(PaperStage, "use_graphs", use_graphs)
    monkeypatch.setattr(PaperStage, "on_before_batch_transfer", as_doubles)
    monkeypatch.setattr(graphs, "captured", capture)
    fit(config, run, loggers=("csv",), trainer_options=CPU)
    stages = ("layout", "shape")
    return {name: read_checkpoint(run / name / "final.ckpt")["state_dict"] for name in stages}


@pytest.mark.parametrize(("proxy", "box_from"), [("ellipsoid", "mesh"), ("beveled_box", "proxy")])
def test_static_steps_train_as_eager_ones(toy_shards, tmp_path, monkeypatch, proxy, box_from):
    """12 rooms in batches of 5: the last one is padded by three."""
    changes = {"layout__proxy": proxy, "shape__proxy": proxy, "shape__box_from": box_from}
    config = tiny_config(
        toy_shards, layout__epochs=3, shape__epochs=2, shape__batch_size=5, **changes
    )
    with pytest.MonkeyPatch.context() as patch, torch.random.fork_rng():
        eager = trained(config, tmp_path / "eager", False, patch)
        patch.undo()
        static = trained(config, tmp_path / "static", True, patch)
    for stage, weights in eager.items():
        for name, value in weights.items():
            assert_close(static[stage][name], value, rtol=0, atol=1e-9, msg=f"{stage} {name}")


def test_a_loss_that_is_no_number_names_its_rooms_one_step_later(toy_shards, tmp_path, monkeypatch):
    losses, poisoned = static_step.StaticStep.losses, []

    def first_is_nan(self, scenes, boxes, views, matches):
        found = losses(self, scenes, boxes, views, matches)
        poisoned.append(views.room_ids)
        return found | {"box": found["box"] * torch.nan} if len(poisoned) == 1 else found

    monkeypatch.setattr(static_step.StaticStep, "losses", first_is_nan)
    with pytest.raises(FloatingPointError, match="The loss is nan on rooms toy/train_") as error:
        trained(tiny_config(toy_shards), tmp_path / "run", True, monkeypatch)
    assert len(poisoned) == 1 and all(room in str(error.value) for room in poisoned[0])
    assert not list((tmp_path / "run").rglob("*.ckpt"))


def test_a_capture_that_fails_is_a_line_and_training_goes_on(toy_shards, tmp_path, monkeypatch):
    def fails(function, samples):
        raise RuntimeError("operation not permitted when stream is capturing. More for builders.")

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        trained(tiny_config(toy_shards), tmp_path / "run", True, monkeypatch, fails)
    said = {str(warning.message) for warning in told if warning.category is InputWarning}
    assert said == {
        f"No CUDA graph of {name} (RuntimeError: operation not permitted when stream is "
        "capturing); training goes on without it, more slowly."
        for name in ("the decoder", "the 2D boxes", "the matching cost", "the layout losses")
    }


def test_graphs_are_used_on_one_gpu_alone(tmp_path, monkeypatch):
    def uses(devices: int = 1, accumulate: int = 1, **changes) -> bool:
        trainer = lightning.Trainer(
            logger=False, enable_checkpointing=False, accumulate_grad_batches=accumulate, **CPU
        )
        config = tiny_config(tmp_path, **changes)
        stage = LayoutStage(config, config.layout, config.build_prior(), config.build_latents(2))
        with monkeypatch.context() as patch:
            patch.setattr(type(trainer.strategy), "root_device", torch.device("cuda"))
            patch.setattr(lightning.Trainer, "world_size", devices)
            return stage.use_graphs(trainer)

    assert uses() and not uses(layout__cuda_graphs=False)
    with pytest.warns(InputWarning, match="^Gradients of several batches are averaged, so steps"):
        assert not uses(accumulate=2)
    with pytest.warns(InputWarning, match="^Several processes train together, so steps are not"):
        assert not uses(devices=2)
