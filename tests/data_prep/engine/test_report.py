"""A report one can trust: every room, every reason, every count."""

import csv
import json

from front_files import bedroom, room
from front_jobs import front_job, rooms_of
from golden_values import hold
from rich.console import Console

from data_prep.engine.build import build_shards
from data_prep.engine.report import make_report, report_tables
from data_prep.engine.source import Line


def test_every_room_left_out_is_named_with_the_reason(front, tmp_path):
    front.list_model("ghost", "Desk")
    front.model("cut", "Desk", (1, 1, 1))
    (front.future / "cut" / "raw_model.obj").write_text("junk\n")  # found when it is drawn
    bed, stand = {"jid": "bed", "pos": (0, 0, -1)}, {"jid": "stand", "pos": (1.5, 0, 1.5)}
    front.house(
        "house",
        bedroom("Bedroom-1"),
        bedroom("Bedroom-2"),
        room("Bedroom-few", [bed]),
        room("Bedroom-large", [bed, stand], bounds=(-3.0, -4.0, 3.0, 4.0)),
        room("Bedroom-ghost", [bed, stand, {"jid": "ghost", "pos": (1, 0, 1)}]),
        room("Bedroom-cut", [bed, {"jid": "cut", "pos": (1, 0, 1)}]),
        room("LivingRoom-1", [bed, stand], kind="LivingRoom"),
    )
    (front.front / "broken.json").write_text('{"scene": {"room": [')
    out = tmp_path / "shards"
    summary = build_shards(front_job(front, out))
    with (out / "report.csv").open() as file:
        rows = {row["room_id"]: row for row in csv.DictReader(file)}
    said = {name: [row["status"], row["reason"], row["notes"]] for name, row in rows.items()}
    hold("report", {"rows": said, "summary": str(summary)}, tmp=tmp_path)
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
    report = make_report(lines, {"source": "toy"})
    assert report["counts"]["train"] == {"rooms": 2, "views": 6, "objects": 5}
    assert report["per_split"]["train"]["objects_per_view"] == 1.5
    console = Console(width=120, record=True)
    for table in report_tables(report):
        console.print(table)
    hold("report", {"figures": report, "printed": console.export_text().splitlines()}, slack=1e-9)
