"""The baselines with 3D supervision: they learn, stop, resume, and all commands take their runs."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_runs import tiny_baseline
from torch.testing import assert_close
from toy_rooms import write_toy_shards

from sceneprior.baselines.atiss.network import END
from sceneprior.baselines.atiss.stage import AtissStage, part_of_rooms
from sceneprior.baselines.sync2gen.stage import Sync2genStage
from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.config import load_any_run, load_run
from sceneprior.errors import ConfigError, InputError
from sceneprior.evaluation.room_sets import without_void
from sceneprior.evaluation.synthesis import EvalOptions
from sceneprior.experiments.evaluate import evaluate_run, read_curves, report_run
from sceneprior.experiments.evaluate_samples import SampleEvaluator
from sceneprior.generation.decode import decode_training_rooms, synthesize
from sceneprior.training import fit as train
from sceneprior.training.callbacks import RollingCheckpoint
from sceneprior.training.checkpoints import find_checkpoint, read_checkpoint
from sceneprior.training.fit import fit
from sceneprior.training.method import TrainedSampler
from sceneprior.training.objective import with_cosine
from sceneprior.views import RoomBoxes

CPU = {"accelerator": "cpu", "devices": 1}
STAGES = {"atiss": AtissStage, "sync2gen": Sync2genStage}


@pytest.fixture(scope="module", params=STAGES)
def stage(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def run(stage, toy_shards, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp(stage) / "run"
    fit(tiny_baseline(toy_shards, stage), folder, trainer_options=CPU)
    return folder


def curve(run: Path, stage: str, name: str) -> list[float]:
    with (run / stage / "metrics.csv").open(newline="") as file:
        return [float(row[f"train/{name}"]) for row in csv.DictReader(file)]


def test_a_run_leaves_what_runs_py_promises(run, stage):
    assert {path.name for path in run.iterdir()} == {"config.yaml", stage}
    assert find_checkpoint(run, [stage]) == (stage, run / stage / "final.ckpt")
    terms = ("class", "position", "angle", "size") if stage == "atiss" else (
        "existence", "position", "size", "kl", "left_out"
    )  # fmt: skip
    for name in (*terms, "loss"):
        assert len(curve(run, stage, name)) == 6
    assert curve(run, stage, "loss")[-1] < curve(run, stage, "loss")[0]
    assert f"{stage}/size" in read_curves(run)


class Stop(RollingCheckpoint):
    """Presses Ctrl-C in the middle of the fourth epoch."""

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if (trainer.current_epoch, batch_idx) == (3, 1):
            raise KeyboardInterrupt


def test_an_interrupted_and_resumed_run_reaches_the_same_weights(
    run, stage, toy_shards, tmp_path, monkeypatch
):
    config = tiny_baseline(toy_shards, stage)
    with monkeypatch.context() as patch:
        patch.setattr(train, "RollingCheckpoint", Stop)
        with pytest.raises(KeyboardInterrupt):
            fit(config, tmp_path / "run", trainer_options=CPU)
    assert read_checkpoint(tmp_path / "run" / stage / "last.ckpt")["epoch"] == 2
    fit(config, tmp_path / "run", resume=True, trainer_options=CPU)
    wanted = read_checkpoint(run / stage / "final.ckpt")["state_dict"]
    reached = read_checkpoint(tmp_path / "run" / stage / "final.ckpt")["state_dict"]
    assert wanted.keys() == reached.keys()
    for name, value in wanted.items():
        assert torch.equal(reached[name], value), name


def test_a_loss_that_is_no_number_names_its_rooms(stage, toy_shards, tmp_path, monkeypatch):
    original = STAGES[stage].training_step

    def poisoned(self, rooms, batch_idx):
        bad = rooms.boxes_m.clone()
        bad[0] = torch.nan
        return original(self, replace(rooms, boxes_m=bad), batch_idx)

    monkeypatch.setattr(STAGES[stage], "training_step", poisoned)
    with pytest.raises(FloatingPointError, match=r"The loss is nan on rooms toy/train_\d\d, toy/"):
        # One batch of all rooms: whatever is drawn of the first, some object's place is asked for.
        fit(
            tiny_baseline(toy_shards, stage, training__batch_size=12, training__epochs=5),
            tmp_path / "run",
            trainer_options=CPU,
        )
    assert not list(tmp_path.rglob("final.ckpt"))


def test_a_vae_learns_three_rooms_by_heart(tmp_path):
    write_toy_shards(tmp_path / "shards", train=3, test=2, seed=5)
    training = {"batch_size": 3, "learning_rate": 5e-3, "schedule": "cosine", "epochs": 300}
    config = tiny_baseline(
        tmp_path / "shards", "sync2gen", training=training | {"kl_weight": 1e-3},
        model__width=64, model__refine_steps=0,
    )  # fmt: skip
    fit(config, tmp_path / "run", loggers=("csv",), trainer_options=CPU)
    trained = load_any_run(tmp_path / "run")
    truth = TruthDataset(tmp_path / "shards", "train").everything()
    matrix = trained.prior.to_matrix(truth)
    again = trained.prior.to_rooms(trained.prior.decode(trained.prior.encode(matrix)[0]))
    assert_close(again.is_object.sum(dim=1), truth.is_object.sum(dim=1))
    # Rooms are metres across and differ by tenths.
    found, exists = trained.prior.to_matrix(again), matrix[..., :1]
    off_m = (found - matrix)[..., 1:] * trained.prior.spread_m * exists
    assert off_m.abs().max() < 0.1


def test_an_atiss_learns_by_heart_which_furniture_goes_together(tmp_path):
    """Under its full loss. Rooms are drawn object by object, so one holds exactly the furniture of
    a training room only where every class and the end were drawn by what was there already."""
    write_toy_shards(tmp_path / "shards", train=3, test=2, seed=5)
    model = {
        "max_objects": 6, "width": 64, "hidden": 128, "heads": 4, "layers": 2, "mixtures": 10,
        "dropout": 0.0,
    }  # fmt: skip
    config = tiny_baseline(tmp_path / "shards", "atiss", model=model, training__learning_rate=3e-3)
    dataset = TruthDataset(tmp_path / "shards", "train")
    network = config.build(dataset, None).prior
    rooms = dataset.__getitems__([(row, 0) for row in [0, 1, 2] * 32])
    built = with_cosine(torch.optim.Adam(network.parameters(), lr=3e-3), 500)
    optimizer, schedule = built["optimizer"], built["lr_scheduler"]["scheduler"]
    for step in range(500):
        placed, coming = part_of_rooms(rooms, step)
        unit, next_unit = network.to_unit(placed), network.to_unit(coming)
        context = network.context(placed.object_class, unit, placed.is_object)
        log_probs = network.log_prob(context, coming.object_class[:, 0], next_unit[:, 0])
        optimizer.zero_grad()
        (-sum(log_prob.mean() for log_prob in log_probs.values())).backward()
        optimizer.step()
        schedule.step()
    found = furniture(network.eval().sample(200, 0))
    known = furniture(dataset.everything())
    # With gradients clipped to norm 1, as they once were, a sixth of the rooms are right.
    assert sum(room in known for room in found) > 100


def furniture(rooms: RoomBoxes) -> list[list[int]]:
    """The classes of each room's objects, sorted."""
    pairs = zip(rooms.object_class, rooms.is_object, strict=True)
    return [sorted(labels[there].tolist()) for labels, there in pairs]


