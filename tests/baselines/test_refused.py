"""Refusals of the baselines: their settings, their data, and tasks that they cannot do."""

import shutil

import h5py
import pytest
from refusals import refused
from tiny_runs import tiny_baseline, tiny_baseline_settings

from sceneprior.apps.api import load
from sceneprior.apps.config import check_config, load_any_run
from sceneprior.apps.reconstruction.reconstruct import reconstruct
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import ConfigError, ShardError
from sceneprior.core.shards import Shard
from sceneprior.core.views import images_of_split
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.paper.sampling import decode_training_rooms, read_latent
from sceneprior.training.fit import fit

CPU = {"accelerator": "cpu", "devices": 1}
SETTINGS = {
    "atiss_heads": ("atiss", {"model__heads": 3}),
    "total3d_heads": ("total3d", {"model__heads": 3}),
    "set_flow_steps": ("set_flow", {"model__steps": 0}),
    "sync2gen_width": ("sync2gen", {"model__width": 36}),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_settings(toy_shards, name):
    method, changes = SETTINGS[name]
    with refused(f"baselines/{name}", ConfigError):
        tiny_baseline(toy_shards, method, **changes)


@pytest.mark.parametrize("method", ("usl", "total3d", "im3d"))
def test_turned_copies_are_without_effect(toy_shards, method):
    settings = tiny_baseline_settings(toy_shards, method)
    turned = settings | {"data": settings["data"] | {"augment_rotations": True}}
    with refused("baselines/turned_copies", ConfigError, method=method):
        check_config(turned, "a")


def test_rooms_and_machines(baseline_config, tmp_path):
    for name, method, changes, options in (
        ("too_many_objects", "atiss", {"model__max_objects": 3}, {}),
        ("other_label_set", "set_flow", {"label_set": "scannet"}, {}),
        ("gan_processes", "gan", {}, CPU | {"devices": 2}),
    ):
        config = baseline_config(method, **changes)
        with refused(f"baselines/{name}", shards=config.data.shards):
            fit(config, tmp_path / "run", trainer_options=options)
        assert not list(tmp_path.iterdir())
    with refused("baselines/gan_small_maps"):
        fit(baseline_config("gan", data__mask_step=30), tmp_path, trainer_options=CPU)


@pytest.mark.parametrize("method", ("atiss", "sync2gen", "set_flow", "total3d", "im3d"))
def test_shards_without_3d_ground_truth(baseline_config, toy_shards, tmp_path, method):
    blind = shutil.copytree(toy_shards, tmp_path / "blind")
    with h5py.File(blind / "train" / "part_000.h5", "r+") as file:
        del next(iter(file["rooms"].values()))["ground_truth"]
    with refused("baselines/no_ground_truth", ShardError, blind=blind):
        fit(baseline_config(method, data__shards=str(blind)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", ("atiss2d", "gan", "usl"))
def test_methods_under_2d_supervision_never_read_it(baseline_config, monkeypatch, method):
    monkeypatch.setattr(Shard, "read_ground_truth", None)
    stage = baseline_config(method).stages()[0]
    rooms = stage.open_data()
    stage.build(rooms, None)
    rooms.__getitems__([(0, 0), (1, 0)])


def test_tasks_that_need_latents(baseline_run):
    run = baseline_run("atiss")
    atiss, gan = load_any_run(run), load(baseline_run("gan")).with_latents
    assert gan.logits.shape == (0, 10) and gan.room_ids == () and gan.distribution == "paper"
    for name, call in {
        "with_latents": lambda: load(run).with_latents,
        "decode": lambda: decode_training_rooms(atiss),
        "kernel": lambda: sample_rooms(atiss, 2, 0, "kernel"),
        "floor": lambda: sample_rooms(atiss, 2, 0, request=RoomRequest.of(floor="4x3")),
        "gan_decode": lambda: decode_training_rooms(gan),
        "gan_latent": lambda: read_latent(gan, "typo"),
        "gan_reconstruct": lambda: reconstruct(gan, []),
        "gan_kernel": lambda: sample_rooms(gan, 2, 0, "kernel"),
    }.items():
        with refused(f"baselines/{name}", run=run):
            call()


def test_tasks_of_what_reconstructs_images(baseline_run, toy_shards):
    run = baseline_run("usl")
    trained, (images, _) = load_any_run(run), images_of_split(toy_shards, "test", limit=1)
    for name, call in {
        "image_sample": lambda: sample_rooms(trained, 2, 0),
        "image_load": lambda: load(run).with_latents,
        "image_fit": lambda: reconstruct(trained, images, "paper"),
    }.items():
        with refused(f"baselines/{name}", run=run):
            call()
