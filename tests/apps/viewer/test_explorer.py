"""Rooms that a page can show, without a page: the same as the commands make, and their map."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from tiny_runs import tiny_baseline

import sceneprior
from sceneprior.apps.api import Prior
from sceneprior.apps.retrieval.cad_models import made_models
from sceneprior.apps.viewer.explorer import PATH_STEPS, Explorer
from sceneprior.apps.viewer.map import SNAP, make_map, map_picture, mark_style, read_event
from sceneprior.apps.viewer.requested import line_of, line_of_clauses, read_line
from sceneprior.apps.viewer.shown import Folder, Shown
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.lifted.requests.request import RoomRequest
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
    assert shown.origin == "Room of seed 4, from kernel"
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
    assert shown.origin.startswith("Map at -0.300, ")
    # A room that a sampler drew has no latent; the map is entered from a training room.
    without = replace(start, scene=replace(start.scene, latent=None))
    assert explorer.at(without, (-0.3, 0.0)).scene.latent is not None


def test_a_path_leads_from_the_room_on_show_to_a_seed(explorer, prior, tmp_path):
    start = explorer.sample(3)
    assert len(explorer.draw_path(start, "here", " seed:9 ")) == PATH_STEPS
    assert same(explorer.step(0).scene, start.scene)
    assert same(explorer.step(PATH_STEPS - 1).scene, prior.sample(1, 9)[0])
    assert explorer.step(3).origin == f"Path, step 3 of {PATH_STEPS - 1}"
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


@pytest.fixture(scope="module")
def asked():
    return Explorer(sceneprior.load("procthor-bedroom"))


def unmet(explorer, shown) -> list[str]:
    """The clauses of its request that a room does not meet."""
    return [text for text, holds in explorer.ticks(shown) if not holds]


def test_completion_keeps_what_is_locked_and_what_the_room_is(asked):
    """The command of the guide: its sentence names the floor, which the shown room has by then."""
    request = RoomRequest.of(want="a 4 x 3 m bedroom with a door and two nightstands")
    shown = asked.sample(1, request=request).toggled(1)
    locked = shown.scene.objects[1]
    assert shown.toggled(1).locked == frozenset() and shown.given().objects == (locked,)
    done = asked.complete(shown, seed=2)
    assert done.locked == {0} and done.scene.objects[0].center_m == locked.center_m
    assert done.origin == "Completed around 1 locked piece, seed 2"
    assert done.scene.openings == shown.scene.openings and not unmet(asked, done)
    np.testing.assert_array_equal(done.scene.floor_m, shown.scene.floor_m)
    # A request that has changed since counts, with a floor, doors and windows of its own.
    line = "5 x 4 m, a window in the north wall"
    other = replace(shown, request=RoomRequest.of(want=line), line=line)
    assert unmet(asked, other) == ["5 x 4 m", "a window in the north wall"]
    done = asked.complete(other, seed=2)
    np.testing.assert_allclose(np.ptp(done.scene.floor_m, axis=0), [5, 4])
    assert [each.kind for each in done.scene.openings] == ["window"]
    assert done.scene.objects[0].center_m == locked.center_m


def test_the_rest_follows_a_dragged_piece(asked):
    request = RoomRequest.of(want="4 x 3 m, a door, the nightstand beside the double bed")
    shown = asked.sample(1, request=request)
    labels = [item.label for item in shown.scene.objects]
    row = labels.index("nightstand")
    moved = shown.dragged(row, 0.3, 9.0)  # beyond the wall, at which it stops
    (x, y, z), size = moved.scene.objects[row].center_m, moved.scene.objects[row].size_m
    assert z + size[2] / 2 == pytest.approx(1.5) and y == shown.scene.objects[row].center_m[1]
    assert moved.locked == {row} and "wishes" not in moved.scene.extra
    done = asked.follow(moved, 3)
    assert sorted(item.label for item in done.scene.objects) == sorted(labels)
    assert done.scene.objects[0].center_m == (x, y, z) and done.request == request
    assert unmet(asked, done) == []


def test_models_replace_the_picked_piece_or_all(asked):
    shown = asked.sample(1)
    models = made_models()
    one = replace(shown, picked=1).with_models(models)
    others = [a is b for a, b in zip(one.scene.objects, shown.scene.objects, strict=True)]
    assert others == [row != 1 for row in range(len(others))]
    every = shown.with_models(models).scene
    assert [each is None for each in every.extra["retrieval"]].count(True) == 0


# -- The request -----------------------------------------------------------------------------------

LINES = {
    "a 4 x 3 m bedroom with a door in the north wall and two nightstands beside the bed": 3,
    "floor: 0,0 5,0 5,3 2,3 2,5 0,5; doors: door@0:1.5,window; ceiling: 2.5; no sofa": 4,
    "nightstand: 2, desk: <=1, shelf: >=2": 3,
    "a desk under the window, at most 3 chairs, two chairs in a corner, at least one door": 4,
    "a double bed and two nightstands beside it. No chair, 4.5 x 3 m": 3,
    "a chair near the table, another chair": 2,
}


@pytest.mark.parametrize("line", LINES)
def test_each_clause_of_a_request_holds_and_can_be_removed(asked, line):
    request = read_line(line, RoomRequest())
    shown = asked.sample(3, request=request)
    ticks = asked.ticks(shown)
    clauses = [text for text, _ in ticks]
    assert shown.line == line_of(request) == line and len(ticks) == LINES[line]
    assert all(holds for _, holds in ticks), ticks
    meant, again = (
        asked.understood(read_line(text, RoomRequest()))
        for text in (line, line_of_clauses(clauses))
    )
    assert again.wishes.bounds == meant.wishes.bounds
    assert {*again.wishes.relations} == {*meant.wishes.relations}
    assert {*map(str, again.openings)} == {*map(str, meant.openings)}
    for row in range(len(clauses)):
        rest = clauses[:row] + clauses[row + 1 :]
        left = line_of_clauses(rest)
        fewer = replace(shown, line=left, request=read_line(left, request))
        # The room has two chairs, and without the other clause, each of these asks for one.
        one = {"a chair near the table", "another chair"}
        assert asked.ticks(fewer) == [(text, text not in one) for text in rest]


def test_a_clause_that_does_not_hold_is_marked(asked):
    shown = asked.sample(3, request=RoomRequest.of(want="4 x 3 m, one nightstand, no desk"))
    for line, holds in (
        ("4 x 3 m, two nightstands, no desk", [True, False, True]),
        ("4 x 3.5 m, a nightstand, a window", [False, True, False]),
    ):
        other = replace(shown, line=line, request=read_line(line, shown.request))
        assert [each for _, each in asked.ticks(other)] == holds


def test_a_mapping_becomes_a_line_and_what_has_no_words_stays_beside_it(asked):
    bed = SceneObject("double_bed", (0.0, 0.3, 0.4), (1.6, 0.6, 2.0))
    door = {"kind": "door", "start_m": [-0.5, -1.5], "end_m": [0.4, -1.5]}
    relation = {"subject": "nightstand", "relation": "beside", "target": "double_bed", "count": 2}
    want = {"nightstand": 2, "chair": ">=1", "desk": 0, "relations": [relation]}
    before = RoomRequest.of(floor="4x3", openings=[door, "window"], objects=[bed], want=want)
    line = line_of(before)
    assert line == (
        "floor: 4x3; doors: window; 2 nightstand, at least 1 chair, 0 desk, "
        "the 2 nightstand on both sides of double bed"
    )
    after = read_line(line, before)
    bounds = [asked.understood(each).wishes.bounds for each in (before, after)]
    assert bounds[0] == bounds[1] and after.objects == (bed,) and len(after.openings) == 2
    assert asked.sample(0, request=read_line("floor: 4x3", before)).locked == {0}
    with refused("viewer/ceiling_of_words"):
        read_line("ceiling: high", before)
    with refused("viewer/request_of_latents"):
        asked.sample(0, "paper", before)
    for text in ("floor.json", "floor.json:room", "floor.npz"):
        with refused("viewer/floor_of_a_file", text=text):
            read_line(f"floor: {text}", before)


def test_examples_are_requests_of_the_prior(asked):
    for name in ("procthor-bedroom", "demo-bedroom", "procthor-living"):
        assert len(Explorer(sceneprior.load(name)).examples) == 3


def test_without_latents_there_are_new_rooms_and_no_map(prior, toy_shards):
    bare = replace(prior.trained, logits=prior.trained.logits[:0], room_ids=())
    explorer = Explorer(Prior(bare, "bare"))
    assert explorer.map is None and explorer.has_latents
    assert explorer.distributions == ("paper",)
    assert explorer.sample(0).origin == "Room of seed 0, from paper"
    config = tiny_baseline(toy_shards, "atiss")  # a method without a latent space
    networks = config.networks(config.stage_names[-1], 3)
    explorer = Explorer(Prior(config.trained(networks, config.stage_names[-1], ()), "other"))
    assert explorer.map is None and not explorer.has_latents and explorer.distributions == ()
    assert explorer.sample(0).origin == "Room of seed 0, from atiss"


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


def test_the_picture_of_the_map_has_dots_where_pointer_events_are_read(z):
    latent_map = make_map(LatentSphere(20, 8), z)
    picture = str(map_picture(latent_map, z[:4]))
    dots = [tuple(map(float, each)) for each in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', picture)]
    assert len(dots) == len(z) and picture.count("<polyline") == 1
    for row, (x, y) in enumerate(dots):
        point, how = read_event(latent_map, f"{x / 100:.4f} {1 - y / 100:.4f} click 17")
        assert how == "click" and latent_map.room_at(point) is not None
        np.testing.assert_allclose(point, latent_map.rooms[row], atol=0.002 * latent_map.side)
    x, y = re.search(r"translate\(([\d.]+)px, ([\d.]+)px", mark_style(latent_map, z[3])).groups()
    np.testing.assert_allclose((float(x), float(y)), dots[3], atol=0.06)
    assert "none" in mark_style(latent_map, None)
    for text in ("", "2 0 click 1", "0.5 0.5 press 1", "0.5 0.5 click <b>", "nan 0 end 1"):
        assert read_event(latent_map, text) is None