def test_rooms_are_in_every_order_and_cut_anywhere(toy_shards):
    rooms = TruthDataset(toy_shards, "train").everything()
    counts = rooms.is_object.sum(dim=1)
    seen, orders = set(), set()
    for seed in range(80):
        part, coming = part_of_rooms(rooms, seed)
        kept = part.is_object.sum(dim=1)
        ended = kept == counts
        assert torch.equal(coming.is_object[:, 0], ~ended)
        assert (coming.object_class[ended] == END).all() and not part.object_class[
            ~part.is_object
        ].any()
        assert (kept <= counts).all()
        for row in range(len(counts)):
            there = part.is_object[row]
            whole = {tuple(b) for b in rooms.boxes_m[row, rooms.is_object[row]].tolist()}
            known = {tuple(b) for b in part.boxes_m[row, there].tolist()}
            assert len(known) == int(kept[row]) and known <= whole
            if not ended[row]:
                box = tuple(coming.boxes_m[row, 0].tolist())
                assert box in whole - known
                at = [tuple(b) for b in rooms.boxes_m[row].tolist()].index(box)
                assert coming.object_class[row, 0] == rooms.object_class[row, at]
                assert coming.yaw_rad[row, 0] == rooms.yaw_rad[row, at]
        seen.add(int(kept[0]))
        orders.add(tuple(part.object_class[0].tolist()))
    assert seen == set(range(int(counts[0]) + 1)) and len(orders) > 10


def test_a_trained_run_makes_rooms_of_boxes(run, stage):
    trained = load_any_run(run)
    assert isinstance(trained, TrainedSampler) and trained.stage == stage
    assert trained.room_ids == tuple(f"toy/train_{k:02d}" for k in range(12))
    assert not trained.prior.training
    scenes = synthesize(trained, 9, 2)
    assert [scene.name for scene in scenes[:2]] == ["seed2_0000", "seed2_0001"]
    again = synthesize(load_any_run(run), 9, 2)
    for one, other in zip(scenes, again, strict=True):
        assert one.objects == other.objects
    assert [s.objects for s in scenes] != [s.objects for s in synthesize(trained, 9, 3)]
    assert all(item.mesh is None and min(item.size_m) > 0 for s in scenes for item in s.objects)
    for scene in scenes:
        yaws = scene.extra.get("yaw_rad")
        assert (yaws is None) == (stage == "sync2gen")
        assert yaws is None or len(yaws) == len(scene.objects)


