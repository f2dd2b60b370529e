"""A folder remembers what it was begun for: the same goes on, anything else is refused."""

import json
from collections import Counter

import pytest
from front_files import bedroom, room
from front_jobs import digests, front_job, rooms_of, three_houses
from refusals import refused

from data_prep.engine.build import build_shards
from data_prep.engine.plan import house_may_match, is_asked_for, read_splits, seeded_split


def test_other_settings_want_another_folder(front, tmp_path):
    three_houses(front)
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    with refused("engine/other seed", tmp=tmp_path):
        build_shards(front_job(front, out, seed=1))
    with refused("engine/other recipe and renderer", tmp=tmp_path):
        build_shards(front_job(front, out, rules=("views.per_m2=3",), renderer="pyrender"))
    front.house("house9", bedroom("Bedroom-9"))
    with refused("engine/other houses", tmp=tmp_path):
        build_shards(front_job(front, out))
    plan = json.loads((out / "plan.json").read_text())
    plan["settings"]["plan_version"] = 1
    older = json.dumps(plan | {"rooms": [{"room_id": "a", "area_m2": 1}]})
    for name, text in (("of another release", older), ("damaged", "{")):
        (out / "plan.json").write_text(text)
        with refused(f"engine/plan {name}", tmp=tmp_path):
            build_shards(front_job(front, out))
    (out / "plan.json").unlink()
    with refused("engine/shards without a plan", tmp=tmp_path):
        build_shards(front_job(front, out))


def test_a_damaged_house_is_downloaded_again_and_retried(front, tmp_path):
    three_houses(front)
    damaged, sound = front.front / "house1.json", front.front / "house0.json"
    out, whole, other = tmp_path / "shards", damaged.read_text(), sound.read_text()
    damaged.write_text(whole[:200])
    first = build_shards(front_job(front, out))
    assert first.statuses == {"prepared": 4, "failed": 1}
    before = rooms_of(out)
    damaged.write_text(whole)
    assert build_shards(front_job(front, out)).statuses == first.statuses

    def others_are_refused(path, text):
        path.write_text(text + "\n")
        for is_retried in (False, True):
            with refused("engine/other houses", tmp=tmp_path):
                build_shards(front_job(front, out, retry_failed=is_retried))
        path.write_text(text)

    others_are_refused(sound, other)
    room_alone = {"only": "house1/Bedroom-1", "retry_failed": True}
    assert build_shards(front_job(front, out, **room_alone)).statuses == {"prepared": 1}
    others_are_refused(damaged, whole)
    again = build_shards(front_job(front, out, retry_failed=True))
    assert again.statuses == {"prepared": 6}
    assert set(rooms_of(out)) == {*before, "house1_Bedroom-1", "house1_MasterBedroom-1"}
    assert build_shards(front_job(front, out, retry_failed=True)).shards_made == 0
    others_are_refused(damaged, whole)


def test_a_house_with_sound_rooms_may_not_change(front, tmp_path):
    three_houses(front)
    path, out = front.front / "house1.json", tmp_path / "shards"
    house = json.loads(path.read_text())
    house["scene"]["room"].append(3)
    path.write_text(json.dumps(house))
    assert build_shards(front_job(front, out)).statuses == {"prepared": 6, "failed": 1}
    path.write_text(json.dumps(house) + "\n")
    with refused("engine/other houses", tmp=tmp_path):
        build_shards(front_job(front, out))


def test_a_damaged_house_may_be_deleted(front, tmp_path):
    three_houses(front)
    path, out = front.front / "house1.json", tmp_path / "shards"
    path.write_text("{")
    build_shards(front_job(front, out))
    path.unlink()
    for is_retried in (False, True, False):
        summary = build_shards(front_job(front, out, retry_failed=is_retried))
    assert summary.statuses == {"prepared": 4}


def test_other_settings_are_refused_beside_a_damaged_file(front, tmp_path):
    three_houses(front)
    (front.front / "views.json").write_text("{")
    build_shards(front_job(front, tmp_path / "shards"))
    with refused("engine/other recipe and renderer", tmp=tmp_path):
        job = {"rules": ("views.per_m2=3",), "renderer": "pyrender"}
        build_shards(front_job(front, tmp_path / "shards", **job))


