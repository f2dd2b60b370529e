"""The baselines with 2D supervision: they train, stop, resume, and all commands take their runs."""

import csv
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from tiny_runs import tiny_baseline_settings, tiny_settings
from torch.testing import assert_close
from typer.testing import CliRunner

from sceneprior.baselines.atiss2d import SceneAtiss
from sceneprior.baselines.gan.losses import adversarial_loss
from sceneprior.baselines.gan.semantic_maps import observed_maps
from sceneprior.baselines.gan.stage import MEMORY, GanStage
from sceneprior.cli import app
from sceneprior.config import check_config, load_run
from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError
from sceneprior.evaluation.room_sets import without_void
from sceneprior.evaluation.synthesis import EvalOptions
from sceneprior.experiments.evaluate import evaluate_run, read_curves, report_run
from sceneprior.experiments.evaluate_samples import SampleEvaluator
from sceneprior.generation.decode import decode_training_rooms, synthesize
from sceneprior.generation.sample import read_latent
from sceneprior.losses.completeness import kept_objects
from sceneprior.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.training import fit as train
from sceneprior.training.callbacks import RollingCheckpoint
from sceneprior.training.checkpoints import find_checkpoint, read_checkpoint
from sceneprior.training.fit import fit

CPU = {"accelerator": "cpu", "devices": 1}
BASELINES = {
    "atiss2d": {
        "model__decoder": {
            "name": "atiss2d", "heads": 2, "hidden": 24, "dropout": 0.1, "norm_first": False,
        },
        "layout__epochs": 3,
        "shape__epochs": 2,
    },
    "gan": {},
}  # fmt: skip
STAGES = {"atiss2d": ("layout", "shape"), "gan": ("gan",)}


def plain(shards: Path, name: str, **changes):
    if name == "gan":
        return tiny_baseline_settings(shards, "gan", **changes)
    return tiny_settings(shards, **(BASELINES[name] | changes))


def settings(shards: Path, name: str, **changes):
    return check_config(plain(shards, name, **changes), "tiny")


