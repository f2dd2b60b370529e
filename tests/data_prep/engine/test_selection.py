"""Selection of rooms, and the split of each room."""

from collections import Counter

import pytest
from front_files import room
from front_jobs import front_job, three_houses

from data_prep.engine.build import build_shards
from data_prep.engine.plan import house_may_match, is_asked_for, seeded_split
from sceneprior.core.errors import InputError
from sceneprior.core.shards import list_shards


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


def test_a_seeded_split_is_nine_to_one_and_keeps_its_order():
    ids = [f"room{k}" for k in range(40)]
    split = seeded_split(ids, 0)
    tests = {room_id for room_id in ids if split[room_id] == "test"}
    assert len(tests) == 4 and split == seeded_split(ids[::-1], 0) != seeded_split(ids, 1)
    # A smaller data set draws its test rooms from the same order.
    fewer = seeded_split([*sorted(tests), *sorted(set(ids) - tests)[:16]], 0)
    assert {room_id for room_id, name in fewer.items() if name == "test"} < tests
    assert seeded_split(["alone"], 0) == {"alone": "train"}


def test_a_seeded_split_keeps_val_apart_and_takes_it_from_training_rooms():
    ids = [f"room{k}" for k in range(40)]
    two, three = seeded_split(ids, 0), seeded_split(ids, 0, val_share=0.1)
    assert Counter(three.values()) == {"train": 32, "val": 4, "test": 4}
    assert all(two[room] == split for room, split in three.items() if split != "val")
    assert {two[room] for room, split in three.items() if split == "val"} == {"train"}
    # Of a few rooms each split has one, as long as one is left to train on.
    assert Counter(seeded_split(ids[:3], 0, val_share=0.1).values()) == dict.fromkeys(
        ("train", "val", "test"), 1
    )
    assert Counter(seeded_split(ids[:2], 0, val_share=0.1).values()) == {"train": 1, "test": 1}
    assert set(seeded_split(ids, 0, test_share=0).values()) == {"train"}


def test_splits(front, tmp_path):
    three_houses(front)
    path = tmp_path / "splits.csv"
    path.write_text(
        "instanceid,split\nBedroom-0,train\nhouse0_MasterBedroom-0,test\nBedroom-1,val\n"
        "MasterBedroom-1,test\n"
    )

    def split_sizes(name, **changes):
        counts = build_shards(front_job(front, tmp_path / name, splits=path, **changes)).counts
        return [counts[split]["rooms"] for split in ("train", "val", "test")]

    assert split_sizes("a") == [1, 1, 2]
    assert [len(list_shards(tmp_path / "a", split)) for split in ("train", "val", "test")] == [
        1
    ] * 3
    path.write_text(path.read_text().replace("val", "train"))
    assert split_sizes("b") == [2, 0, 2]  # nobody needs val rooms
    path.write_text("Bedroom-0,train\n")
    assert split_sizes("c") == [1, 0, 0]  # enough to train on
    path.write_text("Bedroom-0,test\n")
    with pytest.raises(InputError, match="The 'train' split is empty: none of the 1 usable rooms"):
        split_sizes("e")
    assert not (tmp_path / "e").exists()  # nothing half-written
    path.write_text("nothing\n")
    with pytest.raises(InputError, match="has no rows `room id,split`"):
        split_sizes("f")
    with pytest.raises(InputError, match="No split file can be read at"):
        build_shards(front_job(front, tmp_path / "g", splits=tmp_path / "none.csv"))


def test_nothing_passes(front, tmp_path):
    front.house("house", room("Bedroom-1", [{"jid": "bed", "pos": (0, 0, 0)}]))
    with pytest.raises(
        InputError,
        match=r"No room of .* passes the recipe.*frequent reason: 1 objects, min_objects is 2\)",
    ):
        build_shards(front_job(front, tmp_path / "shards"))
    assert not (tmp_path / "shards").exists()
