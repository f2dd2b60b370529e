"""A report one can trust: every room, every reason, every count."""

import csv
import json
from dataclasses import replace

import pytest
from front_files import bedroom, room
from front_jobs import front_job, rooms_of, three_houses
from rich.console import Console

from data_prep.engine.build import build_shards
from data_prep.engine.report import compare, make_report, report_tables
from data_prep.engine.source import Expected, Line
from data_prep.front.recipe import load_recipe
from sceneprior.core.errors import InputError
from sceneprior.core.shards import read_index


def test_every_room_left_out_is_named_with_the_reason(front, tmp_path):
    front.list_model("ghost", "Desk")
    bed, stand = {"jid": "bed", "pos": (0, 0, -1)}, {"jid": "stand", "pos": (1.5, 0, 1.5)}
    front.house(
        "house",
        bedroom("Bedroom-1"),
        bedroom("Bedroom-2"),
        room("Bedroom-few", [bed]),
        room("Bedroom-large", [bed, stand], bounds=(-3.0, -4.0, 3.0, 4.0)),
        room("Bedroom-ghost", [bed, stand, {"jid": "ghost", "pos": (1, 0, 1)}]),
        room("LivingRoom-1", [bed, stand], kind="LivingRoom"),
    )
    (front.front / "broken.json").write_text('{"scene": {"room": [')
    out = tmp_path / "shards"
    summary = build_shards(front_job(front, out))
    with (out / "report.csv").open() as file:
        rows = {row["room_id"]: row for row in csv.DictReader(file)}
    reasons = {name.removeprefix("house_Bedroom-"): row["reason"] for name, row in rows.items()}
    assert reasons == {
        "1": "", "2": "", "ghost": "",
        "few": "1 objects, min_objects is 2",
        "large": "floor 6.00 x 8.00 m, max_floor_m is 6",
        "broken": rows["broken"]["reason"],
    }  # fmt: skip
    assert rows["broken"]["status"] == "failed" and "not JSON" in rows["broken"]["reason"]
    assert "'ghost' is left out" in rows["house_Bedroom-ghost"]["notes"]
    assert summary.statuses == {"prepared": 3, "filtered": 2, "failed": 1}
    assert str(summary).endswith("; 2 filtered, 1 failed (report.csv says why)")
    report = json.loads((out / "report.json").read_text())
    assert report["classes"] == {"double_bed": 3, "nightstand": 6 - 1}
    # A rule that is switched off lets its rooms in.
    build_shards(front_job(front, tmp_path / "wide", rules=("max_floor_m=null",)))
    assert "house_Bedroom-large" in rooms_of(tmp_path / "wide")


def test_the_figures_are_those_of_the_rooms():
    lines = [
        Line("a", "h", "prepared", split="train", views=4, objects=2, visible=6,
             classes={"bed": 1, "lamp": 1}),
        Line("b", "h", "prepared", split="train", views=2, objects=3, visible=3,
             classes={"bed": 3}, notes=["x is left out"]),
        Line("c", "h", "prepared", split="test", views=5, objects=1, visible=5,
             classes={"lamp": 1}),
        Line("d", "h", "filtered", rule="max_objects", reason="14 objects"),
        Line("e", "g", "failed", reason="it has no floor"),
        Line("f", "g", "filtered", rule="max_objects", reason="15 objects"),
    ]  # fmt: skip
    report = make_report(
        lines, {"source": "toy"}, Expected(of="a paper", rooms=3, test=2, views=12)
    )
    assert report["source"] == "toy" and report["found"] == 6 and report["with_notes"] == 1
    assert report["statuses"] == {"failed": 1, "filtered": 2, "prepared": 3}
    assert report["filtered"] == {"max_objects": {"rooms": 2, "room_ids": ["d", "f"]}}
    assert report["failed"] == [{"room_id": "e", "house": "g", "reason": "it has no floor"}]
    assert report["counts"]["train"] == {"rooms": 2, "views": 6, "objects": 5}
    assert report["per_split"]["train"] == {
        "views_per_room": 3.0,
        "objects_per_room": 2.5,
        "objects_per_view": 1.5,
        "rooms_of_so_many_objects": {"2": 1, "3": 1},
        "classes": {"bed": 4, "lamp": 1},
    }
    assert report["classes"] == {"bed": 4, "lamp": 2}
    assert report["expected"]["rows"] == [
        {"what": "rooms", "expected": 3, "found": 3, "difference": 0},
        {"what": "test", "expected": 2, "found": 1, "difference": -1},
        {"what": "views", "expected": 12, "found": 11, "difference": -1},
    ]
    assert [item["room_id"] for item in report["rooms"]] == list("abcdef")
    console = Console(width=120, record=True)
    for table in report_tables(report):
        console.print(table)
    said = console.export_text()
    for words in ("filtered by max_objects", "it has no floor", "as expected", "-1", "a paper"):
        assert words in said, words
    assert compare(Expected(), []) == []


def test_what_a_recipe_expects_is_compared_and_decides_nothing(front, tmp_path, monkeypatch):
    three_houses(front)
    job = front_job(front, tmp_path / "shards")
    build_shards(job)
    assert "expected" not in json.loads((job.out / "report.json").read_text())
    assert "expected" not in read_index(job.out)["recipe"]
    counts = Expected(of="this test", rooms=7, train=4, val=2)
    recipe = job.source.recipe.model_copy(update={"expected": counts})
    summary = build_shards(replace(job, source=replace(job.source, recipe=recipe)))
    assert summary.shards_made == 0
    report = json.loads((job.out / "report.json").read_text())
    assert [row["difference"] for row in report["expected"]["rows"]] == [-1, 0, -1]
    # From the recipe's file, where a wrong name is told.
    monkeypatch.setattr("data_prep.front.recipe.FOLDER", tmp_path)
    text = "label_set: front3d_bedroom\nroom_types: [bedroom]\n"
    (tmp_path / "mine.yaml").write_text(text + "expected: {of: me, rooms: 7}\n")
    assert load_recipe("mine").expected == Expected(of="me", rooms=7)
    (tmp_path / "mine.yaml").write_text(text + "expected: {chairs: 7}\n")
    with pytest.raises(InputError, match=r"mine\.yaml: unknown key 'expected\.chairs'"):
        load_recipe("mine")