def test_what_needs_a_latent_space_says_that_there_is_none(run, stage):
    with pytest.raises(InputError) as error:
        load_run(run)
    assert str(error.value) == (
        f"{run} is a run of `method: {stage}`, which has no latent space of rooms, and this needs "
        "one. Take a run of `method: ours`; with this one, `sceneprior synthesize`, `eval-fid` and "
        "`report` work."
    )
    with pytest.raises(
        InputError, match=f"A run of `method: {stage}` keeps no latents of training"
    ):
        decode_training_rooms(load_any_run(run))
    with pytest.raises(
        InputError, match=f"but `method: {stage}` has none; leave out --distribution kernel"
    ):
        synthesize(load_any_run(run), 2, 0, "kernel")


def test_a_run_is_judged_and_reported(run, stage, tmp_path):
    options = EvalOptions(renderer="software")
    scores = evaluate_run(run, 4, options, tmp_path / "scores.json")
    assert scores["protocol"]["stage"] == stage and scores["protocol"]["latents"] == "its own"
    rooms = [without_void(room) for room in synthesize(load_any_run(run), 4, 0)]
    assert "box_iou_3d" not in scores
    assert scores["mean_objects"] == sum(len(room.objects) for room in rooms) / 4
    report_run(run, tmp_path / "scores.json", tmp_path / "page.html", 0, (), "software")
    page = (tmp_path / "page.html").read_text()
    assert "prior learnt from boxes in 3D" in page
    assert "boxes sampled by a baseline that learnt from the true boxes" in " ".join(page.split())
    assert "What training saw" not in page and "The sphere unfolding" not in page
    assert "latent sphere" not in page


def test_looks_choose_a_checkpoint(stage, toy_shards, tmp_path):
    samples = {"every": 2, "count": 6, "metric": "objects_off"}
    config = tiny_baseline(toy_shards, stage, samples=samples)
    fit(config, tmp_path / "run", trainer_options=CPU, evaluate=SampleEvaluator(config))
    assert (tmp_path / "run" / stage / "samples" / "00004.png").is_file()
    assert isinstance(load_any_run(tmp_path / "run", "best"), TrainedSampler)
    config = tiny_baseline(toy_shards, stage, samples=samples | {"metric": "mask_iou"})
    with pytest.raises(InputError, match=f"mask_iou, but `method: {stage}` remembers no rooms"):
        SampleEvaluator(config)


def test_what_does_not_fit_is_a_sentence(run, stage, toy_shards, tmp_path):
    with pytest.raises(InputError, match=r"has 5 objects but model.max_objects is 3; raise"):
        fit(tiny_baseline(toy_shards, "atiss", model__max_objects=3), tmp_path / "a")
    with pytest.raises(
        InputError, match=r"is labelled 'front3d_bedroom' but the config says 'scan"
    ):
        fit(tiny_baseline(toy_shards, stage, label_set="scannet"), tmp_path / "b")
    assert not list(tmp_path.iterdir())
    other = shutil.copytree(run, tmp_path / "run")
    text = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(text.replace("width: ", "width: 2", 1))
    with pytest.raises(InputError, match=r"does not fit the run's config.yaml .*use the config it"):
        load_any_run(other)
    with pytest.raises(ConfigError, match="'model': width 16 is not a multiple of heads 3"):
        tiny_baseline(toy_shards, "atiss", model__heads=3)
    with pytest.raises(ConfigError, match="'model': width 36 is not a multiple of 8"):
        tiny_baseline(toy_shards, "sync2gen", model__width=36)


def test_refinement_acts_on_sampling_alone(toy_shards, tmp_path):
    """One training serves both of the paper's rows, Sync2Gen and Sync2Gen*."""
    fit(
        tiny_baseline(toy_shards, "sync2gen", model__refine_steps=40),
        tmp_path / "run",
        trainer_options=CPU,
    )
    plain = shutil.copytree(tmp_path / "run", tmp_path / "plain")
    text = (plain / "config.yaml").read_text()
    assert "refine_steps: 40" in text
    (plain / "config.yaml").write_text(text.replace("refine_steps: 40", "refine_steps: 0"))
    refined, decoded = (
        load_any_run(tmp_path / name).prior.sample(20, 0) for name in ("run", "plain")
    )
    assert torch.equal(refined.object_class, decoded.object_class)
    assert torch.equal(refined.boxes_m[..., 3:], decoded.boxes_m[..., 3:])
    assert not torch.equal(refined.boxes_m, decoded.boxes_m)
