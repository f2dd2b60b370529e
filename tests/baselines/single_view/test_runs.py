"""Runs of the three baselines: trained, loaded, asked for images, and what they refuse."""

import shutil

import h5py
import pytest
import torch
from tiny_runs import tiny_baseline, tiny_baseline_settings

from sceneprior.config import check_config, load_any_run, load_run
from sceneprior.errors import ConfigError, InputError, ShardError
from sceneprior.generation.decode import synthesize
from sceneprior.reconstruction.image import images_of_split
from sceneprior.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.shards import Shard
from sceneprior.training.fit import fit
from sceneprior.training.method import TrainedReconstructor

METHODS = ("usl", "total3d", "im3d")
CPU = {"accelerator": "cpu"}


@pytest.fixture(scope="module", params=METHODS)
def run(request, toy_shards, made_once):
    config = tiny_baseline(toy_shards, request.param)
    return made_once(f"run_{request.param}", lambda run: fit(config, run, trainer_options=CPU))


def test_a_run_answers_each_mask_in_order(run, toy_shards):
    trained = load_any_run(run)
    assert isinstance(trained, TrainedReconstructor) and not trained.remembers_rooms
    images, _ = images_of_split(toy_shards, "test")
    answers = reconstruct(trained, images, FitOptions())
    again = reconstruct(load_any_run(run), images[:1], FitOptions())[0]
    assert again.scene.objects[0].center_m == pytest.approx(
        answers[0].scene.objects[0].center_m, abs=1e-4
    )
    for image, answer in zip(images, answers, strict=True):
        assert answer.image is image and answer.score >= 0
        assert (answer.scene.class_indices == image.object_class).all()
        for item in answer.scene.objects:
            assert min(item.size_m) > 0 and item.mesh is not None
            assert torch.isfinite(torch.tensor(item.mesh.vertices_m)).all()


def test_what_it_cannot_do_is_a_sentence(run, toy_shards):
    trained = load_any_run(run)
    with pytest.raises(InputError, match="answers images and makes no new rooms"):
        synthesize(trained, 2, 0)
    with pytest.raises(InputError, match="with this one, `sceneprior reconstruct` and `eval-svr`"):
        load_run(run)
    images, _ = images_of_split(toy_shards, "test", limit=1)
    with pytest.raises(InputError, match="has no latents to fit; leave out the fit paper"):
        reconstruct(trained, images, FitOptions("paper"))


@pytest.mark.parametrize("method", METHODS)
def test_settings_without_effect_are_refused(toy_shards, method):
    settings = tiny_baseline_settings(toy_shards, method)
    with pytest.raises(ConfigError, match="turned copies are all the same to it; set it to false"):
        check_config(settings | {"data": settings["data"] | {"augment_rotations": True}}, "a")
    with pytest.raises(ConfigError, match="makes no new rooms to evaluate; set it to 0"):
        check_config(settings | {"samples": {"every": 2}}, "a")


def test_heads_share_the_width(toy_shards):
    with pytest.raises(ConfigError, match="width 16 is not a multiple of heads 3"):
        tiny_baseline(toy_shards, "total3d", model__heads=3)


@pytest.mark.parametrize("method", METHODS)
def test_only_usl_does_without_ground_truth(toy_shards, tmp_path, monkeypatch, method):
    blind = shutil.copytree(toy_shards, tmp_path / "blind")
    for path in blind.glob("*/*.h5"):
        with h5py.File(path, "r+") as file:
            for room in file["rooms"].values():
                del room["ground_truth"]
    monkeypatch.setattr(Shard, "read_ground_truth", None)  # not even asked for
    config = tiny_baseline(blind, method, training__epochs=1)
    if method == "usl":
        fit(config, tmp_path / "run", trainer_options=CPU)
        return
    with pytest.raises(ShardError, match=r"carries no 3D ground truth.*\(usl, ours\)"):
        fit(config, tmp_path / "run", trainer_options=CPU)
    assert not (tmp_path / "run").exists()


def test_the_same_seed_trains_the_same_network(toy_shards, tmp_path, run):
    trained = load_any_run(run)
    fit(trained.config, tmp_path / "again", trainer_options=CPU)
    again = load_any_run(tmp_path / "again").prior
    assert all(map(torch.equal, trained.prior.parameters(), again.parameters()))
