"""Rules that leave rooms out: each does so alone, names itself, and says with what numbers."""

import pytest
from front_files import bedroom, room
from front_jobs import front_job
from front_reading import read
from golden_values import hold

from data_prep.engine.build import build_shards
from data_prep.engine.report import report_tables
from data_prep.front.recipe import broken_rule, load_recipe
from sceneprior.core.shards import read_index

BED = {"jid": "bed", "pos": (0.0, 0.0, -1.0)}
STAND = {"jid": "stand", "pos": (-1.4, 0.0, -1.8)}
OUTSIDE = {"jid": "stand", "pos": (3.4, 0.0, 0.0)}
HIGH = {"jid": "stand", "pos": (0.0, 3.6, 1.0)}
SUNK = {"jid": "stand", "pos": (0.0, -0.01, 1.0)}
PENDANT = {"jid": "pendant", "pos": (0.0, 2.0, 0.0)}
GONE = [{"jid": f"gone{k}", "pos": (0.3 * k, 0.0, 1.0)} for k in range(3)]
MANY = [{"jid": "stand", "pos": (0.1 * k, 0.0, 1.0)} for k in range(13)]
LISTED = "allowed_categories=[king-size bed, nightstand, floor lamp]"
OPTIONAL = (
    "min_objects", "max_objects", "max_floor_m", "max_height_m", "required_classes", "scale_range",
    "min_inside_floor", "min_models_share",
)  # fmt: skip


def broken(front, pieces, *rules, wall_m=2.6, **changes):
    """The rule that a room of these pieces breaks, and why; None if it is used."""
    written = room("Bedroom-1", pieces, **changes)
    wall = written["_meshes"][1]["xyz"]
    wall[7] = wall[10] = wall_m
    result = read(front, front.house("house", written), rules)
    for line in result.left_out:
        return [line.rule, line.reason]
    found = broken_rule(result.rooms[0], load_recipe("bedroom", rules))
    return found and list(found)


@pytest.mark.parametrize(
    ("rule", "pieces", "changes"),
    [
        ("min_objects=2", [BED], {}),
        ("max_objects=13", [BED, *MANY], {}),
        ("max_floor_m=6", [BED, STAND], {"bounds": (-3.1, -2, 3.1, 2)}),
        ("max_height_m=4", [BED, STAND], {"wall_m": 4.2}),
        ("required_classes=[double_bed, kids_bed]", [STAND, STAND | {"pos": (0, 0, 0)}], {}),
        ("scale_range=[0.2, 5]", [BED | {"scale": [9, 1, 1]}, STAND], {}),
        ("min_inside_floor=0.5", [BED, OUTSIDE, OUTSIDE | {"pos": (3.4, 0.0, 1.0)}], {}),
        ("min_models_share=0.5", [BED, STAND, *GONE], {}),
        ("furniture_between_m=[-0.005, 4.0]", [BED, STAND, HIGH], {}),
        ("furniture_between_m=[-0.005, 4]", [BED, STAND, SUNK], {}),
        ("invalid_rooms=[Bedroom-1]", [BED, STAND], {}),
        ("invalid_rooms=[house_Bedroom-1]", [BED, STAND], {}),
        ("invalid_models=[pendant]", [BED, STAND, PENDANT], {}),
        (LISTED, [BED, STAND, PENDANT], {}),
    ],
)
def test_each_rule_leaves_a_room_out_by_name_and_can_be_switched_off(front, rule, pieces, changes):
    name = rule.partition("=")[0]
    off = [f"{each}=null" for each in OPTIONAL if each != name]
    found = broken(front, pieces, *off, rule, **changes)
    hold("filters", {rule: found})
    assert found[0] == name
    assert broken(front, pieces, *off, f"{name}=null", **changes) is None


@pytest.mark.parametrize(
    ("name", "piece", "rules"),
    [
        ("listed", {"jid": "piano"}, [LISTED]),
        ("of the house", {"jid": "far", "entry": {"category": "Grand / Piano"}}, [LISTED]),
        ("of nothing", {"jid": "far"}, [LISTED]),
        ("invalid", {"jid": "known"}, [LISTED, "invalid_models=[known]"]),
        ("good", {"jid": "known"}, [LISTED]),
    ],
)
def test_a_piece_without_a_model_is_judged_as_the_others_are(front, name, piece, rules):
    """The model `far` is not in the release's list."""
    front.list_model("piano", "Grand Piano")
    front.list_model("known", "Nightstand")
    pieces = [BED, STAND, piece | {"pos": (0.0, 0.0, 1.0)}]
    found = broken(front, pieces, "min_models_share=null", *rules)
    hold("filters", {f"without a model, {name}": found})


def test_what_is_outside_or_missing_is_noted_and_long_lists_are_stored_as_a_digest(front, tmp_path):
    pieces = [BED, STAND, OUTSIDE, GONE[0]]
    front.house("house", room("Bedroom-1", pieces), bedroom("Bedroom-2"))
    rules = ("invalid_models=[none of these]",)
    summary = build_shards(front_job(front, tmp_path / "shards", rules=rules))
    line = next(line for line in summary.lines if line.room_id == "house_Bedroom-1")
    assert line.status == "prepared"
    assert "1 of 3 pieces stand outside of the floor" in line.notes
    report = summary.report
    assert report["notes"] == {
        "... is left out: the models folder has no raw_model.obj for it": 1,
        "... of ... pieces stand outside of the floor": 1,
    }
    (table,) = (t for t in report_tables(report) if t.columns[0].header == "note of prepared rooms")
    assert table.row_count == 2
    recipe = read_index(tmp_path / "shards")["recipe"]
    assert recipe["invalid_rooms"] is None and len(recipe["invalid_models"]) == 16
