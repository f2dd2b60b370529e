"""Ground truth against masks: right rooms agree, each kind of wrong one does not."""

from dataclasses import replace

import numpy as np
import pytest
from front_files import bedroom
from front_jobs import front_job, rooms_of

from data_prep.engine.build import build_shards
from data_prep.inspection.agreement import Agreement, ModelPoints, measure, unoccluded
from sceneprior.errors import ShardError

LARGER = ("views.image_size=[180, 240]", "views.per_m2=2")


@pytest.fixture
def made(front, tmp_path):
    """(views, truth, models) of a bedroom."""
    front.house("house", bedroom("Bedroom-0"))
    build_shards(front_job(front, tmp_path / "shards", rules=LARGER, only="house"))
    (pair,) = rooms_of(tmp_path / "shards").values()
    return *pair, ModelPoints(tmp_path / "shards" / "models")


def test_whole_things_are_those_that_nothing_cuts_off(made):
    views, _, _ = made
    seen = unoccluded(views)
    height, width = views.image_size
    assert 3 < seen.sum() < views.visible.sum()
    for view, k in zip(*np.nonzero(seen), strict=True):
        rows, columns = np.nonzero(views.instance_ids[view] == k + 1)
        assert rows.min() > 0 and rows.max() < height - 1
        assert columns.min() > 0 and columns.max() < width - 1
        assert views.sides_clear[view, k].all()


def test_a_right_room_agrees_to_the_pixel(made):
    agreement, problems = measure(*made)
    assert problems == [] and agreement.box == []
    assert len(agreement.mesh) == unoccluded(made[0]).sum()
    assert np.mean(agreement.mesh) > 0.95 and min(agreement.mesh) > 0.85


def test_without_meshes_the_boxes_stand_for_them(made):
    views, truth, models = made
    bare = replace(truth, model_ids=("",) * len(truth.model_ids))
    agreement, problems = measure(views, bare, models)
    # These pieces are boxes themselves, though some are turned in theirs.
    assert problems == [] and agreement.mesh == [] and np.mean(agreement.box) > 0.85


@pytest.mark.parametrize(
    "wrong",
    [
        np.diag([-1.0, 1, 1, 1]),  # mirrored
        np.diag([1.0, -1, -1, 1]),  # OpenGL for OpenCV
        np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),  # axes mixed up
        np.diag([100.0, 100, 100, 1]),  # centimetres
    ],
    ids=["mirrored", "opengl", "axes", "unit"],
)
def test_a_wrong_axis_does_not_agree(made, wrong):
    views, truth, models = made
    moved = replace(truth, model_to_room=(wrong @ truth.model_to_room).astype(np.float32))
    agreement, problems = measure(views, moved, models)
    assert len(agreement.mesh) == unoccluded(views).sum() and np.mean(agreement.mesh) < 0.6
    assert len(problems) >= 2 and "m off the box round its placed mesh" in problems[0]


def test_models_that_are_missing_or_damaged_are_named(made):
    views, truth, models = made
    path = models.folder / f"{truth.model_ids[0]}.ply"
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    fresh = ModelPoints(models.folder)
    with pytest.raises(ShardError, match=r"\.ply is damaged \(\w+\), but ground truth stands on"):
        fresh.get(truth.model_ids[0])
    path.unlink()
    _, problems = measure(views, truth, fresh)
    assert problems[0].endswith(".ply is missing, but ground truth stands on it")
    path.write_bytes(whole)
    assert fresh.get(truth.model_ids[0]).shape[1] == 3
    nothing = whole.replace(b"element face 12", b"element face 0 ")
    assert nothing != whole
    path.write_bytes(nothing)
    with pytest.raises(ShardError, match=r"holds no usable faces|is damaged"):
        ModelPoints(models.folder).get(truth.model_ids[0])


def test_agreements_add_up():
    assert Agreement([1.0], [0.5]) + Agreement([0.5]) == Agreement([1.0, 0.5], [0.5])
