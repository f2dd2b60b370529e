"""Rooms of shipped priors as scenes: plain, on request, and round what is given."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh
from refusals import refused

import sceneprior
from sceneprior.apps.priors.packed import shipped_priors
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.classes import label_set
from sceneprior.core.colliders import HUNG
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.lifted.drawing.draw import draw_rooms
from sceneprior.lifted.drawing.plans import BEYOND_M
from sceneprior.lifted.lifting import HANGS_M
from sceneprior.lifted.prototypes import POSES
from sceneprior.lifted.requests.wishes import Conditions
from sceneprior.paper.sampling import draw_latents

L_SHAPE = [[0, 0], [5, 0], [5, 3], [2.5, 3], [2.5, 6], [0, 6]]
EDGE_M = BEYOND_M + 1e-4
"""Floors in scenes are written to the millimetre."""
SMALL = pytest.mark.filterwarnings("ignore:The floor of")
BED = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))


@pytest.fixture(scope="module")
def prior():
    return sceneprior.load("procthor-bedroom")


def labels(room: Scene) -> list[str]:
    return [item.label for item in room.objects]


def assert_on_floor(room: Scene) -> None:
    low, high = room.centers_m - room.sizes_m / 2, room.centers_m + room.sizes_m / 2
    footprints = shapely.box(low[:, 0], low[:, 2], high[:, 0], high[:, 2])
    on = shapely.Polygon(room.floor_m).buffer(EDGE_M, join_style="mitre")
    assert on.covers(footprints).all()


def test_rooms_come_from_the_sampler_and_others_if_asked(sampler_run, few_attempts):
    trained = sceneprior.load(sampler_run).with_latents
    made = sample_rooms(trained, 3, 5)
    assert [scene.latent for scene in made] == [None] * 3 and made[0].name == "seed5_0000"
    assert all(item.mesh is not None for room in made for item in room.objects)
    z = draw_latents(trained, 3, 5, "paper")
    latents = [scene.latent for scene in sample_rooms(trained, 3, 5, "paper")]
    np.testing.assert_array_equal(np.stack(latents), z)
    early = replace(trained, sampler=None, stage="shape")
    assert early.distribution == "paper" and sample_rooms(early, 2, 0)[0].latent is not None


def test_runs_without_a_sampler_say_so(toy_run):
    prior = sceneprior.load(toy_run)
    with refused("requests/no_sampler"):
        prior.sample(2, 0, "sampler")
    with refused("requests/no_sampler_for_completion"):
        prior.complete(Scene("mine", "front3d_bedroom", (BED,)), classes=["desk"])


@pytest.mark.parametrize(
    ("floor", "said"), [("1x1", "1.0 square metres is smaller"), ("40x40", "is larger")]
)
def test_floors_unlike_those_of_training_rooms_are_noted(prior, floor, said):
    with pytest.warns(InputWarning, match=f"{said} than in nearly all training rooms"):
        prior.sample(1, floor=floor)


@pytest.mark.filterwarnings("error::sceneprior.core.errors.InputWarning")
@pytest.mark.parametrize("name", shipped_priors())
@pytest.mark.parametrize("floor", [
    L_SHAPE, [[0, 0], [4, 0], [5, 3], [2, 4], [0, 3]], pytest.param("2.4x2.1", marks=SMALL)
])  # fmt: skip
def test_furniture_stands_on_the_floor_and_stays_on_it(name, floor):
    for room in sceneprior.load(name).sample(32, seed=3, floor=floor):
        assert room.floor_m is not None
        assert np.allclose(room.floor_m.min(axis=0) + room.floor_m.max(axis=0), 0)
        assert_on_floor(room)
        for item in room.objects:
            assert item.label in HUNG or item.center_m[1] == pytest.approx(item.size_m[1] / 2)


@pytest.mark.parametrize("name", shipped_priors())
def test_meshes_of_all_prototypes_are_closed_when_a_program_merges_their_vertices(name):
    """In single precision, as GLBs hold them, and 5 m from the origin."""
    shapes = sceneprior.load(name).trained.prior.shape
    for prototype in shapes.known:
        box_m = np.array([5.0, 0.4, -3.0, *(shapes.sizes_m[prototype].numpy() * 1.1)])
        mesh = shapes.mesh(prototype * POSES + 3, box_m)
        merged = trimesh.Trimesh(mesh.vertices_m.astype(np.float32), mesh.faces)
        assert merged.is_volume and len(merged.faces) == len(mesh.faces), prototype


def test_counts_hold_exactly(prior):
    want = {"double_bed": 1, "single_bed": 0, "nightstand": 2, "desk": ">=1", "cabinet": "<=1"}
    for room in prior.sample(6, seed=0, floor="5x4", want=want):
        found = labels(room)
        assert [found.count(label) for label in list(want)[:3]] == [1, 0, 2]
        assert found.count("desk") >= 1 and found.count("cabinet") <= 1
        assert room.extra["wishes"][2] == {"wish": "2 nightstand", "holds": True}
        assert room.extra["request"] == {"floor": "5x4", "want": want}


def test_completions_hold_what_is_given_exactly_and_differ(prior):
    rooms = prior.complete(Scene("mine", "front3d_bedroom", (BED,)), 9, seed=1)
    for room in rooms:
        first = room.objects[0]
        assert (first.label, first.center_m, first.size_m) == (BED.label, BED.center_m, BED.size_m)
        assert first.mesh is not None  # of the look that was recognised
        assert room.extra["given"] == [0] and room.latent is None
    assert rooms[0].name == "complete_00"
    assert len({tuple(room.centers_m.round(3).ravel()) for room in rooms}) > 3
    stool = SceneObject("dressing_table", (0.0, 0.3, 0.0), (0.5, 0.6, 0.5))  # in no training room
    (room,) = prior.complete(Scene("mine", "front3d_bedroom", (stool,)), 1)
    assert room.objects[0].label == "dressing_table" and room.objects[0].mesh is None


def test_all_chairs_that_were_wanted_stand_round_a_given_table():
    floor = np.array([[-2.5, -2.5], [2.5, -2.5], [2.5, 2.5], [-2.5, 2.5]])
    table = SceneObject("table", (0.0, 0.375, 0.0), (1.6, 0.75, 0.9))
    given = Scene("mine", "front3d_living", (table,), floor)
    rooms = sceneprior.load("procthor-living").complete(given, 8, 0, classes=["chair"] * 4)
    assert [labels(room) for room in rooms] == [["table", *["chair"] * 4]] * 8
    assert all(room.extra["no_place"] == [] for room in rooms)


def test_furniture_stands_on_the_floor_and_what_hangs_stays_there(prior):
    conditions = Conditions(tuple(label_set(prior.label_set)))
    drawn = draw_rooms(prior.trained.sampler, conditions, 20, 1).rooms
    reaching = []
    for row, room in enumerate(prior.sample(20, seed=1)):
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


def test_one_room_without_place_for_its_windows_does_not_stop_the_others(prior):
    asked = {"floor": "2.72x3", "openings": "window@north,window@north"}
    rooms = prior.sample(2, **asked)
    assert ["lacks" in room.extra for room in rooms] == [False, True]
    (alone,) = prior.sample(1, **asked)
    assert np.array_equal(alone.centers_m, rooms[0].centers_m)
    with pytest.raises(InputError, match="finds no free wall"):
        prior.sample(1, floor="2x3", openings="window@north,window@north")


def test_what_the_prior_does_not_draw_is_nothing_elses_twin(prior):
    """A class without prototypes has the number of the first one, which armchairs have."""
    first = label_set(prior.label_set)[int(prior.trained.sampler.look_class[0])]
    given = SceneObject("wardrobe", (0.0, 1.1, 0.0), (0.5, 2.2, 0.4))
    assert "wardrobe" not in prior.classes or first != "wardrobe"
    rooms = prior.complete(Scene("mine", prior.label_set, (given,)), 12, 0, classes=[first])
    assert {labels(room)[1] for room in rooms} == {first}
    assert all(room.objects[1].size_m[1] < 2.0 for room in rooms)


@pytest.mark.filterwarnings("ignore::sceneprior.core.errors.InputWarning")
def test_three_things_can_stand_beside_a_bed(prior):
    beside = {"subject": "stool", "relation": "beside", "target": "double_bed", "count": 3}
    want = {"double_bed": 1, "stool": 3, "relations": [beside]}
    assert len(prior.sample(2, want=want, floor="6x6")) == 2


def test_what_is_given_above_the_floor_stays_there(prior):
    shelf = SceneObject("cabinet", (0.0, 0.5, 0.0), (0.8, 0.5, 0.4))
    (room,) = prior.complete(Scene("mine", prior.label_set, (shelf,)), 1)
    low = room.objects[0].mesh.vertices_m[:, 1].min()
    assert room.objects[0].center_m == shelf.center_m and low == pytest.approx(0.25, abs=0.01)


def test_too_many_objects_are_one_sentence(prior):
    with pytest.raises(InputError, match="at most"):
        prior.complete(Scene("mine", prior.label_set, (BED,)), 1, classes=["desk"] * 1001)
