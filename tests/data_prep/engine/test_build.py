"""Houses to shards: right boxes, the same bytes whatever the workers, resumed, reported."""

import numpy as np
import pytest
from front_files import bedroom, room
from front_jobs import digests, front_job, rooms_of, three_houses
from front_reading import shared_front

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.inspection.agreement import true_bodies
from data_prep.inspection.verify import verify
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.shards import list_shards, read_index


def projected(corners, turn, K):
    points = corners @ turn[:3, :3].T + turn[:3, 3]
    pixels = points @ K.T
    return pixels[:, :2] / pixels[:, 2:], points[:, 2].min()


def test_a_whole_job(front, tmp_path):
    three_houses(front)
    out = tmp_path / "shards"
    summary = build_shards(front_job(front, out))
    assert summary.statuses == {"prepared": 6} and summary.renderer == "software"
    rooms = {split: counts["rooms"] for split, counts in summary.counts.items()}
    assert rooms == {"train": 4, "val": 1, "test": 1}
    index = read_index(out)
    assert index["label_set"] == "front3d_bedroom" and index["room_type"] == "bedroom"
    assert index["counts"] == summary.counts
    assert [path.name for path in list_shards(out, "train")] == ["bedroom_0000.h5"]
    rooms = rooms_of(out)
    assert sorted(rooms) == sorted(
        f"house{k}_{kind}-{k}" for k in range(3) for kind in ("Bedroom", "MasterBedroom")
    )
    names = label_set("front3d_bedroom")
    for views, truth in rooms.values():
        assert views.image_size == (90, 120) and len(views.visible) == 8  # 16 m2 at 0.5, at least 8
        assert [names[c] for c in views.object_class] == ["double_bed", "nightstand", "nightstand"]
        assert views.visible.any(axis=0).all()
        # The bed of 1.8 x 1.0 x 2.0 at (0, 0, -1), the floor's centre being the origin.
        np.testing.assert_allclose(truth.centers_m[0], (0, 0.5, -1), atol=1e-6)
        np.testing.assert_allclose(truth.sizes_m[0], (1.8, 1.0, 2.0), atol=1e-6)
        np.testing.assert_allclose(truth.yaw_rad, (0, 0, np.pi / 2), atol=1e-6)
        assert truth.model_ids == ("bed", "stand", "stand")
        assert truth.height_m == pytest.approx(2.6)
        np.testing.assert_allclose(np.abs(truth.floor_m), 2)


def test_boxes_of_free_standing_pieces_are_their_projected_corners(front, tmp_path):
    """A box is the convex hull of its corners: masks must end within a pixel of the projection."""
    pieces = [{"jid": "stand", "pos": (0.0, 0.0, 0.0), "yaw": 0.4}]
    front.house("house", *(room(f"Bedroom-{k}", pieces) for k in range(4)))
    out = tmp_path / "shards"
    rules = ("min_objects=1", "required_classes=[]", "views.image_size=[360, 480]")
    build_shards(front_job(front, out, rules=rules))
    corners = np.array([[x, y, z, 1] for x in (-0.25, 0.25) for y in (0, 0.6) for z in (-0.2, 0.2)])
    errors = []
    for views, truth in rooms_of(out).values():
        here = (corners @ truth.model_to_room[0].T)[:, :3]
        np.testing.assert_allclose(
            here.min(axis=0), truth.centers_m[0] - truth.sizes_m[0] / 2, atol=1e-6
        )
        for view in np.flatnonzero(views.visible[:, 0]):
            pixels, nearest = projected(here, views.world_to_camera[view], views.intrinsics[view])
            expected = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
            if nearest < 0.05 or expected.min() < 0 or (expected > (480, 360, 480, 360)).any():
                continue
            found = views.boxes[view, 0] * (480, 360, 480, 360)
            # Pixel centres: never more than half a pixel outside, and only the thin tip of a
            # corner may fall between centres.
            outside = (found - expected) * (-1, -1, 1, 1)
            assert outside.max() <= 0.501 and outside.min() > -2
            errors += np.abs(outside).tolist()
    assert len(errors) > 40 and np.mean(errors) < 0.3


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


