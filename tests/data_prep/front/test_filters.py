"""Rules that leave rooms out: each does so alone, names itself, and says with what numbers."""

import pytest
from front_files import bedroom, room
from front_jobs import front_job

from data_prep.engine.build import build_shards
from data_prep.engine.report_tables import report_tables
from sceneprior.core.shards import read_index

BED = {"jid": "bed", "pos": (0.0, 0.0, -1.0)}
STAND = {"jid": "stand", "pos": (-1.4, 0.0, -1.8)}
OUTSIDE = {"jid": "stand", "pos": (3.4, 0.0, 0.0)}
HIGH = {"jid": "stand", "pos": (0.0, 3.6, 1.0)}
SUNK = {"jid": "stand", "pos": (0.0, -0.01, 1.0)}
GONE = [{"jid": f"gone{k}", "pos": (0.3 * k, 0.0, 1.0)} for k in range(3)]


def prepared(front, tmp_path, pieces, *rules, out="shards"):
    """The lines of a room of these pieces, and of a good one, under the rules."""
    front.house("house", room("Bedroom-1", pieces), bedroom("Bedroom-2"))
    splits = tmp_path / "splits.csv"
    splits.write_text("Bedroom-1,train\nBedroom-2,train\n")
    job = front_job(front, tmp_path / out, rules=rules, splits=splits)
    summary = build_shards(job)
    lines = {line.room_id: line for line in summary.lines}
    assert lines["house_Bedroom-2"].status == "prepared"
    return lines["house_Bedroom-1"], summary.report


@pytest.mark.parametrize(
    ("pieces", "rule", "said"),
    [
        (
            [BED, OUTSIDE, OUTSIDE | {"pos": (3.4, 0.0, 1.0)}],
            "min_inside_floor=0.5",
            "2 of its 3 pieces stand outside of the floor, min_inside_floor is 0.5",
        ),
        (
            [BED, STAND, *GONE],
            "min_models_share=0.5",
            "there are models of 2 of its 5 pieces, min_models_share is 0.5",
        ),
        (
            [BED, STAND, HIGH],
            "furniture_between_m=[-0.005, 4.0]",
            "its furniture reaches from 0.000 to 4.20 m above the floor, furniture_between_m is "
            "-0.005 to 4",
        ),
        (
            [BED, STAND, SUNK],
            "furniture_between_m=[-0.005, 4.0]",
            "its furniture reaches from -0.010 to 1.00 m above the floor, furniture_between_m is "
            "-0.005 to 4",
        ),
        ([BED, STAND], "invalid_rooms=[Bedroom-1]", "it is among the invalid_rooms"),
        ([BED, STAND], "invalid_rooms=[house_Bedroom-1]", "it is among the invalid_rooms"),
        (
            [BED, STAND, {"jid": "pendant", "pos": (0.0, 2.0, 0.0)}],
            "invalid_models=[pendant]",
            "'pendant' is among the invalid_models",
        ),
        (
            [BED, STAND, {"jid": "pendant", "pos": (0.0, 2.0, 0.0)}],
            "allowed_categories=[king-size bed, nightstand, floor lamp]",
            "'pendant lamp' is not among allowed_categories",
        ),
    ],
)
def test_rules(front, tmp_path, pieces, rule, said):
    off = "min_inside_floor=null", "min_models_share=null", "max_height_m=null"
    line, report = prepared(front, tmp_path, pieces, *off, rule)
    name = rule.partition("=")[0]
    assert (line.status, line.rule, line.reason) == ("filtered", name, said)
    assert report["filtered"][name]["room_ids"] == ["house_Bedroom-1"]
    line, _ = prepared(front, tmp_path, pieces, *off, f"{name}=null", out="without")
    assert line.status == "prepared"


@pytest.mark.parametrize(
    ("piece", "rule", "said"),
    [
        ({"jid": "piano"}, "allowed", "'grand piano' is not among allowed_categories"),
        (
            {"jid": "far", "entry": {"category": "Grand / Piano"}},
            "allowed",
            "'grand/piano' is not among",
        ),
        ({"jid": "far"}, "allowed", "'others' is not among allowed_categories"),
        ({"jid": "known"}, "invalid_models", "'known' is among the invalid_models"),
        ({"jid": "known"}, "", ""),
    ],
)
def test_a_piece_without_a_model_is_judged_as_the_others_are(front, tmp_path, piece, rule, said):
    """The model `far` is not in the release's list."""
    front.list_model("piano", "Grand Piano")
    front.list_model("known", "Nightstand")
    rules = ["min_models_share=null", "allowed_categories=[king-size bed, nightstand, floor lamp]"]
    if rule == "invalid_models":
        rules.append("invalid_models=[known]")
    pieces = [BED, STAND, piece | {"pos": (0.0, 0.0, 1.0)}]
    line, _ = prepared(front, tmp_path, pieces, *rules)
    assert line.status == ("filtered" if said else "prepared")
    assert said in line.reason and line.rule.startswith(rule)


def test_what_is_outside_or_missing_is_noted_and_counted(front, tmp_path):
    line, report = prepared(front, tmp_path, [BED, STAND, OUTSIDE, GONE[0]])
    assert line.status == "prepared"
    assert "1 of 3 pieces stand outside of the floor" in line.notes
    assert report["notes"] == {
        "... is left out: the models folder has no raw_model.obj for it": 1,
        "... of ... pieces stand outside of the floor": 1,
    }
    (table,) = (t for t in report_tables(report) if t.columns[0].header == "note of prepared rooms")
    assert table.row_count == 2


def test_long_lists_of_what_is_invalid_are_stored_as_a_digest(front, tmp_path):
    prepared(front, tmp_path, [BED, STAND], "invalid_models=[none of these]")
    recipe = read_index(tmp_path / "shards")["recipe"]
    assert recipe["invalid_rooms"] is None and len(recipe["invalid_models"]) == 16
