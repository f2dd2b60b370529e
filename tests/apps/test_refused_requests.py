"""Requests that are refused, each with one sentence (`golden/refusals/requests.txt`)."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

import sceneprior
from sceneprior import load_request
from sceneprior.core.scene import Opening, Scene, SceneObject

BED = {"class": "double_bed", "center_m": [0.0, 0.3, -0.4], "size_m": [1.8, 0.6, 2.0]}
REQUEST = {"format": "sceneprior-request", "version": 1}
ENDS = {"kind": "door", "start_m": [0, 0], "end_m": [0.9, 0]}
DOOR = Opening("door", (-0.5, 0.0), (0.4, 0.0), 0.0, 2.0)


def box(label: str = "double_bed", x: float = 0.0, cm: float = 1.0) -> SceneObject:
    return SceneObject(label, (x, 0.3, -0.4), (1.8 * cm, 0.6 * cm, 2.0 * cm))


def relation(**entry: Any) -> dict[str, Any]:
    return {"want": {"relations": [entry]}}


ASKED: dict[str, dict[str, Any]] = {
    "floor_word": {"floor": "wide"},
    "floor_odd_numbers": {"floor": "0,0 4,0 4"},
    "floor_letter": {"floor": "0,0 4,0 x,3"},
    "floor_centimetres": {"floor": "400x300"},
    "floor_too_large": {"floor": "180x200"},
    "floor_millimetres": {"floor": [[0, 0], [4000, 0], [4000, 3000]]},
    "floor_two_corners": {"floor": [[0, 0], [1, 0]]},
    "floor_corner_of_text": {"floor": [[0, 0], [1, "x"], [1, 1]]},
    "floor_line": {"floor": [[0, 0], [3, 0], [6, 0]]},
    "floor_crossed": {"floor": [[0, 0], [3, 3], [3, 0], [0, 3]]},
    "floor_tiny": {"floor": "0.5x0.5"},
    "floor_nan": {"floor": [[0, 0], [4, math.nan], [4, 3]]},
    "floor_too_many_points": {"floor": [[0, 0], [55, 10], [45, 55]]},
    "floor_strip": {"floor": [[0, 0], [20, 0], [20, 0.2], [0, 0.2]]},
    "opening_word": {"floor": "4x3", "openings": "gate"},
    "opening_wall_word": {"floor": "4x3", "openings": "door@up"},
    "opening_kind": {
        "floor": "4x3", "openings": [{"kind": "gate", "start_m": [0, 0], "end_m": [1, 0]}],
    },
    "opening_without_ends": {"floor": "4x3", "openings": [{"kind": "door"}]},
    "openings_many": {"floor": "4x3", "openings": "door," * 60},
    "opening_side_number": {"floor": "4x3", "openings": "door@7"},
    "opening_beyond_wall": {"floor": "4x3", "openings": "door@north:3.9"},
    "openings_on_each_other": {"floor": "4x3", "openings": "door@north:2,door@north:2.5"},
    "opening_off_the_outline": {"floor": "4x3", "openings": [DOOR]},
    "opening_no_wall_there": {"floor": [[0, 0], [6, 0], [0, 3]], "openings": "door@east"},
    "openings_crowded": {"floor": "1x1", "openings": "door,door,door,door,door"},
    "opening_with_corners_without_floor": {"openings": [DOOR]},
    "ceiling_low": {"ceiling_m": 0.2},
    "ceiling_centimetres": {"ceiling_m": 260.0},
    "count_word": {"want": {"desk": "many"}},
    "count_negative": {"want": {"desk": -1}},
    "count_fraction": {"want": {"desk": 1.5}},
    "count_bool": {"want": {"desk": True}},
    "count_list": {"want": {"desk": [2]}},
    "count_text": {"want": "desk: -1"},
    "count_twice": {"want": "desk: 1, desk: 2"},
    "relation_without_relation": relation(subject="desk"),
    "relation_unknown": relation(subject="desk", relation="on"),
    "relation_needs_target": relation(subject="desk", relation="near"),
    "relation_takes_no_target": relation(
        subject="desk", relation="at a wall", target="double_bed"
    ),
    "relation_count": relation(subject="desk", relation="at a wall", count=0),
    "class_unknown": {"want": {"piano": 1}},
    "class_of_another_prior": {"want": "a double bed and a wardrobe"},
    "windows_twice": {"openings": "window@north", "want": "a window in the south wall"},
    "too_many_objects": {"want": {"chair": 60}},
    "given_too_many": {"want": {"double_bed": 1}, "objects": [box(), box(x=3.0)]},
    "contradiction": {
        "want": {"double_bed": 0, "relations": [
            {"subject": "desk", "relation": "near", "target": "double_bed"}]},
    },
    "given_unknown": {"objects": [box("piano")]},
    "given_centimetres": {"objects": [box(cm=100.0)]},
    "area": {"floor": "3x2", "want": {"double_bed": 9}},
    "openings_on_any_floor": {"openings": "window@north," * 19 + "window@north"},
    "no_place": {"floor": "0.6x6", "want": {"double_bed": 1}},
    "latents": {"floor": "4x3", "distribution": "paper"},
    "floor_twice": {"floor": "5x3", "want": "a 4 x 3 m bedroom"},
    "words_unknown": {"want": "a purple bed"},
    "words_of_a_phrase": {"want": "a nightstand on the other side of the bed"},
    "words_nouns_only": {"want": "a bed and at least three pianos and 4 organs"},
    "words_relation_alone": {"want": "beside the bed"},
    "words_two_bedrooms": {"want": "two bedrooms"},
    "words_hash": {"want": "a bed # 3"},
    "words_living_room": {"want": "a living room"},
    "words_two_sizes": {"want": "3x4 or 4x5"},
    "words_length": {"want": "a 180 m bed"},
    "words_length_cm": {"want": "a bed of 180 x 200 cm"},
    "words_size_of_a_bed": {"want": "a 1.8 x 2 m bed"},
    "words_long": {"want": "a bed " * 400},
}  # fmt: skip

FILES: dict[str, dict[str, Any]] = {
    "file_object_centimetres": {"objects": [{**BED, "size_m": [180, 60, 200]}]},
    "file_floor_two_corners": {"floor": [[0, 0], [1, 2]]},
    "file_unknown_key": {"doors": 1},
    "file_version": {"version": 2},
    "file_format": {"format": "sceneprior-scene"},
    "file_ceiling_word": {"ceiling_m": "high"},
    "file_relation_half": {"want": {"relations": [{"subject": "desk"}]}},
    "file_openings_number": {"openings": 5},
    "file_want_number": {"want": 5},
    "file_objects_number": {"objects": 5},
    "file_opening_key": {"openings": [{**ENDS, "top": 2}]},
    "file_opening_text": {"openings": [{**ENDS, "top_m": "2"}]},
    "file_opening_text_end": {"openings": [{**ENDS, "start_m": ["0", 0]}]},
    "file_floor_of_texts": {"floor": [["0", 0], [4, 0], [4, 3]]},
    "file_object_half": {"objects": [{"class": "desk"}]},
}


@pytest.fixture(scope="module")
def prior():
    return sceneprior.load("procthor-bedroom")


@pytest.mark.filterwarnings("ignore:The floor of")
@pytest.mark.parametrize("name", ASKED)
def test_requests(prior, name):
    with refused(f"requests/{name}"):
        prior.sample(1, seed=0, **ASKED[name])


@pytest.mark.parametrize("name", FILES)
def test_files(name, tmp_path: Path):
    path = tmp_path / "request.json"
    path.write_text(json.dumps({**REQUEST, **FILES[name]}))
    with refused(f"requests/{name}", tmp=tmp_path):
        load_request(path)


def test_completions(prior):
    scene = Scene("mine", "front3d_bedroom", (box(),))
    with refused("requests/complete_centimetres"):
        prior.complete(Scene("mine", "front3d_bedroom", (box(cm=100.0),)), 1)
    with refused("requests/complete_classes_and_wishes"):
        prior.complete(scene, 1, classes=["nightstand"], want="a nightstand")
    with refused("requests/complete_unknown_class"):
        prior.complete(scene, 1, classes=["piano"])
    with refused("requests/complete_too_many"):
        prior.complete(scene, 1, classes=["chair"] * 13)
    with refused("requests/complete_given_too_many"):
        prior.complete(Scene("full", "front3d_bedroom", tuple(map(box, ["chair"] * 14))), 1)
    with refused("requests/complete_given_unknown"):
        prior.complete(Scene("odd", "front3d_bedroom", (box("piano"),)), 1)
    outline = np.array([[-3.0, -3], [3, -3], [3, 3], [-3, 3]])
    walled = Scene("mine", "front3d_bedroom", (box(),), outline, ceiling_m=3.0)
    with refused("requests/complete_door_without_wall"):
        prior.complete(walled, 1, openings=[DOOR])
