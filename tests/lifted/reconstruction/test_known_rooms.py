"""Known rooms as answers: their own masks choose them, and never for their own image."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from sceneprior.core.views import images_of_split
from sceneprior.lifted.reconstruction.known_rooms import (
    KnownRooms,
    mask_overlap,
    turn_scene,
)


@pytest.fixture(scope="module")
def rooms(toy_shards):
    return KnownRooms(toy_shards)


def test_every_room_is_there_in_four_turns(rooms):
    assert len(rooms.scenes) == 4 * 12
    turned = turn_scene(rooms.furnished(0), 1)
    for item, again, box in zip(
        turned.objects, rooms.furnished(1).objects, rooms.scenes[1].objects, strict=True
    ):
        assert item.center_m == again.center_m == box.center_m
        assert item.size_m == again.size_m == box.size_m and box.mesh is None
        assert np.array_equal(item.mesh.vertices_m, again.mesh.vertices_m)
        assert np.ptp(item.mesh.vertices_m, axis=0) == pytest.approx(item.size_m, abs=1e-6)
    home = turn_scene(turned, 3)
    for item, again in zip(home.objects, rooms.scenes[0].objects, strict=True):
        assert item.center_m == pytest.approx(again.center_m)
    # +z goes towards +x: what stood at (0, z) stands at (z, 0).
    x, y, z = rooms.scenes[0].objects[0].center_m
    assert turned.objects[0].center_m == pytest.approx((z, y, -x))


def test_the_image_of_a_known_room_finds_it_under_another_name(rooms, toy_shards, renderer):
    images = images_of_split(toy_shards, "train", 0, limit=4)[0]
    strangers = [replace(image, room_id="unknown") for image in images]
    for image, stranger in zip(images, strangers, strict=True):
        answer = rooms.nearest(stranger, renderer)
        assert answer.scene.name == image.room_id
        assert answer.scene.extra["turned_degrees"] == 0
        assert mask_overlap(answer, image, renderer) > 0.9
        assert rooms.nearest(image, renderer).scene.name != image.room_id


def test_random_rooms_come_from_the_seed_and_are_never_the_images_own(rooms, toy_shards):
    images = images_of_split(toy_shards, "train", 0)[0]
    names = []
    for seed in (0, 0, 1):
        rng = np.random.default_rng(seed)
        answers = [rooms.drawn(image, rng) for image in images]
        names.append([(one.scene.name, one.scene.extra["turned_degrees"]) for one in answers])
        for image, answer in zip(images, answers, strict=True):
            assert answer.scene.name != image.room_id
            assert len(answer.objects) == len(image.rows)
            assert all(item is None or item.mesh is not None for item in answer.objects)
    assert names[0] == names[1] != names[2]


def test_a_room_that_is_the_only_one_is_no_baseline(toy_shards):
    image = images_of_split(toy_shards, "train", 0, limit=1)[0][0]
    only = KnownRooms(toy_shards)
    only.scenes = [scene for scene in only.scenes if scene.name == image.room_id]
    with refused("lifted/only room"):
        only.drawn(image, np.random.default_rng(0))
