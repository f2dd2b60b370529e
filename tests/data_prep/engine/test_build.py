"""Houses to shards: right boxes, the same bytes whatever the workers, failures for themselves."""

import json

import numpy as np
import pytest
from front_files import bedroom, room
from front_jobs import digests, front_job, rooms_of, three_houses
from golden_values import hold
from refusals import refused
from toy_source import ToySource

from data_prep.engine.build import Job, build_shards, read_finished
from data_prep.inspection.agreement import true_bodies
from sceneprior.core.classes import label_set
from sceneprior.core.parallel import on_workers
from sceneprior.core.shards import read_index

TROUBLE = {1: "sentence", 2: "unforeseen", 3: "unreadable", 5: "shapes", 8: "filtered"}


def test_a_whole_job(front, tmp_path):
    three_houses(front)
    front.house("other", *(bedroom(f"Bedroom-{k}") for k in range(10)))  # more than one shard
    one, two, third = tmp_path / "one", tmp_path / "two", tmp_path / "three"
    summary = build_shards(front_job(front, one))
    with on_workers(2):
        build_shards(front_job(front, two))
    assert len(digests(one, "train/*.h5")) == 2 and digests(one) == digests(two)
    build_shards(front_job(front, third, seed=1))
    assert digests(third, "**/*.h5") != digests(one, "**/*.h5")
    index = read_index(one)
    assert index["counts"] == summary.counts and summary.statuses == {"prepared": 16}
    names = label_set("front3d_bedroom")
    found = {}
    for room_id, (views, truth) in rooms_of(one).items():
        # The bed of 1.8 x 1.0 x 2.0 at (0, 0, -1), the floor's centre being the origin.
        np.testing.assert_allclose(truth.centers_m[0], (0, 0.5, -1), atol=1e-6)
        np.testing.assert_allclose(truth.sizes_m[0], (1.8, 1.0, 2.0), atol=1e-6)
        np.testing.assert_allclose(truth.yaw_rad, (0, 0, np.pi / 2), atol=1e-6)
        assert truth.model_ids == ("bed", "stand", "stand")
        assert true_bodies(views, truth, one)[1] == []
        found[room_id] = {
            "classes": [names[c] for c in views.object_class],
            "size": views.image_size,
            "eyes": views.world_to_camera[:, :3, 3].astype(float).tolist(),
            "floor": truth.floor_m.astype(float).tolist(),
            "height": float(truth.height_m),
        }
    hold("shards", {"rooms": found, "counts": summary.counts, "index": index}, slack=1e-4)


def test_what_void_hides_is_not_seen(front, tmp_path):
    """A screen outside the label set stands round the nightstand: it occludes, and is void."""
    front.model("screen", "Space Ship", (1.0, 2.5, 1.0))
    pieces = [
        {"jid": "bed", "pos": (-1.0, 0, -1.0)},
        {"jid": "pendant", "pos": (0.0, 2.0, 0.0)},
        {"jid": "stand", "pos": (1.4, 0, 1.4)},
        {"jid": "screen", "pos": (1.4, 0, 1.4)},
    ]
    front.house("house", *(room(f"Bedroom-{k}", pieces) for k in range(2)))
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    names = label_set("front3d_bedroom")
    for views, truth in rooms_of(out).values():
        assert [names[c] for c in views.object_class] == ["double_bed", "pendant_lamp"]
        assert views.instance_ids.max() == 3, "the id after the last object's: void"
        # Ground truth keeps the hidden nightstand after the tracked pieces, and no void.
        assert [names[c] for c in truth.object_class[:2]] == ["double_bed", "pendant_lamp"]
        assert names[truth.object_class[2]] == "nightstand" and len(truth.object_class) == 3


def test_models_are_binary_and_mirrored_pieces_fit_them(front, tmp_path):
    mirrored = {"jid": "stand", "pos": (1.0, 0.2, 1.0), "yaw": 0.5, "scale": [-1.5, 1, 2]}
    front.house("house", room("A", [{"jid": "bed", "pos": (-1.0, 0.0, -1.0)}, mirrored]))
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    ((views, truth),) = rooms_of(out).values()
    assert true_bodies(views, truth, out)[1] == []
    header = (out / "models" / "bed.ply").read_bytes()[:400].split(b"end_header")[0].decode()
    assert "format binary_little_endian" in header
    properties = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    assert properties == ["x", "y", "z", "vertex_indices"]