def test_only_works_on_a_part_of_a_folder_that_was_begun_for_everything(front, tmp_path):
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(20)))
    out = tmp_path / "shards"
    first = build_shards(front_job(front, out))
    assert (first.shards_made, first.shards_kept) == (4, 0)  # 18 and 2 rooms
    expected = digests(out)
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    again = build_shards(front_job(front, out))
    assert (again.shards_made, again.shards_kept) == (0, 4)
    build_shards(front_job(front, out, only="house/Bedroom-3"))
    # Not one file is written again, so a finished folder may be read-only.
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == times
    for name in ("train/bedroom_0001.h5", "test/bedroom_0000.h5"):
        (out / name).unlink()
    plan = json.loads((out / "plan.json").read_text())
    asked = [room["room_id"] for room in plan["rooms"] if room["split"] == "train"][9]
    part = build_shards(front_job(front, out, only=asked.replace("_", "/", 1)))
    assert (part.shards_made, part.shards_kept, part.shards_open) == (1, 2, 1)
    assert part.statuses == {"prepared": 1} and part.report["rooms"][0]["room_id"] == asked
    assert asked in rooms_of(out)
    assert not (out / "index.json").exists() and not (out / "report.json").exists()
    with refused("engine/only of no room of the plan"):
        build_shards(front_job(front, out, only="house/attic"))
    assert build_shards(front_job(front, out)).shards_made == 1
    assert digests(out) == expected
    # The other way round it is another job.
    alone = tmp_path / "alone"
    build_shards(front_job(front, alone, only=asked))
    with refused("engine/everything in a folder of a part", tmp=tmp_path):
        build_shards(front_job(front, alone))


@pytest.mark.parametrize(
    ("only", "room_id", "house", "asked"),
    [
        (None, "abc_Bedroom-1", "abc", True),
        ("abc", "abc_Bedroom-1", "abc", True),
        ("ab", "abc_Bedroom-1", "abc", True),
        ("b", "abc_Bedroom-1", "abc", False),
        ("abc_Bedroom-1", "abc_Bedroom-1", "abc", True),
        ("ab/Bedroom-1", "abc_Bedroom-1", "abc", True),
        ("ab/Bedroom", "abc_Bedroom-1", "abc", False),
        ("scene0000_00", "scene0000_00", "scene0000_00", True),
    ],
)
def test_only_names_a_house_or_a_room(only, room_id, house, asked):
    assert is_asked_for(only, room_id, house) == asked
    assert house_may_match(only, house) or not asked


def test_a_seeded_split_keeps_its_order_and_takes_val_from_training_rooms():
    ids = [f"room{k}" for k in range(40)]
    two, three = seeded_split(ids, 0), seeded_split(ids, 0, val_share=0.1)
    assert two == seeded_split(ids[::-1], 0) != seeded_split(ids, 1)
    assert Counter(three.values()) == {"train": 32, "val": 4, "test": 4}
    assert all(two[room] == split for room, split in three.items() if split != "val")
    # A smaller data set draws its test rooms from the same order.
    tests = {room_id for room_id in ids if two[room_id] == "test"}
    fewer = seeded_split([*sorted(tests), *sorted(set(ids) - tests)[:16]], 0)
    assert {room_id for room_id, name in fewer.items() if name == "test"} < tests
    # Of a few rooms each split has one, as long as one is left to train on.
    few = Counter(seeded_split(ids[:3], 0, val_share=0.1).values())
    assert few == {"train": 1, "val": 1, "test": 1}
    assert seeded_split(["alone"], 0) == {"alone": "train"}
    assert set(seeded_split(ids, 0, test_share=0).values()) == {"train"}


def test_splits(front, tmp_path):
    three_houses(front)
    path = tmp_path / "splits.csv"

    def split_sizes(name, text):
        path.write_text(text)
        counts = build_shards(front_job(front, tmp_path / name, splits=path)).counts
        return [counts[split]["rooms"] for split in ("train", "val", "test")]

    text = "instanceid,split\nBedroom-0,train\nhouse0_MasterBedroom-0,test\nBedroom-1,val\n"
    assert split_sizes("a", f"{text}MasterBedroom-1,test\n") == [1, 1, 2]
    assert split_sizes("b", "Bedroom-0,train\n") == [1, 0, 0]  # enough to train on
    lines = [f"{at[0]},cam_00,{k},,{at[1:]}" for at in ("atrain", "bval", "c") for k in "01"]
    header = "\ufeffscene_name,camera_name,frame_id,exclude_reason,split_partition_name"
    path.write_text("\n".join([header, *lines]))
    assert read_splits(path) == {"a": "train", "b": "val"}  # Hypersim's columns
    for name, text in (
        ("no train", "Bedroom-0,test\n"), ("no rows", "nothing\n"),
        ("two splits", "Bedroom-0,train\nBedroom-0,x,test\n"),
    ):  # fmt: skip
        with refused(f"engine/splits with {name}", tmp=tmp_path):
            split_sizes("e", text)
    assert not (tmp_path / "e").exists()  # nothing half-written
    with refused("engine/no splits", tmp=tmp_path):
        build_shards(front_job(front, tmp_path / "g", splits=tmp_path / "none.csv"))


def test_nothing_passes(front, tmp_path):
    front.house("house", room("Bedroom-1", [{"jid": "bed", "pos": (0, 0, 0)}]))
    with refused("engine/no room passes", tmp=tmp_path):
        build_shards(front_job(front, tmp_path / "shards"))
    with refused("engine/only of no house", tmp=tmp_path):
        build_shards(front_job(front, tmp_path / "shards", only="nowhere"))
    assert not (tmp_path / "shards").exists()
