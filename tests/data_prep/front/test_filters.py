"""Rules that leave rooms out: each does so alone, names itself, and says with what numbers."""

import pytest
from front_files import bedroom, room
from front_jobs import front_job
from front_reading import read

from data_prep.engine.build import build_shards
from data_prep.engine.report import report_tables
from data_prep.front.furnished import broken_rule
from data_prep.front.recipe import load_recipe
from sceneprior.core.shards import read_index

BED = {"jid": "bed", "pos": (0.0, 0.0, -1.0)}
STAND = {"jid": "stand", "pos": (-1.4, 0.0, -1.8)}
OUTSIDE = {"jid": "stand", "pos": (3.4, 0.0, 0.0)}
HIGH = {"jid": "stand", "pos": (0.0, 3.6, 1.0)}
SUNK = {"jid": "stand", "pos": (0.0, -0.01, 1.0)}
PENDANT = {"jid": "pendant", "pos": (0.0, 2.0, 0.0)}
GONE = [{"jid": f"gone{k}", "pos": (0.3 * k, 0.0, 1.0)} for k in range(3)]
MANY = [{"jid": "stand", "pos": (0.1 * k, 0.0, 1.0)} for k in range(13)]
OPTIONAL = (
    "min_objects", "max_objects", "max_floor_m", "max_height_m", "required_classes", "scale_range",
    "min_inside_floor", "min_models_share",
)  # fmt: skip


def prepared(front, tmp_path, pieces, *rules):
    """The lines of a room of these pieces, and of a good one, under the rules."""
    front.house("house", room("Bedroom-1", pieces), bedroom("Bedroom-2"))
    splits = tmp_path / "splits.csv"
    splits.write_text("Bedroom-1,train\nBedroom-2,train\n")
    job = front_job(front, tmp_path / "shards", rules=rules, splits=splits)
    summary = build_shards(job)
    lines = {line.room_id: line for line in summary.lines}
    assert lines["house_Bedroom-2"].status == "prepared"
    return lines["house_Bedroom-1"], summary.report


def broken(front, pieces, *rules, wall_m=2.6, **changes):
    """The rule that a room of these pieces breaks, and why; None if it is used."""
    written = room("Bedroom-1", pieces, **changes)
    wall = written["_meshes"][1]["xyz"]
    wall[7] = wall[10] = wall_m
    result = read(front, front.house("house", written), rules)
    if result.filtered:
        return result.filtered[0][1:]
    return broken_rule(result.rooms[0], load_recipe("bedroom", rules))


@pytest.mark.parametrize(
    ("pieces", "changes", "rule", "said"),
    [
        ([BED], {}, "min_objects=2", "1 objects, min_objects is 2"),
        ([BED, *MANY], {}, "max_objects=13", "14 objects, max_objects is 13"),
        ([BED, STAND], {"bounds": (-3.1, -2, 3.1, 2)}, "max_floor_m=6",
         "floor 6.20 x 4.00 m, max_floor_m is 6"),
        ([BED, STAND], {"wall_m": 4.2}, "max_height_m=4", "height 4.20 m, max_height_m is 4"),
        ([STAND, STAND | {"pos": (0, 0, 0)}], {}, "required_classes=[double_bed, kids_bed]",
         "none of double_bed, kids_bed, of which required_classes needs one"),
        ([BED | {"scale": [9, 1, 1]}, STAND], {}, "scale_range=[0.2, 5]",
         "'bed' is scaled by 9, 1, 1, beyond scale_range"),
        ([BED, OUTSIDE, OUTSIDE | {"pos": (3.4, 0.0, 1.0)}], {}, "min_inside_floor=0.5",
         "2 of its 3 pieces stand outside of the floor, min_inside_floor is 0.5"),
        ([BED, STAND, *GONE], {}, "min_models_share=0.5",
         "there are models of 2 of its 5 pieces, min_models_share is 0.5"),
        ([BED, STAND, HIGH], {}, "furniture_between_m=[-0.005, 4.0]",
         "its furniture reaches from 0.000 to 4.20 m above the floor, furniture_between_m is "
         "-0.005 to 4"),
        ([BED, STAND, SUNK], {}, "furniture_between_m=[-0.005, 4.0]",
         "its furniture reaches from -0.010 to 1.00 m above the floor, furniture_between_m is "
         "-0.005 to 4"),
        ([BED, STAND], {}, "invalid_rooms=[Bedroom-1]", "it is among the invalid_rooms"),
        ([BED, STAND], {}, "invalid_rooms=[house_Bedroom-1]", "it is among the invalid_rooms"),
        ([BED, STAND, PENDANT], {}, "invalid_models=[pendant]",
         "'pendant' is among the invalid_models"),
        ([BED, STAND, PENDANT], {}, "allowed_categories=[king-size bed, nightstand, floor lamp]",
         "'pendant lamp' is not among allowed_categories"),
    ],
)  # fmt: skip
def test_each_rule_leaves_a_room_out_by_name_and_can_be_switched_off(
    front, pieces, changes, rule, said
):
    name = rule.partition("=")[0]
    off = [f"{each}=null" for each in OPTIONAL if each != name]
    assert broken(front, pieces, *off, rule, **changes) == (name, said)
    assert broken(front, pieces, *off, f"{name}=null", **changes) is None


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
def test_a_piece_without_a_model_is_judged_as_the_others_are(front, piece, rule, said):
    """The model `far` is not in the release's list."""
    front.list_model("piano", "Grand Piano")
    front.list_model("known", "Nightstand")
    rules = ["min_models_share=null", "allowed_categories=[king-size bed, nightstand, floor lamp]"]
    if rule == "invalid_models":
        rules.append("invalid_models=[known]")
    found = broken(front, [BED, STAND, piece | {"pos": (0.0, 0.0, 1.0)}], *rules)
    if said:
        assert said in found[1] and found[0].startswith(rule)
    else:
        assert found is None


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