def test_a_room_is_the_same_alone(front, tmp_path):
    three_houses(front)
    build_shards(front_job(front, tmp_path / "all"))
    whole = rooms_of(tmp_path / "all")["house1_MasterBedroom-1"][0]
    for only, rooms in (("house1/MasterBedroom-1", 1), ("house1_MasterBedroom-1", 1),
                        ("house1", 2)):  # fmt: skip
        out = tmp_path / only.replace("/", "-")
        build_shards(front_job(front, out, only=only))
        found = rooms_of(out)
        assert len(found) == rooms
        alone = found["house1_MasterBedroom-1"][0]
        np.testing.assert_array_equal(alone.instance_ids, whole.instance_ids)


def test_a_source_that_draws_nothing_comes_through_the_same_door(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    summary = build_shards(Job(ToySource(), one))
    assert summary.renderer is None and summary.statuses == {"prepared": 10, "filtered": 1}
    index = read_index(one)
    assert (index["source"], index["renderer"], index["seed"]) == ("toy", None, None)
    assert (one / "models" / "toy.ply").is_file()
    with on_workers(2):
        build_shards(Job(ToySource(), two))
    assert digests(one) == digests(two)
    with refused("engine/other source", tmp=tmp_path):
        build_shards(Job(ToySource(11, name="other"), one))


def test_each_room_fails_for_itself_and_is_tried_again_when_asked(tmp_path):
    out = tmp_path / "shards"
    summary = build_shards(Job(ToySource(trouble=TROUBLE), out))
    assert summary.statuses == {"prepared": 5, "filtered": 2, "failed": 4}
    assert sorted(rooms_of(out)) == ["box_0", "box_4", "box_6", "box_7", "box_9"]
    lines = {line["room_id"]: line for line in summary.report["rooms"]}
    hold("shards", {"failures": {k: lines[f"box_{k}"] for k in TROUBLE}})
    assert build_shards(Job(ToySource(), out)).shards_made == 0
    again = build_shards(Job(ToySource(), out, retry_failed=True))
    assert (again.shards_made, again.shards_kept) == (1, 1)
    assert again.statuses == {"prepared": 10, "filtered": 1}


@pytest.mark.parametrize("name", ["intrinsics", "centers_m"])
def test_a_room_with_numbers_that_are_not_finite_fails(tmp_path, name):
    out = tmp_path / "shards"
    summary = build_shards(Job(ToySource(5, trouble={1: name}), out))
    (reason,) = (line.reason for line in summary.lines if line.status == "failed")
    assert reason == f"box, room box_1: {name} holds numbers that are not finite."
    assert sorted(rooms_of(out)) == ["box_0", "box_2", "box_3", "box_4"]


@pytest.mark.parametrize("rooms", [21, 25], ids=["in a new shard", "in a shard with others"])
def test_rooms_that_failed_in_the_survey_are_tried_again_when_asked(tmp_path, rooms):
    """The train shards hold 8, 8 and, of 25 rooms, 3 rooms."""
    out = tmp_path / "shards"
    first = build_shards(Job(ToySource(rooms, trouble={2: "survey"}), out))
    assert first.statuses == {"prepared": rooms - 1, "filtered": 1, "failed": 1}
    before, planned = digests(out), ids_of_plan(out)
    assert build_shards(Job(ToySource(rooms), out)).shards_made == 0
    assert digests(out) == before
    again = build_shards(Job(ToySource(rooms), out, retry_failed=True))
    assert again.statuses == {"prepared": rooms, "filtered": 1}
    assert (again.shards_made, again.shards_kept) == (1, 3)
    assert ids_of_plan(out) == [*planned, "box_2"] and "box_2" in rooms_of(out)
    assert build_shards(Job(ToySource(rooms), out, retry_failed=True)).shards_made == 0


def ids_of_plan(out):
    return [room["room_id"] for room in json.loads((out / "plan.json").read_text())["rooms"]]


def test_a_damaged_report_is_work_to_do(tmp_path):
    out = tmp_path / "shards"
    build_shards(Job(ToySource(), out))
    expected = digests(out)
    path = out / "train" / "toys_0000.report.json"
    for text in ("", "[]", '{"renderer": null}', '{"renderer": null, "lines": [{"room_id": 1}]}'):
        path.write_text(text)
        assert read_finished(out / "train" / "toys_0000.h5") is None
    assert build_shards(Job(ToySource(), out)).shards_made == 1
    assert digests(out) == expected


def test_debugging_lets_the_unforeseen_through(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENEPRIOR_DEBUG", "1")
    with pytest.raises(KeyError, match="surprise"):
        build_shards(Job(ToySource(trouble={2: "unforeseen"}), tmp_path / "shards"))
