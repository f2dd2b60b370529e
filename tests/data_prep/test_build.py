"""Houses to shards: right boxes, the same bytes whatever the workers, resumed, reported."""

import csv
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import typer
from front_files import bedroom, room
from typer.testing import CliRunner

from data_prep.build import FrontJob, build_shards
from data_prep.cli import add_commands
from data_prep.inspection import contact_sheet, count_shards
from data_prep.recipe import load_recipe
from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.shards import Shard, iterate_rooms, list_shards, read_index

SMALL = ("views.image_size=[90, 120]", "views.per_m2=0.5", "views.min_object_pixels=20")


def job(front, out, **changes):
    recipe = load_recipe("front3d_bedroom", (*SMALL, *changes.pop("rules", ())))
    plain = FrontJob(front.front, front.future, out, recipe, renderer="software")
    return replace(plain, **changes)


def three_houses(front):
    for k in range(3):
        front.house(f"house{k}", bedroom(f"Bedroom-{k}"), bedroom(f"MasterBedroom-{k}"))


def digests(folder, *patterns):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for pattern in patterns or ("**/*.h5", "*.json", "*.csv", "models/*")
        for path in sorted(folder.glob(pattern))
    }


def rooms_of(folder):
    found = {}
    for split in ("train", "test"):
        for path in sorted((folder / split).glob("*.h5")):
            with Shard(path) as shard:
                for room_id in shard.room_ids:
                    truth = shard.read_ground_truth(room_id)
                    found[room_id] = (shard.read_room(room_id, images=True), truth)
    return found


def projected(corners, turn, K):
    points = corners @ turn[:3, :3].T + turn[:3, 3]
    pixels = points @ K.T
    return pixels[:, :2] / pixels[:, 2:], points[:, 2].min()


def test_a_whole_job(front, tmp_path):
    three_houses(front)
    out = tmp_path / "shards"
    summary = build_shards(job(front, out))
    assert summary.statuses == {"prepared": 6} and summary.renderer == "software"
    assert summary.counts["train"]["rooms"] == 5 and summary.counts["test"]["rooms"] == 1
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
    build_shards(job(front, out, rules=rules))
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
    """A screen outside the label set stands round the nightstand: it occludes, and is nothing."""
    front.model("screen", "Space Ship", (1.0, 2.5, 1.0))
    pieces = [
        {"jid": "bed", "pos": (-1.0, 0, -1.0)},
        {"jid": "pendant", "pos": (0.0, 2.0, 0.0)},
        {"jid": "stand", "pos": (1.4, 0, 1.4)},
        {"jid": "screen", "pos": (1.4, 0, 1.4)},
    ]
    front.house("house", *(room(f"Bedroom-{k}", pieces) for k in range(2)))
    out = tmp_path / "shards"
    build_shards(job(front, out))
    names = label_set("front3d_bedroom")
    for views, truth in rooms_of(out).values():
        assert [names[c] for c in views.object_class] == ["double_bed", "pendant_lamp"]
        assert views.instance_ids.max() == 2
        # Ground truth keeps the hidden nightstand after the tracked pieces, and no void.
        assert [names[c] for c in truth.object_class[:2]] == ["double_bed", "pendant_lamp"]
        assert names[truth.object_class[2]] == "nightstand" and len(truth.object_class) == 3


def test_models_fit_the_ground_truth(front, tmp_path):
    mirrored = {"jid": "stand", "pos": (1.0, 0.2, 1.0), "yaw": 0.5, "scale": [-1.5, 1, 2]}
    pieces = [{"jid": "bed", "pos": (-1.0, 0.0, -1.0)}, mirrored]
    front.house("house", *(room(f"Bedroom-{k}", pieces) for k in range(2)))
    out = tmp_path / "shards"
    build_shards(job(front, out))
    for _, truth in rooms_of(out).values():
        for k, model in enumerate(truth.model_ids):
            mesh = trimesh.load(out / "models" / f"{model}.ply", process=False)
            here = trimesh.transform_points(mesh.vertices, truth.model_to_room[k].astype(float))
            center = (here.min(axis=0) + here.max(axis=0)) / 2
            np.testing.assert_allclose(center, truth.centers_m[k], atol=1e-5)
            np.testing.assert_allclose(np.ptp(here, axis=0), truth.sizes_m[k], atol=1e-5)
    header = (out / "models" / "bed.ply").read_bytes()[:400].split(b"end_header")[0].decode()
    assert "format binary_little_endian" in header
    assert [line.split()[-1] for line in header.splitlines() if line.startswith("property")] == [
        "x", "y", "z", "vertex_indices",
    ]  # fmt: skip


