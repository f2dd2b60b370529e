"""A shard: an error in a room concerns that room alone, and is reported with the room's name."""

import csv
import json

import pytest
from front_files import bedroom, room
from front_jobs import digests, front_job, rooms_of
from toy_source import ToySource

from data_prep.engine.build import Job, build_shards, read_finished
from sceneprior.core.errors import InputError
from sceneprior.core.shards import read_index

FAILURES = {
    1: ("sentence", "its file is truncated"),
    2: ("unforeseen", "unforeseen KeyError: 'surprise'"),
    3: ("unreadable", "/nowhere/at/all cannot be read (No such file or directory)"),
    5: ("shapes", "box, room box_5: boxes has shape"),
}
TROUBLE = {number: what for number, (what, _) in FAILURES.items()} | {8: "filtered"}


def test_a_source_that_draws_nothing_comes_through_the_same_door(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    summary = build_shards(Job(ToySource(), one))
    assert summary.renderer is None and summary.statuses == {"prepared": 10, "filtered": 1}
    assert [path.name for path in sorted(one.glob("*/*.h5"))] == [
        "toys_0000.h5", "toys_0000.h5",
    ]  # fmt: skip
    index = read_index(one)
    assert (index["source"], index["renderer"], index["seed"]) == ("toy", None, None)
    assert len(list((one / "rgb").iterdir())) == 10 and (one / "models" / "toy.ply").is_file()
    build_shards(Job(ToySource(), two, workers=2))
    assert digests(one) == digests(two)
    with pytest.raises(InputError, match=r"other settings \(source, rooms differ\)"):
        build_shards(Job(ToySource(11, name="other"), one))


def test_each_room_fails_for_itself(tmp_path):
    out = tmp_path / "shards"
    summary = build_shards(Job(ToySource(trouble=TROUBLE), out))
    assert summary.statuses == {"prepared": 5, "filtered": 2, "failed": 4}
    assert sorted(rooms_of(out)) == ["box_0", "box_4", "box_6", "box_7", "box_9"]
    lines = {line["room_id"]: line for line in summary.report["rooms"]}
    for number, (_, sentence) in FAILURES.items():
        line = lines[f"box_{number}"]
        assert line["status"] == "failed" and sentence in line["reason"]
    assert lines["box_8"]["rule"] == "light" and lines["box_8"]["split"] == "train"
    assert list(summary.report["filtered"]) == ["light", "odd"]


def test_failed_rooms_are_tried_again_when_asked(tmp_path):
    out, whole = tmp_path / "shards", tmp_path / "whole"
    build_shards(Job(ToySource(), whole))
    build_shards(Job(ToySource(trouble={4: "unreadable", 2: "filtered"}), out))
    assert build_shards(Job(ToySource(), out)).shards_made == 0
    again = build_shards(Job(ToySource(), out, retry_failed=True))
    assert (again.shards_made, again.shards_kept) == (1, 1)
    assert again.statuses == {"prepared": 9, "filtered": 2}


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


def test_a_model_that_breaks_later_is_reported(front, tmp_path):
    front.model("cut", "Desk", (1, 1, 1))
    (front.future / "cut" / "raw_model.obj").write_text("junk\n")
    bed = {"jid": "bed", "pos": (0, 0, -1)}
    front.house("house", bedroom("Bedroom-1"), bedroom("Bedroom-2"), bedroom("Bedroom-3"))
    front.house("poor", room("Bedroom-4", [bed, {"jid": "cut", "pos": (1, 0, 1)}]))
    splits = tmp_path / "splits.csv"
    splits.write_text("Bedroom-1,train\nBedroom-2,test\npoor_Bedroom-4,train\n")
    build_shards(front_job(front, tmp_path / "shards", splits=splits))
    with (tmp_path / "shards" / "report.csv").open() as file:
        rows = {row["room_id"]: row for row in csv.DictReader(file)}
    assert rows["poor_Bedroom-4"]["status"] == "filtered"
    assert rows["poor_Bedroom-4"]["reason"] == "1 objects, min_objects is 2"
    assert "cut/raw_model.obj holds no usable triangles" in rows["poor_Bedroom-4"]["notes"]
    assert rows["house_Bedroom-3"]["reason"] == "it is in no split"


def test_a_house_that_is_cut_off_meanwhile_costs_its_own_rooms_only(front, tmp_path):
    front.house("cut", bedroom("Bedroom-1"), bedroom("Bedroom-2"))
    front.house("good", bedroom("Bedroom-3"), bedroom("Bedroom-4"), bedroom("Bedroom-5"))
    splits = tmp_path / "splits.csv"
    splits.write_text("".join(f"Bedroom-{k},{'test' if k == 5 else 'train'}\n" for k in range(6)))
    job = front_job(front, tmp_path / "shards", splits=splits)
    build_shards(job)
    (job.out / "train" / "bedroom_0000.h5").unlink()
    text = (front.front / "cut.json").read_bytes()
    (front.front / "cut.json").write_bytes(b"{" * len(text))  # the size is what a folder remembers
    summary = build_shards(job)
    assert summary.statuses == {"prepared": 3, "failed": 2}
    report = json.loads((job.out / "report.json").read_text())
    assert {item["room_id"] for item in report["failed"]} == {"cut_Bedroom-1", "cut_Bedroom-2"}
    assert all("cut.json is not JSON" in item["reason"] for item in report["failed"])


def test_debugging_lets_the_unforeseen_through(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENEPRIOR_DEBUG", "1")
    with pytest.raises(KeyError, match="surprise"):
        build_shards(Job(ToySource(trouble={2: "unforeseen"}), tmp_path / "shards"))
