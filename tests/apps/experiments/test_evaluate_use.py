"""`evaluate` from the command line: scenes without shards, a run with them."""

import json
import shutil

import numpy as np
import pytest

from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.scene_files import save

FLOOR = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])


def test_scenes_alone_are_measured_without_shards(command, tmp_path):
    """Two rooms: a desk alone, and two desks that share half of their volume."""
    desks = [SceneObject("desk", (x, 0.4, 0.0), (1.0, 0.8, 1.0)) for x in (-0.25, 0.25)]
    for name, objects in (("one", desks[:1]), ("two", desks)):
        room = Scene(name, "front3d_bedroom", tuple(objects), floor_m=FLOOR)
        save(room, tmp_path / "made" / f"{name}.json")
    status, printed, errors = command("evaluate", "--scenes", "made", "--settle", "none")
    assert status == 0, errors
    assert "Rooms for use" in printed and "COL: objects that collide (SceneEval)" in printed
    assert "doors or windows (openings)" in printed and "sceneeval_clear_openings" in printed
    scores = json.loads((tmp_path / "made" / "scores.json").read_text())
    assert scores["sceneeval_col_objects"] == pytest.approx(2 / 3)
    assert scores["sceneeval_col_scenes"] == 0.5 and scores["sceneeval_oob_objects"] == 0
    assert scores["respace_mbl_litres"] > 100 and scores["physcene_walkable"] == 1
    low, high = scores["intervals"]["generated"]["sceneeval_col_objects"]
    assert low <= 2 / 3 <= high
    assert scores["protocol"]["n_generated"] == 2 and "fd_effnet_lite0" not in scores
    assert scores["protocol"]["left_out"]["stable_share"] == "--settle solids"


def test_a_run_stands_beside_real_and_random_rooms(command, toy_run, toy_shards, tmp_path):
    call = ["evaluate", "--run", toy_run, "-n", 4, "--only-use", "--out", "use.json"]
    status, printed, errors = command(*call, "--settle", "none", "--resamples", 5)
    assert status == 0, errors
    scores = json.loads((tmp_path / "use.json").read_text())
    real = reference_scenes(toy_shards, "test")
    assert scores["protocol"]["n_generated"] == 4 and scores["protocol"]["n_test"] == len(real)
    assert all("sceneeval_supported" in scores[name] for name in ("shuffled", "independent"))
    assert "sceneeval_supported_test" in scores and "shuffled" in printed
    # Decoded rooms have no floor, so what needs one is left out of the real rooms' column, too.
    assert "physcene_reach_test" not in scores
    assert "physcene_reach" in scores["protocol"]["left_out"]


def test_results_of_use_alone_name_their_rooms_and_are_tabulated(
    command, scenes, toy_shards, tmp_path
):
    call = ["evaluate", "--scenes", scenes, "--shards", toy_shards, "--only-use"]
    status, _, errors = command(*call, "--settle", "none", "--resamples", 0, "--out", "one.json")
    assert status == 0, errors
    protocol = json.loads((tmp_path / "one.json").read_text())["protocol"]
    assert (protocol["shards"], protocol["split"]) == (toy_shards.name, "test")
    shutil.copy(tmp_path / "one.json", tmp_path / "two.json")
    status, _, errors = command("compare", "one.json", "two.json", "--out", "tables")
    assert status == 0, errors
    table = (tmp_path / "tables" / "table.md").read_text()
    assert f"4 generated rooms per run against 4 test rooms of {toy_shards.name}" in table


def test_a_run_has_all_scores_at_once_and_a_page_of_them(command, toy_run, tmp_path):
    call = ["evaluate", "--run", toy_run, "-n", 4, "--resamples", 2, "--settle", "none"]
    status, printed, errors = command(*call, "--out", "all.json")
    assert status == 0, errors
    scores = json.loads((tmp_path / "all.json").read_text())
    assert scores["protocol"]["latents"] == "paper" and scores["rooms"] == 12
    assert scores["near_copy_share"] * 4 == round(scores["near_copy_share"] * 4)
    assert np.isfinite([value for value in scores.values() if isinstance(value, float)]).all()
    assert {"sceneeval_col_objects", "fd_effnet_lite0", "box_iou_3d"} <= set(scores)
    assert "SUPPORT" in printed and "Category KL" in printed and "nan" not in printed.lower()
    assert command("report", "--run", toy_run, "--scores", "all.json", "--out", "r.html")[0] == 0
    assert "SUPPORT: objects that rest" in (tmp_path / "r.html").read_text()
