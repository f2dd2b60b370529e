"""What a page can ask for, without a page: the same rooms as the commands make."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_runs import tiny_baseline

import sceneprior
from sceneprior.apps.api import Prior
from sceneprior.apps.viewer.explorer import PATH_STEPS, Explorer, Folder, Shown, floor_side_m
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.paper.decode import decode_training_rooms
from sceneprior.paper.sampling import LATENTS_FILE, write_latents
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


def test_a_click_on_a_dot_is_that_training_room(explorer, prior):
    rooms = decode_training_rooms(prior.trained)
    start = explorer.sample(0)
    for row in (0, 5):
        dot = tuple(explorer.map.rooms[row].tolist())
        found = explorer.map.room_at(dot)  # of dots that touch, the nearest
        shown = explorer.at(start, dot, click=True)
        assert shown.scene.name == rooms[found].name and same(shown.scene, rooms[found])
        assert not same(explorer.at(start, dot).scene, shown.scene)  # dragged over: the rest stays


def test_a_drag_keeps_what_the_map_does_not_show(explorer):
    start = explorer.sample(0)
    shown = start
    for point in ((0.1, 0.1), (0.2, -0.1), (-0.3, 0.0)):
        shown = explorer.at(shown, point)
    straight = explorer.at(start, (-0.3, 0.0))
    np.testing.assert_allclose(shown.scene.latent, straight.scene.latent, atol=1e-5)
    assert shown.origin.startswith("map -0.300, ")
    # A room that a sampler drew has no latent; the map is entered from a training room.
    without = replace(start, scene=replace(start.scene, latent=None))
    assert explorer.at(without, (-0.3, 0.0)).scene.latent is not None


def test_a_path_leads_from_the_room_on_show_to_a_seed(explorer, prior):
    start = explorer.sample(3)
    z = explorer.draw_path(start, "here", " seed:9 ")
    assert len(z) == PATH_STEPS
    assert same(explorer.step(0).scene, start.scene)
    assert same(explorer.step(PATH_STEPS - 1).scene, prior.sample(1, 9)[0])
    assert explorer.step(3).origin == f"path, step 3 of {PATH_STEPS - 1}"
    with pytest.raises(InputError, match=r"'nowhere' is neither a training room .* nor here"):
        explorer.draw_path(start, "here", "nowhere")
    drawn = replace(start, scene=replace(start.scene, latent=None))
    with pytest.raises(InputError, match="has no latent"):
        explorer.draw_path(drawn, "here", "seed:9")


def test_a_path_s_end_is_no_file_of_this_machine(explorer, prior, tmp_path):
    write_latents(tmp_path, prior.sample(2, 3))
    file = tmp_path / LATENTS_FILE
    assert prior.latent(f"{file}:1").shape == (prior.trained.config.model.width,)  # for commands
    for text in (str(file), f"{file}:1", f" {file}:seed3_0001"):
        with pytest.raises(InputError, match="is neither a training room"):
            explorer.draw_path(explorer.sample(3), "here", text)


def test_completion_keeps_what_is_kept():
    explorer = Explorer(sceneprior.load("procthor-bedroom"))
    shown = explorer.sample(1).toggled(1)
    kept = shown.scene.objects[1]
    assert shown.toggled(1).kept == frozenset() and shown.given().objects == (kept,)
    done = explorer.complete(shown, seed=2)
    assert done.kept == {0} and done.scene.objects[0].center_m == kept.center_m
    assert done.origin == "completed around 1 kept objects, seed 2"


def test_the_nearest_training_room(explorer, prior):
    rooms = decode_training_rooms(prior.trained)
    shown, distance_m = explorer.nearest(rooms[4])
    assert distance_m == pytest.approx(0, abs=1e-4)
    assert same(shown.scene, next(room for room in rooms if room.name == shown.scene.name))


def test_without_latents_of_rooms_there_are_new_rooms_and_no_map(prior):
    bare = replace(prior.trained, logits=prior.trained.logits[:0], room_ids=())
    explorer = Explorer(Prior(bare, "bare"))
    assert explorer.map is None and explorer.has_latents
    assert explorer.without_map.startswith("The map needs the latents of training rooms, and this ")
    assert explorer.distributions == ("paper",)
    assert explorer.sample(0).origin == "seed 0, from: paper" and explorer.layouts()


def test_a_method_without_a_latent_space_samples(toy_shards):
    config = tiny_baseline(toy_shards, "atiss")
    torch.manual_seed(0)
    networks = config.networks(config.stage_names[-1], 3)
    trained = config.trained(networks, config.stage_names[-1], ())
    assert isinstance(trained, TrainedSampler)
    explorer = Explorer(Prior(trained, "other"))
    assert explorer.map is None and not explorer.has_latents and explorer.distributions == ()
    assert "which has no latent space" in explorer.without_map
    assert explorer.sample(0).origin == "seed 0, from: atiss"


def test_a_folder_s_rooms():
    bed = SceneObject("double_bed", (1.0, 0.5, -2.0), (2.0, 1.0, 2.0))
    scenes = [Scene(name, "front3d_bedroom", (bed,)) for name in ("a", "b")]
    assert Folder(scenes).room(1) == Shown(scenes[1], "b, 2 of 2")
    assert Folder(scenes).label_set == "front3d_bedroom"
    # It reaches 3 m from the origin.
    assert floor_side_m(scenes) == 6 and floor_side_m([Scene("c", "front3d_bedroom")]) == 4
    with pytest.raises(InputError, match="label sets front3d_bedroom, front3d_living were given"):
        _ = Folder([*scenes, Scene("c", "front3d_living")]).label_set
