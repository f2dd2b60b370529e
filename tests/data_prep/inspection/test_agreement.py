"""Ground truth against masks: right rooms agree, each kind of wrong one does not."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from front_jobs import bedroom_shards, rooms_of

from data_prep.inspection.agreement import MARGIN, Agreement, Tally, compare, compare_boxes
from data_prep.inspection.bodies import hull_of_model, true_bodies
from sceneprior.core.errors import ShardError

LARGER = ("views.image_size=[180, 240]", "views.per_m2=2")


@pytest.fixture(scope="module")
def made(made_once):
    """(views, truth, folder of shards) of a bedroom. Tests only read it."""
    folder = made_once("large_bedroom", lambda folder: bedroom_shards(folder, *LARGER))
    (pair,) = rooms_of(folder).values()
    return *pair, folder


def test_whole_things_are_those_that_nothing_cuts_off(made):
    views, _, _ = made
    bodies, _ = true_bodies(*made)
    seen = compare(bodies, views)
    height, width = views.image_size
    assert 3 < seen.whole.sum() < views.visible.sum() and (seen.judged == views.visible).all()
    for view, k in zip(*np.nonzero(seen.whole), strict=True):
        rows, columns = np.nonzero(views.instance_ids[view] == k + 1)
        assert rows.min() > 0 and rows.max() < height - 1
        assert columns.min() > 0 and columns.max() < width - 1
        assert views.sides_clear[view, k].all()


def test_a_right_room_agrees_to_the_pixel(made):
    bodies, problems = true_bodies(*made)
    seen = compare(bodies, made[0])
    assert problems == [] and set(seen.kinds) == {"mesh"}
    assert seen.iou[seen.judged & seen.whole].min() > 0.85
    tally = seen.agreement.of("mesh")
    # What is hidden in part lies within its projection, too.
    assert tally.share == 1.0 and tally.masks == made[0].visible.sum() and tally.mean_iou > 0.95


def test_without_meshes_the_boxes_stand_for_them(made):
    views, truth, shards = made
    bare = replace(truth, model_ids=("",) * len(truth.model_ids))
    bodies, problems = true_bodies(views, bare, shards)
    # These pieces are boxes themselves, though some are turned in theirs.
    tally = compare(bodies, views).agreement.of("box")
    assert problems == [] and tally.share == 1.0 and tally.mean_iou > 0.85


def test_what_is_undefined_disagrees_and_the_margin_is_what_it_says(made):
    views, _, _ = made
    bodies, _ = true_bodies(*made)
    height, width = views.image_size
    boxes = views.boxes * np.array([width, height, width, height], dtype=float)
    margin = MARGIN * width
    for grow, share in ((0.0, 1.0), (-0.99 * margin, 1.0), (-1.01 * margin, 0.0), (50, 1.0)):
        wider = boxes + np.array([-grow, -grow, grow, grow])
        assert compare_boxes(bodies, wider, views).agreement.of("mesh").share == share
    behind = compare_boxes(bodies, np.full(boxes.shape, np.nan), views).agreement.of("mesh")
    assert behind.masks == views.visible.sum() and behind.share == behind.mean_iou == 0.0
    assert Agreement({"mesh": behind}).failing() == ["mesh"]


def test_models_that_are_missing_or_damaged_are_named(made, tmp_path):
    views, truth, _ = made
    shards = shutil.copytree(made[2], tmp_path / "shards")
    path = shards / "models" / f"{truth.model_ids[0]}.ply"
    whole = path.read_bytes()
    hull_of_model.cache_clear()
    for damaged in (whole[:-20], whole.replace(b"element face 12", b"element face 0 ")):
        path.write_bytes(damaged)
        with pytest.raises(ShardError, match=r"\.ply is not a triangle mesh \(\w+: "):
            hull_of_model(path)
    path.unlink()
    bodies, problems = true_bodies(views, truth, shards)
    assert None in bodies and not compare(bodies, views).judged[:, bodies.index(None)].any()
    assert ".ply is missing, but a room's ground truth refers to it" in problems[0]


def test_agreements_add_up():
    first, second = Tally(4, 3, 2, 1.5), Tally(6, 6)
    total = Agreement({"box": first}) + Agreement({"box": second, "mesh": second})
    assert total.tallies == {"mesh": second, "box": Tally(10, 9, 2, 1.5)}
    assert total.of("box").share == 0.9 and total.of("box").mean_iou == 0.75
    assert total.failing() == [] and Agreement({"box": first}).failing() == ["box"]
    assert Agreement({"box": first}).failing(least=5) == [] and np.isnan(second.mean_iou)


def test_a_mirrored_truth_does_not_agree(made):
    views, truth, shards = made
    mirror = np.diag([-1.0, 1, 1, 1])
    moved = replace(truth, model_to_room=(mirror @ truth.model_to_room).astype(np.float32))
    bodies, problems = true_bodies(views, moved, shards)
    tally = compare(bodies, views).agreement.of("mesh")
    assert tally.masks == views.visible.sum() and tally.mean_iou < 0.6
    assert Agreement({"mesh": tally}).failing() == ["mesh"]
    assert len(problems) >= 2 and "m from the box around its placed mesh" in problems[0]
