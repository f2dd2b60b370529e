"""reconstruct and eval-svr as commands: files, scores, and sentences for what does not work."""

import json
import re

import numpy as np
import pytest
from cli_helpers import refuses
from PIL import Image

from sceneprior.core.cameras import camera_centers
from sceneprior.core.classes import label_set
from sceneprior.core.views import image_from_shards
from sceneprior.paper.fit_image import SCHEDULES, FitSchedule

PAPER = ("--fit", "paper")


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setitem(SCHEDULES, "paper", FitSchedule(steps=6, drop_at=3))


@pytest.fixture
def own(toy_shards, tmp_path):
    """A view of the toy rooms as a user's files, and the arguments that name them."""
    image = image_from_shards(toy_shards, "toy/test_00", 0)
    names = label_set(image.label_set)
    Image.fromarray(image.instance_ids.astype(np.uint8)).save(tmp_path / "mine.png")
    rows = "".join(f"{k + 1},{names[c]}\n" for k, c in enumerate(image.object_class))
    (tmp_path / "classes.csv").write_text("id,class\n" + rows)
    (tmp_path / "pose.json").write_text(
        json.dumps({"world_to_camera": image.world_to_camera.tolist()})
    )
    values = ",".join(str(image.intrinsics[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return ["--mask", "mine.png", "--classes", "classes.csv", "--intrinsics", values]


def files_of(name: str) -> set[str]:
    return {f"{name}.json", f"{name}.glb", f"{name}.png", f"{name}_seen.png"}


def test_reconstruct_an_own_image(command, toy_run, own, tmp_path, monkeypatch):
    call = ["reconstruct", "--run", toy_run, *own]
    status, out, errors = command(*call, "--pose", "pose.json", "--out", "posed")
    assert (status, out) == (0, "Wrote 1 room to posed\n"), errors
    assert "without --pose" not in errors and "sofa" not in errors
    made = files_of("mine") | {"rooms.html"}
    assert {path.name for path in (tmp_path / "posed").iterdir()} == made
    page = (tmp_path / "posed" / "rooms.html").read_text()
    assert page.count("<model-viewer ") == 1 and "the reconstruction from the same camera" in page
    # The four cameras tried are images of one name, here in two batches.
    monkeypatch.setattr("sceneprior.apps.reconstruction.reconstruct.BATCH", 2)
    status, _, errors = command(*call, *PAPER, "--out", "level", "--camera-height", 1.4)
    assert status == 0 and "Note: without --pose the camera is level, 1.4 m above" in errors
    pose = json.loads((tmp_path / "level" / "mine.json").read_text())["extra"]["world_to_camera"]
    assert camera_centers(np.array(pose))[1] == pytest.approx(1.4)
    rows = (tmp_path / "classes.csv").read_text().splitlines()
    (tmp_path / "classes.csv").write_text("\n".join([*rows[:1], "1,sofa", *rows[2:]]))
    status, _, errors = command(*call, "--out", "sofa")
    assert "Note: the run never generates the class sofa; a " in errors
    assert status == 0 and "is level, 1 or 1.2 or 1.4 or 1.6 or 1.8 m above the floor" in errors
    assert re.search(r"Note: a camera 1(\.[2468])? m above the floor fits best\.", errors)


def test_eval_svr_of_a_run_and_of_its_scenes(command, toy_run, toy_shards, tmp_path):
    call = ["eval-svr", "--shards", toy_shards]
    two = ["--run", toy_run, "--limit", 2, *PAPER]
    status, out, errors = command(*call, *two, "--out", "run.json")
    assert status == 0, errors
    assert "single views" in out and out.endswith("Wrote run.json\n") and "nan" not in out.lower()
    scores = json.loads((tmp_path / "run.json").read_text())
    assert set(scores["rows"]) == {"fit", "fit_boxes", "layout_fit", "nearest_room", "random_room"}
    made = ["reconstruct", "--shards", toy_shards, "--split", "test", *two, "--out", "scenes"]
    assert command(*made)[:2] == (0, "Wrote 2 rooms to scenes\n")
    names = [path.stem for path in (tmp_path / "scenes").glob("*.json")]
    wanted = set().union(*map(files_of, names))
    assert len(names) == 2 and {path.name for path in (tmp_path / "scenes").iterdir()} == wanted
    extra = json.loads((tmp_path / "scenes" / f"{names[0]}.json").read_text())["extra"]
    assert 0 <= extra["mask_iou"] <= 1 and 0 < extra["steps"] <= 6
    status, out, errors = command(*call, "--scenes", "scenes")
    assert status == 0 and out.endswith("Wrote scenes/svr.json\n"), errors
    again = json.loads((tmp_path / "scenes" / "svr.json").read_text())
    # Files hold boxes to 0.01 mm, and meshes in single precision.
    for mine, theirs in (("scenes", "fit"), ("scenes_boxes", "fit_boxes")):
        one, other = again["rows"][mine]["summary"], scores["rows"][theirs]["summary"]
        assert one == pytest.approx(other, abs=1e-3)
    for row in ("nearest_room", "random_room"):
        assert again["rows"][row] == scores["rows"][row]


def test_scenes_that_answer_no_image(command, toy_run, toy_shards, tmp_path):
    made = ["reconstruct", "--run", toy_run, "--shards", toy_shards, "--room", "toy/test_00"]
    assert command(*made, "--out", "scenes")[0] == 0
    (path,) = (tmp_path / "scenes").glob("*.json")
    path.with_suffix(".glb").unlink()
    whole = json.loads(path.read_text())
    call = ["eval-svr", "--shards", toy_shards, "--scenes", "scenes"]
    for key, changes in {
        "no_objects": {"objects": []},
        "no_image": {"extra": {}},
        "no_room": {"extra": {**whole["extra"], "room_id": "attic"}},
        "no_view": {"extra": {**whole["extra"], "view": 9}},
    }.items():
        path.write_text(json.dumps({**whole, **changes}))
        refuses(command, f"cli/eval_svr_scenes_{key}", *call, shards=toy_shards)
