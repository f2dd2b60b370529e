"""`eval-svr` on fixed scenes: scores as before, and the scenes that it refuses."""

from dataclasses import replace

import pytest
from golden_values import assert_as_before
from refusals import refused

from sceneprior.apps.reconstruction.score import evaluate_scenes
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.views import images_of_split


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


def test_scenes_that_do_not_match_an_image_are_refused(answers, toy_shards, tmp_path):
    (first, *_), _ = answers
    for name, changed in {
        "no_view": {"extra": {"room_id": first.extra["room_id"]}},
        "too_few_objects": {"objects": first.objects[1:]},
        "no_such_room": {"extra": {"room_id": "attic", "view": 0}},
    }.items():
        folder = tmp_path / name
        write_scenes([replace(first, **changed)], folder)
        with refused(f"apps/svr_{name}", tmp=tmp_path, shards=toy_shards):
            evaluate_scenes(folder, toy_shards, "test", 0)
