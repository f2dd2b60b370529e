"""Damaged houses: rooms come, or a sentence for every room that does not; never a traceback.

A seeded mutator rather than a library: the same damage every time, in bounded time, and a failing
case is named by its number.
"""

import json
from typing import Any

import numpy as np
import pytest
from front_files import FrontFolder, bedroom, surface
from front_jobs import front_job, rooms_of
from mutating import damaged_json

from data_prep.engine.build import build_shards
from data_prep.front.models import ModelBank
from data_prep.front.recipe import load_recipe
from data_prep.front.rooms import read_house
from sceneprior.core.errors import InputError

CASES = 400


def written_house(front: FrontFolder) -> bytes:
    """Two bedrooms of many pieces, with an entry of every flavour."""
    first, second = bedroom("A"), bedroom("B", bounds=(3.0, -2.0, 7.0, 2.0))
    corners = [(-2, 2.6, -2), (2, 2.6, -2), (2, 2.6, 2), (-2, 2.6, 2)]
    first["_meshes"].append(surface("ceiling", "Ceiling", corners))
    first["children"].append({"ref": "ceiling", "pos": [0, 0, 0], "rot": [0, 0, 0, 1]})
    first["_furniture"][0] |= {"bbox": [1.8, 1.0, 2.0], "category": "King-size Bed"}
    first["_furniture"][1] |= {"size": ["0.5", "0.6", "0.4"], "sourceCategoryId": "a", "title": "b"}
    return front.house("house", first, second).read_bytes()


def check(front: FrontFolder, path: Any, bank: ModelBank, rules: tuple[str, ...]) -> str:
    """Read a house, and say what came of it."""
    try:
        result = read_house(path, bank, load_recipe("bedroom", rules))
    except InputError as error:
        assert path.name in str(error) and "\n" not in str(error)
        return "house refused"
    for room_id, *_, why in [*result.failures, *result.filtered]:
        assert room_id.startswith("house_") and room_id.isprintable(), room_id
        assert why and why.isprintable() and len(why) < 400, why
    for room in result.rooms:
        assert np.isfinite(room.floor.bounds).all() and np.isfinite(room.height_m)
        assert room.room_id.isprintable() and all(note.isprintable() for note in room.notes)
        for piece in room.furniture:
            assert np.isfinite(piece.mesh.vertices_m).all()
    if result.failures:
        return "room failed"
    return (
        "filtered" if result.filtered else "noted" if any(r.notes for r in result.rooms) else "read"
    )


@pytest.mark.parametrize("rules", [(), ("scale_range=null",)], ids=["rules", "no rules"])
def test_mutilated_houses_never_raise_a_traceback(front, rules):
    text = written_house(front)
    bank = ModelBank(front.future)
    path = front.front / "house.json"
    outcomes = []
    for case in range(CASES):
        path.write_text(damaged_json(json.loads(text), np.random.default_rng(case)))
        try:
            outcomes.append(check(front, path, bank, rules))
        except Exception:
            print("case", case)
            raise
    # The damage reaches every stage: a mutator that breaks all at the door would test nothing.
    kinds = {"house refused", "room failed", "noted", "read"} | (
        {"filtered"} if not rules else set()
    )
    assert all(outcomes.count(kind) > 5 for kind in kinds), {k: outcomes.count(k) for k in kinds}


def test_truncated_and_scrambled_texts(front):
    text = written_house(front)
    bank = ModelBank(front.future)
    path = front.front / "house.json"
    rng = np.random.default_rng(0)
    for case in range(150):
        scrambled = bytearray(text[: rng.integers(len(text))] if case % 3 == 0 else text)
        if case % 3:
            for place in rng.integers(len(scrambled), size=rng.integers(1, 5)):
                scrambled[place] = rng.integers(256)  # not UTF-8, mostly
        path.write_bytes(bytes(scrambled))
        check(front, path, bank, ())
    path.write_bytes(b"\xef\xbb\xbf" + text)  # a byte order mark is no damage
    assert check(front, path, bank, ()) == "read"


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
    summary = build_shards(front_job(front, tmp_path / "shards", rules=rules, rgb=True))
    assert summary.statuses["prepared"] > 30 and summary.statuses["failed"] > 5
    assert len(rooms_of(tmp_path / "shards")) == summary.statuses["prepared"]
    for line in summary.lines:
        assert line.status == "prepared" or line.reason, line
        assert "unforeseen" not in line.reason, line
    reasons = {line.house: line.reason for line in summary.lines if line.status == "failed"}
    assert "house98.json is not JSON" in reasons["house98"]
    assert "house99.json is not JSON" in reasons["house99"]
