"""COCO's JSON of one image: every way to write a mask, and sentences for damaged ones."""

import json

import numpy as np
import pytest
from pycocotools import mask as reference

from sceneprior.core.coco import read_coco

SIZE = (30, 40)


@pytest.fixture
def blob(rng) -> np.ndarray:
    """Runs of many lengths, long ones among them."""
    mask = rng.random(SIZE) < 0.4
    mask[:, 20:26] = True
    return mask


def coco(segmentations, names=("bed", "chair"), **changes) -> dict:
    rows = [
        {"id": 70 + k, "image_id": 1, "category_id": 1 + k % len(names), "segmentation": each}
        for k, each in enumerate(segmentations)
    ]
    return {
        "images": [{"id": 1, "height": SIZE[0], "width": SIZE[1], "file_name": "a.jpg"}],
        "categories": [{"id": k + 1, "name": name} for k, name in enumerate(names)],
        "annotations": rows,
        **changes,
    }


@pytest.fixture
def read(tmp_path):
    def read(data):
        (tmp_path / "a.json").write_text(json.dumps(data))
        return read_coco(tmp_path / "a.json")

    return read


def packed(mask: np.ndarray) -> dict:
    made = reference.encode(np.asfortranarray(mask.astype(np.uint8)))
    return {"size": list(SIZE), "counts": made["counts"].decode()}


def runs_of(mask: np.ndarray) -> dict:
    counts, before = [0], False
    for pixel in mask.T.ravel().tolist():
        if pixel != before:
            counts.append(0)
            before = pixel
        counts[-1] += 1
    return {"size": list(SIZE), "counts": counts}


def test_run_lengths_packed_or_not_are_the_mask(read, blob):
    for mask in (blob, ~blob, np.ones(SIZE, bool)):
        for segmentation in (packed(mask), runs_of(mask)):
            ids, classes = read(coco([segmentation]))
            np.testing.assert_array_equal(ids, mask)
            assert classes == {1: "bed"} and ids.dtype == np.uint16


def test_polygons_cover_the_pixels_whose_centres_they_hold(read):
    ids, _ = read(coco([[[3, 2, 13, 2, 13, 7, 3, 7], [20, 10, 30, 10, 20, 20]]]))
    wanted = np.zeros(SIZE, bool)
    wanted[2:7, 3:13] = True
    np.testing.assert_array_equal(ids[:, :15] > 0, wanted[:, :15])
    # The triangle of 50 px**2: of its hypotenuse half the pixels' centres count, or none.
    assert 45 <= (ids[:, 15:] > 0).sum() <= 55
    theirs = reference.decode(
        reference.merge(
            reference.frPyObjects([[3, 2, 13, 2, 13, 7, 3, 7], [20, 10, 30, 10, 20, 20]], *SIZE)
        )
    )
    assert ((ids > 0) != theirs.astype(bool)).sum() <= 12  # of the same hypotenuse


def test_what_is_small_is_in_front_and_crowds_are_no_object(read):
    table = [[2, 2, 32, 2, 32, 22, 2, 22]]
    cup = [[10, 10, 14, 10, 14, 14, 10, 14]]
    data = coco([cup, table])
    data["annotations"][1]["iscrowd"] = 1
    ids, classes = read(data)
    assert ids[12, 12] == 1 and ids[5, 5] == 2 and ids[0, 0] == 0
    assert classes == {1: "bed", 2: "crowd"}