def test_same_seed_same_bytes_whatever_the_workers(front, tmp_path):
    three_houses(front)
    front.house("other", *(bedroom(f"Bedroom-{k}") for k in range(10)))  # more than one shard
    one, two, third = tmp_path / "one", tmp_path / "two", tmp_path / "three"
    build_shards(job(front, one, workers=1))
    build_shards(job(front, two, workers=2))
    assert len(digests(one, "train/*.h5")) == 2
    assert digests(one) == digests(two)
    build_shards(job(front, third, seed=1))
    assert digests(third, "**/*.h5") != digests(one, "**/*.h5")


def test_a_room_is_the_same_alone(front, tmp_path):
    three_houses(front)
    build_shards(job(front, tmp_path / "all"))
    build_shards(job(front, tmp_path / "one", only="house1/MasterBedroom-1"))
    build_shards(job(front, tmp_path / "id", only="house1_MasterBedroom-1"))
    build_shards(job(front, tmp_path / "house", only="house1"))
    assert list(rooms_of(tmp_path / "one")) == ["house1_MasterBedroom-1"]
    assert list(rooms_of(tmp_path / "id")) == ["house1_MasterBedroom-1"]
    assert len(rooms_of(tmp_path / "house")) == 2
    whole = rooms_of(tmp_path / "all")["house1_MasterBedroom-1"][0]
    for name in ("one", "id", "house"):
        alone = rooms_of(tmp_path / name)["house1_MasterBedroom-1"][0]
        np.testing.assert_array_equal(alone.instance_ids, whole.instance_ids)
    with pytest.raises(InputError, match="has no house 'nowhere'"):
        build_shards(job(front, tmp_path / "none", only="nowhere"))


def test_a_second_run_makes_only_what_is_missing(front, tmp_path):
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(20)))
    out = tmp_path / "shards"
    first = build_shards(job(front, out))
    assert (first.shards_made, first.shards_kept) == (4, 0)  # 18 and 2 rooms
    before = digests(out)
    times = {path: path.stat().st_mtime_ns for path in out.glob("**/*.h5")}
    second = build_shards(job(front, out))
    assert (second.shards_made, second.shards_kept) == (0, 4)
    assert {path: path.stat().st_mtime_ns for path in out.glob("**/*.h5")} == times
    (out / "train" / "bedroom_0001.h5").unlink()
    third = build_shards(job(front, out))
    assert (third.shards_made, third.shards_kept) == (1, 3)
    assert digests(out) == before


def test_other_settings_want_another_folder(front, tmp_path):
    three_houses(front)
    out = tmp_path / "shards"
    build_shards(job(front, out))
    with pytest.raises(InputError, match=r"begun with other settings \(seed differ\).*new folder"):
        build_shards(job(front, out, seed=1))
    with pytest.raises(InputError, match=r"\(recipe, renderer differ\)"):
        build_shards(job(front, out, rules=("views.per_m2=3",), renderer="pyrender"))
    front.house("house9", bedroom("Bedroom-9"))
    with pytest.raises(InputError, match=r"\(houses differ\)"):
        build_shards(job(front, out))
    (out / "plan.json").write_text("{")
    with pytest.raises(InputError, match=r"plan\.json cannot be read"):
        build_shards(job(front, out))
    (out / "plan.json").unlink()
    with pytest.raises(InputError, match=r"holds shards without a plan\.json"):
        build_shards(job(front, out))


def test_every_room_left_out_is_named_with_the_reason(front, tmp_path):
    front.list_model("ghost", "Desk")
    bed, stand = {"jid": "bed", "pos": (0, 0, -1)}, {"jid": "stand", "pos": (1.5, 0, 1.5)}
    front.house(
        "house",
        bedroom("Bedroom-1"),
        bedroom("Bedroom-2"),
        room("Bedroom-few", [bed]),
        room("Bedroom-many", [bed] + [{**stand, "pos": (1.5, 0, 0.1 * k)} for k in range(14)]),
        room("Bedroom-bedless", [stand, {**stand, "pos": (0, 0, 0)}]),
        room("Bedroom-large", [bed, stand], bounds=(-3.0, -4.0, 3.0, 4.0)),
        room("Bedroom-scaled", [bed, {**stand, "scale": [1, 9, 1]}]),
        room("Bedroom-ghost", [bed, stand, {"jid": "ghost", "pos": (1, 0, 1)}]),
        room("LivingRoom-1", [bed, stand], kind="LivingRoom"),
    )
    (front.front / "broken.json").write_text('{"scene": {"room": [')
    out = tmp_path / "shards"
    summary = build_shards(job(front, out))
    with (out / "report.csv").open() as file:
        rows = {row["room_id"]: row for row in csv.DictReader(file)}
    reasons = {name.removeprefix("house_Bedroom-"): row["reason"] for name, row in rows.items()}
    assert reasons == {
        "1": "", "2": "", "ghost": "",
        "few": "1 objects, min_objects is 2",
        "many": "15 objects, max_objects is 13",
        "bedless": "none of double_bed, single_bed, kids_bed, which required_classes asks for",
        "large": "floor 6.00 x 8.00 m, max_floor_m is 6",
        "scaled": "stand is scaled by 1, 9, 1, beyond scale_range",
        "broken": rows["broken"]["reason"],
    }  # fmt: skip
    assert rows["broken"]["status"] == "failed" and "not JSON" in rows["broken"]["reason"]
    assert "ghost is left out" in rows["house_Bedroom-ghost"]["notes"]
    assert summary.statuses == {"prepared": 3, "filtered": 5, "failed": 1}
    assert str(summary).endswith("; 5 filtered, 1 failed (report.csv says why)")
    report = json.loads((out / "report.json").read_text())
    assert report["classes"] == {"double_bed": 3, "nightstand": 6 - 1}
    # A rule that is switched off lets its rooms in.
    build_shards(job(front, tmp_path / "wide", rules=("max_floor_m=null", "max_objects=null")))
    assert "house_Bedroom-large" in rooms_of(tmp_path / "wide")


