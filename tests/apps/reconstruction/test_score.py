"""`eval-svr` on fixed scenes: scores as before, and training rooms as baselines."""

from dataclasses import replace

import numpy as np
import pytest
from golden_values import assert_as_before
from refusals import refused

from sceneprior.apps.reconstruction.score import evaluate_scenes
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.views import images_of_split
from sceneprior.lifted.reconstruction.known_rooms import KnownRooms, mask_overlap


@pytest.fixture
def answers(toy_shards, tmp_path):
    """The true rooms of the test split as seen in a view of each, every object 10 cm away."""
    images, _ = images_of_split(toy_shards, "test", 0)
    truth = {scene.name: scene for scene in reference_scenes(toy_shards, "test", None, True)}
    scenes = []
    for image in images:
        true = truth[image.room_id]
        objects = tuple(true.objects[row].moved((0.1, 0.0, -0.05)) for row in image.rows)
        extra = {"room_id": image.room_id, "view": image.view}
        scenes.append(replace(true, name=image.name, objects=objects, extra=extra))
    write_scenes(scenes, tmp_path / "answers")
    return scenes, tmp_path / "answers"


def test_scores_are_as_before(answers, toy_shards):
    _, folder = answers
    found = evaluate_scenes(folder, toy_shards, "test", 0)
    assert found["protocol"].pop("scenes") == str(folder)
    assert found["protocol"].pop("shards") == str(toy_shards)
    assert_as_before("apps/svr_scores", found, rel=1e-3, abs=1e-4)


def test_nearest_rooms_are_those_of_the_image_under_another_name(toy_shards, renderer):
    rooms = KnownRooms(toy_shards)
    images = images_of_split(toy_shards, "train", 0, limit=4)[0]
    for image in images:
        answer = rooms.nearest(replace(image, room_id="unknown"), renderer)
        assert answer.scene.name == image.room_id and answer.scene.extra["turned_degrees"] == 0
        assert mask_overlap(answer, image, renderer) > 0.9
        assert rooms.nearest(image, renderer).scene.name != image.room_id
    rooms.scenes = [scene for scene in rooms.scenes if scene.name == images[0].room_id]
    with refused("lifted/only room"):
        rooms.drawn(images[0], np.random.default_rng(0))
