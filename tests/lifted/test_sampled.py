"""Rooms of a sampler as scenes, round what is given, and what has latents nevertheless."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprior.apps.api import load
from sceneprior.apps.config import load_run
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.lifted.complete import complete
from sceneprior.lifted.lifting import HANGS_M
from sceneprior.lifted.sampler.draw import draw_rooms
from sceneprior.paper.sampling import draw_latents

BED = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))


@pytest.fixture(scope="module")
def trained(sampler_run):
    return load_run(sampler_run)


def scene(*objects: SceneObject, floor=None) -> Scene:
    return Scene("mine", "front3d_bedroom", objects, floor)


def drawn_labels(trained) -> list[str]:
    """Classes that the sampler draws."""
    return [label_set("front3d_bedroom")[row] for row in trained.sampler.drawn_classes]


def test_new_rooms_come_from_the_sampler_and_others_if_asked(trained, few_attempts):
    made = sample_rooms(trained, 3, 5)
    assert [scene.latent for scene in made] == [None] * 3
    assert made[0].name == "seed5_0000"
    again = sample_rooms(trained, 2, 5)
    for one, other in zip(again, made[:2], strict=True):
        assert [item.label for item in one.objects] == [item.label for item in other.objects]
        assert np.allclose(one.centers_m, other.centers_m, atol=1e-4)
    assert all(item.mesh is not None for room in made for item in room.objects)
    z, _ = draw_latents(trained, 3, 5, "paper")
    latents = [scene.latent for scene in sample_rooms(trained, 3, 5, "paper")]
    np.testing.assert_array_equal(np.stack(latents), z)


def test_runs_without_a_sampler_say_so(toy_run):
    with pytest.raises(InputError, match="has no sampler"):
        sample_rooms(load_run(toy_run), 2, 0, "sampler")
    with pytest.raises(InputError, match="Only a sampler can add"):
        complete(load_run(toy_run), [scene(BED)], classes=["desk"])


def test_before_its_stage_rooms_come_from_latents(trained):
    early = replace(trained, sampler=None, stage="shape")
    assert early.distribution == "paper"
    assert sample_rooms(early, 2, 0)[0].latent is not None


def test_answers_hold_what_is_given_exactly_and_differ():
    """A trained sampler's: an untrained one finds places for its furniture late."""
    trained, given = load("procthor-bedroom").trained, scene(BED)
    (answers,) = complete(trained, [given], count=9, seed=1)
    assert [answer.latent for answer in answers] == [None] * 9
    for answer in answers:
        first = answer.objects[0]
        assert (first.label, first.center_m, first.size_m) == (BED.label, BED.center_m, BED.size_m)
        assert first.mesh is not None  # of the look that was recognised
        assert answer.extra["given"] == [0]
    places = {tuple(answer.centers_m.round(3).ravel()) for answer in answers}
    assert len(places) > 3
    (again,) = complete(trained, [given], count=9, seed=1)
    assert places == {tuple(answer.centers_m.round(3).ravel()) for answer in again}


def test_classes_and_floor_are_kept_to(trained):
    floor = np.array([[-2.0, -1.5], [2.0, -1.5], [2.0, 1.5], [-2.0, 1.5]])
    room = scene(floor=floor)
    wanted = drawn_labels(trained)[:2]
    (answers,) = complete(trained, [room], count=4, seed=0, classes=wanted)
    for answer in answers:
        assert sorted(item.label for item in answer.objects) == sorted(wanted)
    with pytest.raises(InputError, match="'piano' is not a class"):
        complete(trained, [room], classes=["piano"])


def test_too_many_and_unknown_classes_are_sentences(trained, few_attempts):
    with pytest.raises(InputError, match="are 7 together"):
        complete(trained, [scene(BED)], classes=drawn_labels(trained)[:1] * 6)
    unseen = "dressing_table"  # in the label set, in no toy room
    with pytest.raises(InputError, match="not a class of this run's training rooms"):
        complete(trained, [scene()], classes=[unseen])
    stool = SceneObject(unseen, (0.0, 0.3, 0.0), (0.5, 0.6, 0.5))
    ((answer,),) = complete(trained, [scene(stool)], count=1)
    assert answer.objects[0].label == unseen and answer.objects[0].mesh is None


def test_all_chairs_that_were_wanted_stand_round_a_given_table():
    """Chairs may stand under a table, so insertion removes none."""
    floor = np.array([[-2.5, -2.5], [2.5, -2.5], [2.5, 2.5], [-2.5, 2.5]])
    table = SceneObject("table", (0.0, 0.375, 0.0), (1.6, 0.75, 0.9))
    given = Scene("mine", "front3d_living", (table,), floor)
    rooms = load("procthor-living").complete(given, 8, 0, classes=["chair"] * 4)
    labels = [[item.label for item in room.objects] for room in rooms]
    assert labels == [["table", *["chair"] * 4]] * 8
    assert all(room.extra["no_place"] == [] for room in rooms)


def test_furniture_stands_on_the_floor_and_what_hangs_stays_there():
    prior = load("procthor-bedroom")
    drawn = draw_rooms(prior.trained.sampler, 20, 1)
    rooms = prior.sample(20, seed=1)
    reaching = []
    for row, room in enumerate(rooms):
        boxes_m = drawn.boxes_m[row, drawn.is_object[row]].double().numpy()
        for item, box_m in zip(room.objects, boxes_m, strict=True):
            bottom, lowest = box_m[1] - box_m[4] / 2, item.mesh.vertices_m[:, 1].min()
            assert item.size_m == pytest.approx(box_m[3:])
            if bottom < HANGS_M:
                assert item.center_m[1] == item.size_m[1] / 2
                reaching.append(abs(lowest) < 0.005)
            else:
                assert item.center_m[1] == pytest.approx(box_m[1])
                assert lowest >= bottom - 0.001
    assert len(reaching) > 60 and np.mean(reaching) > 0.9
