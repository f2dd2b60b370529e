"""Rooms that a page can show, without a page: the same as the commands make, and their map."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from tiny_runs import tiny_baseline

import sceneprior
from sceneprior.apps.api import Prior
from sceneprior.apps.viewer.explorer import PATH_STEPS, SNAP, Explorer, Folder, Shown, make_map
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.paper.prior import LatentSphere
from sceneprior.paper.sampling import LATENTS_FILE, decode_training_rooms, write_latents


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


def test_a_click_on_a_dot_is_that_training_room_and_a_drag_keeps_the_rest(explorer, prior):
    rooms = decode_training_rooms(prior.trained)
    start = explorer.sample(0)
    dot = tuple(explorer.map.rooms[5].tolist())
    found = explorer.map.room_at(dot)  # of dots that touch, the nearest
    shown = explorer.at(start, dot, click=True)
    assert shown.scene.name == rooms[found].name and same(shown.scene, rooms[found])
    assert not same(explorer.at(start, dot).scene, shown.scene)  # dragged over: the rest stays
    shown = start
    for point in ((0.1, 0.1), (0.2, -0.1), (-0.3, 0.0)):
        shown = explorer.at(shown, point)
    straight = explorer.at(start, (-0.3, 0.0))
    np.testing.assert_allclose(shown.scene.latent, straight.scene.latent, atol=1e-5)
    assert shown.origin.startswith("map -0.300, ")
    # A room that a sampler drew has no latent; the map is entered from a training room.
    without = replace(start, scene=replace(start.scene, latent=None))
    assert explorer.at(without, (-0.3, 0.0)).scene.latent is not None


def test_a_path_leads_from_the_room_on_show_to_a_seed(explorer, prior, tmp_path):
    start = explorer.sample(3)
    assert len(explorer.draw_path(start, "here", " seed:9 ")) == PATH_STEPS
    assert same(explorer.step(0).scene, start.scene)
    assert same(explorer.step(PATH_STEPS - 1).scene, prior.sample(1, 9)[0])
    assert explorer.step(3).origin == f"path, step 3 of {PATH_STEPS - 1}"
    drawn = replace(start, scene=replace(start.scene, latent=None))
    with pytest.raises(InputError, match="has no latent"):
        explorer.draw_path(drawn, "here", "seed:9")
    # Files of latents may be named on the command line, never in the browser.
    write_latents(tmp_path, prior.sample(2, 3))
    file = tmp_path / LATENTS_FILE
    assert prior.latent(f"{file}:1").shape == (prior.trained.config.model.width,)
    for text in ("nowhere", str(file), f"{file}:1", f" {file}:seed3_0001"):
        with refused("viewer/end_of_a_path", text=text.strip()):
            explorer.draw_path(start, "here", text)


def test_completion_keeps_what_is_kept():
    explorer = Explorer(sceneprior.load("procthor-bedroom"))
    shown = explorer.sample(1).toggled(1)
    kept = shown.scene.objects[1]
    assert shown.toggled(1).kept == frozenset() and shown.given().objects == (kept,)
    done = explorer.complete(shown, seed=2)
    assert done.kept == {0} and done.scene.objects[0].center_m == kept.center_m
    assert done.origin == "completed around 1 kept objects, seed 2"


def test_without_latents_there_are_new_rooms_and_no_map(prior, toy_shards):
    bare = replace(prior.trained, logits=prior.trained.logits[:0], room_ids=())
    explorer = Explorer(Prior(bare, "bare"))
    assert explorer.map is None and explorer.has_latents
    assert explorer.without_map.startswith("The map needs the latents of training rooms, and this ")
    assert explorer.distributions == ("paper",)
    assert explorer.sample(0).origin == "seed 0, from: paper"
    config = tiny_baseline(toy_shards, "atiss")  # a method without a latent space
    networks = config.networks(config.stage_names[-1], 3)
    explorer = Explorer(Prior(config.trained(networks, config.stage_names[-1], ()), "other"))
    assert explorer.map is None and not explorer.has_latents and explorer.distributions == ()
    assert "which has no latent space" in explorer.without_map
    assert explorer.sample(0).origin == "seed 0, from: atiss"


def test_a_folder_s_rooms():
    bed = SceneObject("double_bed", (1.0, 0.5, -2.0), (2.0, 1.0, 2.0))
    scenes = [Scene(name, "front3d_bedroom", (bed,)) for name in ("a", "b")]
    assert Folder(scenes).room(1) == Shown(scenes[1], "b, 2 of 2")


# -- The map ---------------------------------------------------------------------------------------


@pytest.fixture
def z(torch_rng):
    return LatentSphere(20, 8)(torch.randn(30, 20, generator=torch_rng) * 2)


def test_axes_are_the_principal_components(z):
    latent_map = make_map(LatentSphere(20, 8), z)
    values, vectors = np.linalg.eigh(np.cov(z.double().numpy().T))
    ours = latent_map.axes.double().numpy()
    np.testing.assert_allclose(np.abs(ours @ vectors[:, :-3:-1]), np.eye(2), atol=1e-4)
    assert latent_map.share == pytest.approx(values[-2:].sum() / values.sum(), rel=1e-4)
    # Whatever sign a singular vector comes with, the map is the same way up.
    again = make_map(LatentSphere(20, 8), z.flip(0))
    torch.testing.assert_close(again.axes, latent_map.axes, rtol=0, atol=1e-4)
    x, y = latent_map.rooms[7].tolist()
    assert latent_map.room_at((x, y)) == 7
    beyond = latent_map.rooms.amax(dim=0) + 1.01 * SNAP * latent_map.side
    assert latent_map.room_at(tuple(beyond.tolist())) is None
    with refused("viewer/map_of_two_rooms"):
        make_map(LatentSphere(20, 8), z[:2])