@pytest.fixture(scope="module", params=BASELINES)
def name(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def run(name, toy_shards, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp(name) / "run"
    fit(settings(toy_shards, name), folder, trainer_options=CPU)
    return folder


@pytest.fixture(scope="module")
def gan_run(toy_shards, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("gan") / "run"
    fit(settings(toy_shards, "gan"), folder, trainer_options=CPU)
    return folder


def test_the_command_line_trains_generates_and_judges(name, toy_shards, tmp_path):
    short = {"gan": {"training__epochs": 1}, "atiss2d": {"layout__epochs": 1, "shape__epochs": 1}}
    changes = short[name]
    config = tmp_path / "tiny.yaml"
    config.write_text(yaml.safe_dump(plain(toy_shards, name, **changes)))
    run = tmp_path / "run"
    for words in (
        ["fit", "--config", str(config), "--run", str(run), "--accelerator", "cpu"],
        ["synthesize", "--run", str(run), "-n", "3", "--out", str(tmp_path / "rooms"),
         "--renderer", "software"],
        ["eval-fid", "--run", str(run), "-n", "4", "--renderer", "software"],
    ):  # fmt: skip
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
    assert len(list((tmp_path / "rooms").rglob("*.glb"))) == 3


def test_a_run_leaves_what_runs_py_promises(run, name):
    assert {path.name for path in run.iterdir()} == {"config.yaml", *STAGES[name]}
    last = STAGES[name][-1]
    assert find_checkpoint(run, STAGES[name]) == (last, run / last / "final.ckpt")
    trained = load_run(run)
    assert not trained.prior.training and trained.remembers_rooms == (name == "atiss2d")
    assert isinstance(trained.prior.decoder, SceneAtiss) == (name == "atiss2d")
    boxes = [
        [
            [*item.center_m, *item.size_m]
            for scene in synthesize(trained, 5, seed)
            for item in scene.objects
        ]
        for seed in (2, 2, 3)
    ]
    assert boxes[0] == boxes[1] != boxes[2]
    scenes = synthesize(trained, 5, 2)
    assert len(scenes) == 5 and any(scene.objects for scene in scenes)
    assert all(item.mesh is not None for scene in scenes for item in scene.objects)


class Stop(RollingCheckpoint):
    """Presses Ctrl-C in the middle of the second epoch of the last stage."""

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if (trainer.current_epoch, batch_idx) == (1, 1) and self.folder.name in ("shape", "gan"):
            raise KeyboardInterrupt


def test_an_interrupted_and_resumed_run_reaches_the_same_weights(
    run, name, toy_shards, tmp_path, monkeypatch
):
    config = settings(toy_shards, name)
    with monkeypatch.context() as patch:
        patch.setattr(train, "RollingCheckpoint", Stop)
        with pytest.raises(KeyboardInterrupt):
            fit(config, tmp_path / "run", trainer_options=CPU)
    assert read_checkpoint(tmp_path / "run" / STAGES[name][-1] / "last.ckpt")["epoch"] == 0
    fit(config, tmp_path / "run", resume=True, trainer_options=CPU)
    # All of it: both opponents, the averaged generator, the optimisers' moments.
    wanted, reached = (
        read_checkpoint(folder / STAGES[name][-1] / "final.ckpt")
        for folder in (run, tmp_path / "run")
    )
    assert wanted["state_dict"].keys() == reached["state_dict"].keys()
    for key, value in wanted["state_dict"].items():
        assert torch.equal(reached["state_dict"][key], value), key
    assert len(wanted["optimizer_states"]) == (2 if name == "gan" else 1)
    for one, other in zip(wanted["optimizer_states"], reached["optimizer_states"], strict=True):
        for key, moments in one["state"].items():
            assert torch.equal(moments["exp_avg_sq"], other["state"][key]["exp_avg_sq"])


def test_what_needs_latents_of_rooms_says_that_a_gan_has_none(gan_run):
    trained = load_run(gan_run)
    assert (
        trained.logits.shape == (0, 10)
        and trained.room_ids == ()
        and trained.distribution == "paper"
    )
    with pytest.raises(InputError) as error:
        decode_training_rooms(trained)
    assert str(error.value) == (
        "A run of `method: gan` keeps no latents of training rooms, so none can be decoded; take "
        "a run of `method: ours`."
    )
    with pytest.raises(InputError, match="which keeps none"):
        read_latent(trained, "typo")
    with pytest.raises(InputError, match="Reconstruction starts from training rooms"):
        reconstruct(trained, [], FitOptions())
    for distribution in ("kernel", "geodesic", "gaussian"):
        with pytest.raises(
            InputError,
            match=f"The {distribution} distribution needs at least 2 training rooms; use",
        ):
            synthesize(trained, 2, 0, distribution)


def test_a_gan_is_judged_and_reported_by_its_new_rooms_alone(gan_run, tmp_path):
    options = EvalOptions(renderer="software")
    scores = evaluate_run(gan_run, 4, options, tmp_path / "scores.json")
    assert scores["protocol"]["stage"] == "gan" and scores["protocol"]["latents"] == "paper"
    rooms = [without_void(room) for room in synthesize(load_run(gan_run), 4, 0)]
    assert "box_iou_3d" not in scores
    assert scores["mean_objects"] == sum(len(room.objects) for room in rooms) / 4
    report_run(gan_run, tmp_path / "scores.json", tmp_path / "page.html", 0, (), "software")
    page = (tmp_path / "page.html").read_text()
    assert "New rooms beside real ones" in page and "The sphere unfolding" not in page
    assert {"gan/loss", "gan/discriminator", "gan/objects"} <= set(read_curves(gan_run))


def test_looks_choose_a_checkpoint_of_a_gan(toy_shards, tmp_path):
    samples = {"every": 2, "count": 6, "metric": "objects_off"}
    config = settings(toy_shards, "gan", samples=samples)
    fit(config, tmp_path / "run", trainer_options=CPU, evaluate=SampleEvaluator(config))
    assert (tmp_path / "run" / "gan" / "samples" / "00004.png").is_file()
    assert not load_run(tmp_path / "run", "best").remembers_rooms
    with (tmp_path / "run" / "gan" / "metrics.csv").open(newline="") as file:
        header = next(csv.reader(file))
    assert "samples/overlaps" in header and "samples/mask_iou" not in header
    with pytest.raises(InputError, match="but `method: gan` remembers no rooms"):
        SampleEvaluator(settings(toy_shards, "gan", samples=samples | {"metric": "mask_iou"}))


def test_a_gan_of_several_processes_or_of_another_network_is_a_sentence(
    gan_run, toy_shards, tmp_path
):
    with pytest.raises(InputError, match=r"method: gan trains in one process, but 2 were asked"):
        fit(settings(toy_shards, "gan"), tmp_path / "a",
            trainer_options={"accelerator": "cpu", "devices": 2})  # fmt: skip
    assert not list(tmp_path.iterdir())
    other = shutil.copytree(gan_run, tmp_path / "run")
    text = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(text.replace("width: 16", "width: 18"))
    with pytest.raises(InputError, match=r"does not fit the run's config.yaml .*use the config it"):
        load_run(other)


def test_a_loss_that_is_no_number_names_its_rooms(toy_shards, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneprior.baselines.gan.stage.LOGIT_PENALTY", float("nan"))
    with pytest.raises(FloatingPointError, match=r"The loss is nan on rooms toy/train_\d\d, toy/"):
        fit(settings(toy_shards, "gan"), tmp_path / "run", trainer_options=CPU)
    assert not list(tmp_path.rglob("final.ckpt"))


def test_maps_that_are_too_small_are_a_sentence(toy_shards, tmp_path):
    with pytest.raises(InputError, match=r"maps of \d x \d pixels are too small .*mask_step, or"):
        fit(settings(toy_shards, "gan", data__mask_step=30), tmp_path, trainer_options=CPU)


def fresh(shards: Path, **changes) -> GanStage:
    config = settings(shards, "gan", **changes)
    return GanStage(config)


def test_objects_start_all_over_the_floor_and_in_most_slots(toy_shards):
    torch.manual_seed(0)
    stage = fresh(toy_shards, model__decoder__dropout=0.0)
    with torch.no_grad():
        scenes = stage.generator(torch.randn(400, 10))
    for name, value in stage.generator.state_dict().items():
        assert torch.equal(value, stage.prior.state_dict()[name])
    # The start is measured on 64 rooms; other rooms come within a tenth or so.
    floor_m = scenes.centers_m[..., [0, 2]].flatten(0, 1)
    assert_close(floor_m.std(dim=0), torch.full((2,), 1.2), rtol=0.15, atol=0)
    assert_close(floor_m.mean(dim=0), torch.zeros(2), rtol=0, atol=0.2)
    assert 0.4 < scenes.sizes_m.median() < 1.5 and (scenes.sizes_m > 0).all()
    assert 2 < kept_objects(scenes.completeness_logits).sum(dim=1).float().mean() < 5.9
    # Objects of a room part, as without step MLPs they do not.
    together = fresh(toy_shards, model__decoder__dropout=0.0, model__decoder__step_mlps=False)
    with torch.no_grad():
        alike = together.generator(torch.randn(400, 10))
    within = [s.centers_m.std(dim=1).mean() for s in (scenes, alike)]
    assert within[0] > 3 * within[1]


def test_each_opponent_learns_from_the_maps_and_the_average_follows(gan_run, toy_shards):
    state = read_checkpoint(gan_run / "gan" / "final.ckpt")["state_dict"]
    start = fresh(toy_shards).state_dict()
    moved = {part: 0 for part in ("generator", "discriminator", "prior")}
    for key, value in state.items():
        part = key.split(".")[0]
        if part in moved and not torch.equal(value, start[key]):
            moved[part] += 1
    assert all(moved.values())
    names = [key.removeprefix("prior.") for key in state if key.startswith("prior.layout")]
    assert all(
        not torch.equal(state[f"prior.{name}"], state[f"generator.{name}"]) for name in names
    )


def test_a_discriminator_told_to_tell_apart_does_and_its_views_have_no_order(toy_shards):
    stage = fresh(toy_shards)
    views = ViewDataset(toy_shards, "train", views_per_room=3, mask_step=4).__getitems__(
        [(row, 0) for row in range(6)]
    )
    real = observed_maps(views, 22)
    with torch.no_grad():
        fake, _ = stage._draw(stage.generator(torch.randn(6, 10)), views)
    judge = stage.discriminator
    optimizer = torch.optim.Adam(judge.parameters(), 2e-3, (0.0, 0.99))
    for _ in range(60):
        optimizer.zero_grad()
        loss = adversarial_loss(judge(real), True) + adversarial_loss(judge(fake), False)
        loss.backward()
        optimizer.step()
    judge.eval()
    (_, room_real), (_, room_fake) = judge(real), judge(fake)
    assert (room_real > room_fake.max()).all()
    patches, room = judge(real.flip(1))
    assert_close(room, room_real, rtol=0, atol=1e-5)
    assert_close(patches.flip(1), judge(real)[0], rtol=0, atol=1e-5)


def test_the_excess_is_a_running_mean_that_pushes_down(toy_shards, tmp_path, monkeypatch):
    """Always two more objects of class 9 than real rooms have, and one less of class 4."""
    more, less = torch.eye(22)[9] * 2, torch.eye(22)[4]
    said = []

    def draw(self, scenes, views):
        maps, _ = drawn(self, scenes, views)
        said.append(more + 0 * scenes.completeness_logits.sum(dim=1, keepdim=True))
        said[-1].retain_grad()
        return maps, said[-1]

    def observed(views, _):
        return less.expand(len(views.room_index), -1)

    drawn = GanStage._draw
    monkeypatch.setattr(GanStage, "_draw", draw)
    monkeypatch.setattr("sceneprior.baselines.gan.stage.observed_counts", observed)
    # Beside it the discriminator does not matter.
    big = settings(toy_shards, "gan", training__counts=1e3, training__epochs=2)
    fit(big, tmp_path / "run", trainer_options=CPU)
    excess = read_checkpoint(tmp_path / "run" / "gan" / "final.ckpt")["state_dict"]["excess"]
    assert_close(excess[:22], (1 - MEMORY ** len(said)) * (more - less), rtol=1e-4, atol=1e-5)
    assert excess[22:].any()  # of pixels
    assert (said[-1].grad[:, 9] > 0).all() and (said[-1].grad[:, 4] < 0).all()


def test_rates_fall_evenly_to_nothing(toy_shards, tmp_path, monkeypatch):
    seen = []

    def note(self, optimizer, loss):
        seen.append(optimizer.param_groups[0]["lr"])
        step(self, optimizer, loss)

    step = GanStage._update
    monkeypatch.setattr(GanStage, "_update", note)
    config = settings(toy_shards, "gan")
    fit(config, tmp_path / "run", trainer_options=CPU)
    rates = [config.training.discriminator_learning_rate, config.training.learning_rate]
    for epoch, kept in enumerate((1, 0.75, 0.5, 0.25)):
        batches = len(seen) // 4
        here = seen[epoch * batches : (epoch + 1) * batches]
        assert here[:2] == pytest.approx([rate * kept for rate in rates])
