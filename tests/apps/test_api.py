"""The Python API: the same rooms as the functions below it, gradients, and sentences."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import sceneprior
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import InputError
from sceneprior.core.observed_image import image_from_shards
from sceneprior.core.scene import Scene, SceneObject

BED = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))


@pytest.fixture(scope="module")
def prior(toy_run):
    return sceneprior.load(toy_run)


def test_names_are_found_when_asked_for():
    assert set(sceneprior.__all__) <= set(dir(sceneprior))
    with pytest.raises(AttributeError, match="no attribute 'weights'"):
        _ = sceneprior.weights


def test_a_seed_s_rooms_are_the_run_s(prior):
    assert prior.label_set == "front3d_bedroom" and prior.classes[0] == "void"
    assert repr(prior).endswith("front3d_bedroom, rooms from: paper)")
    rooms = prior.sample(3, seed=2)
    for room, other in zip(rooms, sample_rooms(prior.trained, 3, 2), strict=True):
        assert (room.name, room.objects[0].label) == (other.name, other.objects[0].label)
        np.testing.assert_array_equal(room.centers_m, other.centers_m)
        np.testing.assert_array_equal(room.latent, other.latent)


def test_a_way_leads_from_room_to_room(prior):
    start, end = prior.sample(2, seed=1)
    way = prior.interpolate(start, end, 3)
    np.testing.assert_allclose(way[0].latent, start.latent, atol=1e-6)
    np.testing.assert_allclose(way[-1].centers_m, end.centers_m, atol=1e-4)
    assert way[0].extra["from"] == start.name
    middle = prior.interpolate(way[1].latent, "seed:1", 2)
    np.testing.assert_allclose(middle[0].centers_m, way[1].centers_m, atol=1e-4)
    with pytest.raises(InputError, match="Room drawn comes from no latent"):
        prior.interpolate(Scene("drawn", "front3d_bedroom"), end)
    with pytest.raises(InputError, match=r"The vector has a latent of shape \(3,\)"):
        prior.latent(torch.ones(3))


def test_given_objects_stay(prior):
    answers = prior.complete(Scene("mine", "front3d_bedroom", (BED,)), count=2)
    assert [room.objects[0].center_m for room in answers] == [BED.center_m] * 2


def test_an_image_is_answered(prior, toy_shards):
    (found,) = prior.reconstruct([image_from_shards(toy_shards, "toy/test_00", 0)])
    assert len(found.scene.objects) == len(found.image.object_class)


def test_gradients_flow_to_latents(prior):
    z = prior.latent("seed:3").unsqueeze(0).requires_grad_()
    decoded = prior.decode(z)
    decoded.sizes_m.sum().backward()
    assert z.grad is not None and z.grad.abs().max() > 0
    moved = z.detach() + 1e-3 * z.grad
    assert prior.decode(moved).sizes_m.sum() > decoded.sizes_m.sum()


@pytest.mark.parametrize("ending", ["json", "glb", "obj", "png"])
def test_a_scene_is_saved_as_its_name_says(ending, tmp_path):
    room = Scene("mine", "front3d_bedroom", (BED,))
    room.save(tmp_path / f"room.{ending}")
    starts = {"json": b"{", "glb": b"glTF", "obj": b"mtllib room.mtl", "png": b"\x89PNG"}
    assert (tmp_path / f"room.{ending}").read_bytes().startswith(starts[ending])
    if ending == "json":
        assert sceneprior.load_scene(tmp_path / "room.json") == room


def test_other_endings_are_a_sentence(tmp_path):
    with pytest.raises(InputError, match=r"ends with '.stl', which is no format of scenes"):
        Scene("mine", "front3d_bedroom").save(tmp_path / "room.stl")


def test_a_notebook_shows_the_picture(monkeypatch):
    room = Scene("my <room>", "front3d_bedroom", (BED, BED))
    shown = []
    page = room._repr_html_()
    assert "data:image/png;base64," in page and "my &lt;room&gt;: 2 double_bed" in page
    with pytest.raises(InputError, match="draws in a notebook, and this is none"):
        room.show()
    notebook = SimpleNamespace(get_ipython=object, display=SimpleNamespace(display=shown.append))
    monkeypatch.setitem(__import__("sys").modules, "IPython", notebook)
    room.show()
    assert shown == [room]
