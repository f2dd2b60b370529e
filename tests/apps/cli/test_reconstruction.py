"""reconstruct and eval-svr as commands: files, scores, and sentences for what does not work."""

import json
import re
import shutil

import numpy as np
import pytest
from cli_helpers import everything_in, one_sentence
from PIL import Image

from sceneprior.core.classes import label_set
from sceneprior.core.observed_image import image_from_shards
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


def test_reconstruct_a_view_and_a_split(command, toy_run, toy_shards, tmp_path):
    call = ["reconstruct", "--run", toy_run, "--shards", toy_shards]
    one = [*call, *PAPER, "--room", "toy/test_01", "--view", 3, "--out", "one"]
    status, out, errors = command(*one)
    assert (status, out) == (0, "Wrote 1 room to one\n"), errors
    name = "toy_test_01_view3"
    assert {path.name for path in (tmp_path / "one").iterdir()} == files_of(name)
    scene = json.loads((tmp_path / "one" / f"{name}.json").read_text())
    seen = image_from_shards(toy_shards, "toy/test_01", 3)
    assert len(scene["objects"]) == len(seen.rows)
    extra = scene["extra"]
    assert (extra["room_id"], extra["view"], extra["image_size"]) == ("toy/test_01", 3, [72, 96])
    assert 0 <= extra["mask_iou"] <= 1 and 0 < extra["steps"] <= 6
    picture = Image.open(tmp_path / "one" / f"{name}_seen.png")
    assert picture.height > 360 and picture.width > 2 * 480 + 360  # two views and a plan
    before = everything_in(tmp_path)
    assert "one is not empty; add --overwrite" in one_sentence(command(*one))
    assert everything_in(tmp_path) == before
    assert command(*one, "--overwrite")[0] == 0
    status, out, errors = command(*call, "--split", "test", "--limit", 2, "--out", "two")
    assert (status, out) == (0, "Wrote 2 rooms to two\n"), errors
    assert len(list((tmp_path / "two").glob("*_seen.png"))) == 2


def test_reconstruct_an_own_image(command, toy_run, own, tmp_path):
    call = ["reconstruct", "--run", toy_run, *own]
    status, out, errors = command(*call, "--pose", "pose.json", "--out", "posed")
    assert (status, out) == (0, "Wrote 1 room to posed\n"), errors
    assert "without --pose" not in errors and "sofa" not in errors
    made = files_of("mine") | {"rooms.html"}
    assert {path.name for path in (tmp_path / "posed").iterdir()} == made
    page = (tmp_path / "posed" / "rooms.html").read_text()
    assert page.count("<model-viewer ") == 1 and "the reconstruction from the same camera" in page
    status, _, errors = command(*call, *PAPER, "--out", "level", "--camera-height", 1.4)
    assert status == 0 and "Note: without --pose the camera is level, 1.4 m above" in errors
    extra = json.loads((tmp_path / "level" / "mine.json").read_text())["extra"]
    rows = (tmp_path / "classes.csv").read_text().splitlines()
    (tmp_path / "classes.csv").write_text("\n".join([*rows[:1], "1,sofa", *rows[2:]]))
    _, _, errors = command(*call, "--out", "sofa", "--pose", "pose.json")
    assert "Note: the run never generates the class sofa; a " in errors
    status, _, errors = command(*call, "--out", "heights")
    assert status == 0 and "is level, 1 or 1.2 or 1.4 or 1.6 or 1.8 m above the floor" in errors
    assert re.search(r"Note: a camera 1(\.[2468])? m above the floor fits best\.", errors)
    pose = np.array(extra["world_to_camera"])
    assert (-pose[:3, :3].T @ pose[:3, 3])[1] == pytest.approx(1.4)


def test_what_cannot_be_reconstructed(command, toy_run, toy_shards, own, tmp_path):
    call = ["reconstruct", "--run", toy_run, "--out", "none"]
    shards = ["--shards", toy_shards]
    way = "Say what to reconstruct from, in exactly one way"
    before = everything_in(tmp_path)
    for arguments, said in (
        ([], way),
        (shards, way),
        ([*shards, "--room", "toy/test_00", "--split", "test"], way),
        ([*shards, *own], way),
        (own[:2], "--mask needs --intrinsics and, for a PNG, --classes."),
        ([*shards, "--room", "attic"], "holds no room 'attic'"),
        ([*shards, "--room", "toy/test_00", "--view", 8], "has no view 8; its 8 views are 0 to 7."),
        ([*shards, "--split", "test", "--fit", "slow"], "No fit is called 'slow'"),
        ([*shards, "--split", "val"], "val"),
    ):
        assert said in one_sentence(command(*call, *arguments)), arguments
    assert everything_in(tmp_path) == before


def test_eval_svr_of_a_run_and_of_its_scenes(command, toy_run, toy_shards, tmp_path):
    call = ["eval-svr", "--shards", toy_shards]
    two = ["--limit", 2]
    status, out, errors = command(*call, "--run", toy_run, *two, *PAPER, "--out", "run.json")
    assert status == 0, errors
    assert "single views" in out and out.endswith("Wrote run.json\n") and "nan" not in out.lower()
    scores = json.loads((tmp_path / "run.json").read_text())
    assert set(scores["rows"]) == {"fit", "fit_boxes", "layout_fit", "nearest_room", "random_room"}
    made = ["reconstruct", "--run", toy_run, "--shards", toy_shards, "--split", "test", *two]
    made += [*PAPER]
    assert command(*made, "--out", "scenes")[0] == 0
    status, out, errors = command(*call, "--scenes", "scenes")
    assert status == 0 and out.endswith("Wrote scenes/svr.json\n"), errors
    again = json.loads((tmp_path / "scenes" / "svr.json").read_text())
    # Files hold boxes to 0.01 mm, and meshes in single precision.
    for mine, theirs in (("scenes", "fit"), ("scenes_boxes", "fit_boxes")):
        one, two_ = again["rows"][mine]["summary"], scores["rows"][theirs]["summary"]
        assert one == pytest.approx(two_, abs=1e-3)
    for row in ("nearest_room", "random_room"):
        assert again["rows"][row] == scores["rows"][row]


def test_scenes_that_answer_no_image(command, toy_run, toy_shards, tmp_path):
    made = ["reconstruct", "--run", toy_run, "--shards", toy_shards, "--room", "toy/test_00"]
    assert command(*made, "--out", "scenes")[0] == 0
    (path,) = (tmp_path / "scenes").glob("*.json")
    path.with_suffix(".glb").unlink()
    whole = json.loads(path.read_text())
    call = ["eval-svr", "--shards", toy_shards, "--scenes", "scenes"]

    def said(**changes) -> str:
        path.write_text(json.dumps({**whole, **changes}))
        return one_sentence(command(*call))

    assert "has 0 objects, but view 0 of room toy/test_00 shows" in said(objects=[])
    assert "does not say which image it reconstructs" in said(extra={})
    attic = {**whole["extra"], "room_id": "attic"}
    assert "The 'test' split of" in said(extra=attic) and "has no room attic" in said(extra=attic)
    assert "has no view 9" in said(extra={**whole["extra"], "view": 9})
    assert "Say what to evaluate" in one_sentence(command(*call, "--run", toy_run))
    assert "Say what to evaluate" in one_sentence(command("eval-svr", "--shards", toy_shards))
    shutil.rmtree(tmp_path / "scenes")
    assert "No folder of scenes at scenes" in one_sentence(command(*call))