def test_models_fit_the_ground_truth(front, tmp_path):
    mirrored = {"jid": "stand", "pos": (1.0, 0.2, 1.0), "yaw": 0.5, "scale": [-1.5, 1, 2]}
    pieces = [{"jid": "bed", "pos": (-1.0, 0.0, -1.0)}, mirrored]
    front.house("house", *(room(f"Bedroom-{k}", pieces) for k in range(2)))
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    for views, truth in rooms_of(out).values():
        assert true_bodies(views, truth, out)[1] == []
    header = (out / "models" / "bed.ply").read_bytes()[:400].split(b"end_header")[0].decode()
    assert "format binary_little_endian" in header
    assert [line.split()[-1] for line in header.splitlines() if line.startswith("property")] == [
        "x", "y", "z", "vertex_indices",
    ]  # fmt: skip


def test_same_seed_same_bytes_whatever_the_workers(front, tmp_path):
    three_houses(front)
    front.house("other", *(bedroom(f"Bedroom-{k}") for k in range(10)))  # more than one shard
    one, two, third = tmp_path / "one", tmp_path / "two", tmp_path / "three"
    build_shards(front_job(front, one, workers=1))
    build_shards(front_job(front, two, workers=2))
    assert len(digests(one, "train/*.h5")) == 2
    assert digests(one) == digests(two)
    build_shards(front_job(front, third, seed=1))
    assert digests(third, "**/*.h5") != digests(one, "**/*.h5")


def test_a_room_is_the_same_alone(front, tmp_path):
    three_houses(front)
    build_shards(front_job(front, tmp_path / "all"))
    build_shards(front_job(front, tmp_path / "one", only="house1/MasterBedroom-1"))
    build_shards(front_job(front, tmp_path / "id", only="house1_MasterBedroom-1"))
    build_shards(front_job(front, tmp_path / "house", only="house1"))
    assert list(rooms_of(tmp_path / "one")) == ["house1_MasterBedroom-1"]
    assert list(rooms_of(tmp_path / "id")) == ["house1_MasterBedroom-1"]
    assert len(rooms_of(tmp_path / "house")) == 2
    whole = rooms_of(tmp_path / "all")["house1_MasterBedroom-1"][0]
    for name in ("one", "id", "house"):
        alone = rooms_of(tmp_path / name)["house1_MasterBedroom-1"][0]
        np.testing.assert_array_equal(alone.instance_ids, whole.instance_ids)
    with pytest.raises(InputError, match=r"has no house 'nowhere' .*: --only HOUSE/nowhere\."):
        build_shards(front_job(front, tmp_path / "none", only="nowhere"))


def test_a_second_run_makes_only_what_is_missing(front, tmp_path):
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(20)))
    out = tmp_path / "shards"
    first = build_shards(front_job(front, out))
    assert (first.shards_made, first.shards_kept) == (4, 0)  # 18 and 2 rooms
    before = digests(out)
    times = {path: path.stat().st_mtime_ns for path in out.glob("**/*.h5")}
    second = build_shards(front_job(front, out))
    assert (second.shards_made, second.shards_kept) == (0, 4)
    assert {path: path.stat().st_mtime_ns for path in out.glob("**/*.h5")} == times
    (out / "train" / "bedroom_0001.h5").unlink()
    third = build_shards(front_job(front, out))
    assert (third.shards_made, third.shards_kept) == (1, 3)
    assert digests(out) == before


def test_houses_made_by_others(tmp_path):
    """Stored masks agree with the projected meshes of the furniture."""
    folder = shared_front()
    recipe = load_recipe("bedroom", ("views.per_m2=0.5",))
    source = FrontSource(folder / "3D-FRONT", folder / "3D-FUTURE-model", recipe, only="0022c821")
    build_shards(Job(source, tmp_path / "a", renderer="software"))
    ((views, _),) = rooms_of(tmp_path / "a").values()
    assert views.room_id == "0022c821-c1f2-516e-8552-8f01efccfc26_MasterBedroom-8629"
    names = [label_set("front3d_bedroom")[c] for c in views.object_class]
    assert names.count("double_bed") == 1 and "armchair" in names and "void" not in names
    found = verify(tmp_path / "a")
    tally = found.agreement.of("mesh")
    assert found.problems == () and tally.whole > 3 and tally.mean_iou > 0.95
