"""What a page can ask for, without a page: the same rooms as the commands make."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_runs import tiny_baseline

import sceneprior
from sceneprior.apps.api import Prior
from sceneprior.apps.viewer.explorer import Explorer, Folder, Shown
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.training.method import TrainedSampler


@pytest.fixture(scope="module")
def prior(toy_run):
    return sceneprior.load(toy_run)


@pytest.fixture
def explorer(prior):
    return Explorer(prior)


def same(a: Scene, b: Scene) -> bool:
    """As far as float32 is, alone and in a batch."""
    return np.array_equal(a.class_indices, b.class_indices) and np.allclose(
        a.centers_m, b.centers_m, rtol=0, atol=1e-4
    )


def test_a_seed_makes_the_room_that_synthesize_makes(explorer, prior):
    assert explorer.distributions == ("paper", "kernel")
    shown = explorer.sample(4, "kernel")
    assert shown.origin == "seed 4, from: kernel"
    assert same(shown.scene, prior.sample(1, 4, "kernel")[0])
    assert same(explorer.sample(4).scene, prior.sample(1, 4)[0])


def test_completion_keeps_what_is_kept(explorer):
    shown = explorer.sample(1).toggled(1)
    kept = shown.scene.objects[1]
    assert shown.toggled(1).kept == frozenset() and shown.given().objects == (kept,)
    done = explorer.complete(shown, seed=2)
    assert done.kept == {0} and done.scene.objects[0].center_m == kept.center_m
    assert done.origin == "completed around 1 kept objects, seed 2"


def test_without_latents_of_rooms_there_are_new_rooms(prior):
    bare = replace(prior.trained, logits=prior.trained.logits[:0], room_ids=())
    explorer = Explorer(Prior(bare, "bare"))
    assert explorer.has_latents and explorer.distributions == ("paper",)
    assert explorer.sample(0).origin == "seed 0, from: paper"


def test_a_method_without_a_latent_space_samples(toy_shards):
    config = tiny_baseline(toy_shards, "atiss")
    torch.manual_seed(0)
    networks = config.networks(config.stage_names[-1], 3)
    trained = config.trained(networks, config.stage_names[-1], ())
    assert isinstance(trained, TrainedSampler)
    explorer = Explorer(Prior(trained, "other"))
    assert not explorer.has_latents and explorer.distributions == ()
    assert explorer.sample(0).origin == "seed 0, from: atiss"


def test_a_folder_s_rooms():
    bed = SceneObject("double_bed", (1.0, 0.5, -2.0), (2.0, 1.0, 2.0))
    scenes = [Scene(name, "front3d_bedroom", (bed,)) for name in ("a", "b")]
    assert Folder(scenes).room(1) == Shown(scenes[1], "b, 2 of 2")
    assert Folder(scenes).label_set == "front3d_bedroom"
    with pytest.raises(InputError, match="label sets front3d_bedroom, front3d_living were given"):
        _ = Folder([*scenes, Scene("c", "front3d_living")]).label_set