def test_a_model_that_breaks_later_is_reported(front, tmp_path):
    front.model("cut", "Desk", (1, 1, 1))
    (front.future / "cut" / "raw_model.obj").write_text("junk\n")
    bed = {"jid": "bed", "pos": (0, 0, -1)}
    front.house("house", bedroom("Bedroom-1"), bedroom("Bedroom-2"), bedroom("Bedroom-3"))
    front.house("poor", room("Bedroom-4", [bed, {"jid": "cut", "pos": (1, 0, 1)}]))
    splits = tmp_path / "splits.csv"
    splits.write_text("Bedroom-1,train\nBedroom-2,test\npoor_Bedroom-4,train\n")
    build_shards(job(front, tmp_path / "shards", splits=splits))
    with (tmp_path / "shards" / "report.csv").open() as file:
        rows = {row["room_id"]: row for row in csv.DictReader(file)}
    assert rows["poor_Bedroom-4"]["status"] == "filtered"
    assert rows["poor_Bedroom-4"]["reason"] == "1 objects, min_objects is 2"
    assert "cut/raw_model.obj holds no usable triangles" in rows["poor_Bedroom-4"]["notes"]
    assert rows["house_Bedroom-3"]["reason"] == "it is in no split"


def test_splits(front, tmp_path):
    three_houses(front)
    path = tmp_path / "splits.csv"
    path.write_text(
        "instanceid,split\nBedroom-0,train\nhouse0_MasterBedroom-0,test\nBedroom-1,val\n"
        "MasterBedroom-1,test\n"
    )

    def split_sizes(name, **changes):
        counts = build_shards(job(front, tmp_path / name, splits=path, **changes)).counts
        return [counts[split]["rooms"] for split in ("train", "test")]

    assert split_sizes("a") == [2, 2]
    assert split_sizes("b", val="test") == [1, 3]
    assert split_sizes("c", val="none") == [1, 2]
    with pytest.raises(InputError, match="'dev' is not where val rooms can go"):
        split_sizes("d", val="dev")
    path.write_text("Bedroom-0,train\n")
    with pytest.raises(InputError, match="The 'test' split is empty: none of the 1 usable rooms"):
        split_sizes("e")
    assert not (tmp_path / "e").exists()  # nothing half-written
    path.write_text("nothing\n")
    with pytest.raises(InputError, match="has no rows `room id,split`"):
        split_sizes("f")
    with pytest.raises(InputError, match="No split file can be read at"):
        build_shards(job(front, tmp_path / "g", splits=tmp_path / "none.csv"))


def test_nothing_passes(front, tmp_path):
    front.house("house", room("Bedroom-1", [{"jid": "bed", "pos": (0, 0, 0)}]))
    with pytest.raises(
        InputError, match=r"No room of .* passes the recipe.*as here: 1 objects, min_objects is 2\)"
    ):
        build_shards(job(front, tmp_path / "shards"))
    assert not (tmp_path / "shards").exists()


def test_a_folder_that_cannot_be_written(front, tmp_path):
    three_houses(front)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written \(.*\)\. Finished shards are kept"):
        build_shards(job(front, tmp_path / "file" / "shards"))


