"""Runs of the single-view baselines: their reconstructions, and what they refuse."""

import pytest
import torch
from tiny_runs import tiny_baseline, tiny_baseline_settings

from sceneprior.apps.config import check_config, load_any_run, load_run
from sceneprior.apps.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.observed_image import images_of_split
from sceneprior.training.method import TrainedReconstructor

METHODS = ("usl", "total3d", "im3d")
CPU = {"accelerator": "cpu"}


@pytest.mark.parametrize("method", METHODS)
def test_a_run_answers_each_mask_in_order(baseline_run, toy_shards, method):
    run = baseline_run(method)
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


@pytest.mark.parametrize("method", METHODS)
def test_what_it_cannot_do_is_a_sentence(baseline_run, toy_shards, method):
    run = baseline_run(method)
    trained = load_any_run(run)
    with pytest.raises(InputError, match="reconstructs images and makes no new rooms"):
        sample_rooms(trained, 2, 0)
    with pytest.raises(
        InputError, match="this run works with `sceneprior reconstruct` and `eval-svr`"
    ):
        load_run(run)
    images, _ = images_of_split(toy_shards, "test", limit=1)
    with pytest.raises(InputError, match="has no latents to fit; leave out the fit paper"):
        reconstruct(trained, images, FitOptions("paper"))


@pytest.mark.parametrize("method", METHODS)
def test_settings_without_effect_are_refused(toy_shards, method):
    settings = tiny_baseline_settings(toy_shards, method)
    with pytest.raises(ConfigError, match="turned copies would all be the same; set it to false"):
        check_config(settings | {"data": settings["data"] | {"augment_rotations": True}}, "a")


def test_heads_share_the_width(toy_shards):
    with pytest.raises(ConfigError, match="width 16 is not a multiple of heads 3"):
        tiny_baseline(toy_shards, "total3d", model__heads=3)
