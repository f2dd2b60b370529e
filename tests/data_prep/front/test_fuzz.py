"""Damaged houses in a job: rooms come, or a sentence for every room that does not.

Houses alone are damaged in tests/fuzz/test_captures.py.
"""

import json

import numpy as np
from front_files import FrontFolder, bedroom, surface
from front_jobs import front_job, rooms_of
from mutating import damaged_json

from data_prep.engine.build import build_shards


def written_house(front: FrontFolder) -> bytes:
    """Two bedrooms of many pieces, with an entry of every flavour."""
    first, second = bedroom("A"), bedroom("B", bounds=(3.0, -2.0, 7.0, 2.0))
    corners = [(-2, 2.6, -2), (2, 2.6, -2), (2, 2.6, 2), (-2, 2.6, 2)]
    first["_meshes"].append(surface("ceiling", "Ceiling", corners))
    first["children"].append({"ref": "ceiling", "pos": [0, 0, 0], "rot": [0, 0, 0, 1]})
    first["_furniture"][0] |= {"bbox": [1.8, 1.0, 2.0], "category": "King-size Bed"}
    first["_furniture"][1] |= {"size": ["0.5", "0.6", "0.4"], "sourceCategoryId": "a", "title": "b"}
    return front.house("house", first, second).read_bytes()


def test_a_job_on_damaged_houses_names_every_room(front, tmp_path):
    """The whole way to shards and reports: what can be used is there, the rest has a sentence."""
    text = written_house(front)
    for case in range(40):
        damaged = damaged_json(json.loads(text), np.random.default_rng(10_000 + case))
        (front.front / f"house{case:02d}.json").write_text(damaged)
    (front.front / "house98.json").write_bytes(text[:1000])
    (front.front / "house99.json").write_bytes(b"\xff" * 100)
    rules = ("max_floor_m=null", "max_height_m=null", "scale_range=null", "min_objects=null",
             "required_classes=[]", "min_inside_floor=null", "min_models_share=null",
             "views.at_least=2", "views.per_m2=0.1",
             "views.image_size=[24, 32]", "views.min_object_pixels=4", "views.tries=2")  # fmt: skip
    summary = build_shards(front_job(front, tmp_path / "shards", rules=rules))
    assert summary.statuses["prepared"] > 30 and summary.statuses["failed"] > 5
    assert len(rooms_of(tmp_path / "shards")) == summary.statuses["prepared"]
    for line in summary.lines:
        assert line.status == "prepared" or line.reason, line
        assert "unforeseen" not in line.reason, line
    reasons = {line.house: line.reason for line in summary.lines if line.status == "failed"}
    assert "house98.json is not JSON" in reasons["house98"]
    assert "house99.json is not JSON" in reasons["house99"]