@pytest.fixture
def cli():
    app = typer.Typer()
    add_commands(app)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def test_commands(front, tmp_path, cli):
    three_houses(front)
    out, png = tmp_path / "shards", tmp_path / "pictures" / "sheet.png"
    rules = [word for rule in SMALL for word in ("--rule", rule)]
    made = cli(
        "prep-front", "--front", front.front, "--future", front.future, "--out", out,
        "--workers", 1, "--renderer", "software", "--views-per-m2", 0.7, *rules[:2], *rules[4:],
    )  # fmt: skip
    assert made.exit_code == 0, made.output
    assert "train 5 rooms, 55 views, 15 objects; test 1 rooms, 11 views, 3 objects" in made.stdout
    looked = cli("inspect", out, "--png", png, "--boxes-3d", "--pictures", 6)
    assert looked.exit_code == 0, looked.output
    assert "nightstand" in looked.stdout and "train" in looked.stdout
    assert png.read_bytes().startswith(b"\x89PNG")


def test_inspection(front, tmp_path):
    three_houses(front)
    out = tmp_path / "shards"
    build_shards(job(front, out))
    counts = count_shards(out)
    assert counts["train"]["rooms"] == 5 and counts["test"]["objects"] == 3
    assert counts["train"]["classes"] == {"nightstand": 10, "double_bed": 5}
    assert counts["train"]["seen"] == pytest.approx(
        np.mean([r.visible.sum(axis=1).mean() for r in
                 (shard.read_room(name) for shard, name in iterate_rooms(out, "train"))])
    )  # fmt: skip
    assert contact_sheet(out, pictures=4).size == contact_sheet(out, pictures=4, boxes_3d=True).size
    with pytest.raises(InputError, match="has no room 'attic'"):
        contact_sheet(out, "attic")


def test_interrupted_and_gone_on_with(front, tmp_path):
    """Ctrl-C in the middle: exit code 130, only whole shards, and the rest follows."""
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(40)))
    script = tmp_path / "run.py"
    script.write_text(
        "import typer\nfrom data_prep.cli import add_commands\n"
        "app = typer.Typer()\nadd_commands(app)\n"
        "if __name__ == '__main__':\n    app()\n"
    )
    out = tmp_path / "shards"
    command = [
        sys.executable, str(script), "prep-front", "--front", str(front.front), "--out", str(out),
        "--future", str(front.future), "--workers", "2", "--renderer", "software",
        "--views-per-m2", "3",
    ]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, text=True)
    deadline = time.monotonic() + 60
    while not list(out.glob("**/*.h5")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Stopped; finished shards are kept" in errors and "Traceback" not in errors
    assert not (out / "index.json").exists() and not list(out.glob("**/*.part"))
    kept = digests(out, "**/*.h5")
    assert 1 <= len(kept) < 6
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert f"{6 - len(kept)} shards made, {len(kept)} already there" in done.stdout
    assert digests(out, "**/*.h5").items() >= kept.items()


def shared_front() -> Path:
    folder = Path(os.environ.get("SCENEPRIOR_SHARED", Path(__file__).parents[3] / "shared"))
    folder = folder / "data" / "front"
    if not folder.is_dir():
        pytest.skip("no shared data beside the repository")
    return folder


def test_houses_made_by_others(tmp_path):
    """Ground-truth boxes, projected, agree with the boxes of masks that nothing hides."""
    folder = shared_front()
    recipe = load_recipe("front3d_bedroom", ("views.per_m2=0.5",))
    plain = FrontJob(folder / "3D-FRONT", folder / "3D-FUTURE-model", tmp_path, recipe, workers=1)
    build_shards(replace(plain, out=tmp_path / "a", only="0022c821", renderer="software"))
    ((views, truth),) = rooms_of(tmp_path / "a").values()
    assert views.room_id == "0022c821-c1f2-516e-8552-8f01efccfc26_MasterBedroom-8629"
    names = [label_set("front3d_bedroom")[c] for c in views.object_class]
    assert names.count("double_bed") == 1 and "armchair" in names and "void" not in names
    overlaps = []
    for k in range(len(names)):
        mesh = trimesh.load(tmp_path / "a" / "models" / f"{truth.model_ids[k]}.ply", process=False)
        here = trimesh.transform_points(mesh.vertices, truth.model_to_room[k].astype(float))
        for view in np.flatnonzero(views.visible[:, k]):
            pixels, nearest = projected(here, views.world_to_camera[view], views.intrinsics[view])
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            x1, y1, x2, y2 = views.boxes[view, k] * (480, 360, 480, 360)
            if nearest < 0.1 or min(low) < 0 or high[0] > 480 or high[1] > 360:
                continue
            sides = np.minimum((x2, y2), high) - np.maximum((x1, y1), low)
            both = np.prod(np.maximum(sides, 0))
            overlaps.append(both / ((x2 - x1) * (y2 - y1) + np.prod(high - low) - both))
    assert len(overlaps) > 3 and np.median(overlaps) > 0.95, overlaps
