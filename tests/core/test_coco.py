"""COCO's JSON of one image: every way to write a mask, and sentences for damaged ones."""

import json
import tracemalloc

import numpy as np
import pytest
from pycocotools import mask as reference

from sceneprior.core.coco import read_coco
from sceneprior.core.errors import InputError

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


BOX = [[1, 1, 9, 1, 9, 9]]


def image(height, width) -> dict:
    return coco([BOX], images=[{"id": 1, "height": height, "width": width}])


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


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ([], "a.json is a list of results, not a COCO JSON of masks; expected an object with"),
        ([{"image_id": 1, "category_id": 1, "segmentation": []}], "add the other two."),
        (3, "a.json is 3, not a COCO JSON of masks"),
        ({"images": []}, "not a COCO JSON of masks: annotations is {'images': []}; field required"),
        (coco([], images=[]), "describes 0 images; keep one"),
        (coco([]), "has 0 annotations; expected 1 to 65534"),
        (coco([[[1, 1, 2, 2]]]), "annotation 70: its segmentation is neither polygons nor run"),
        (coco([[[1, 1, 2, 2, float("nan"), 3]]]), "a corner is not a finite number"),
        (coco([{"size": [60, 80], "counts": [4800]}]), "its mask has 80 x 60 pixels, but the"),
        (coco([{"size": [30, 40], "counts": "\u00ff"}]), "is not a digit of compressed run"),
        (coco([{"size": [30, 40], "counts": "P"}]), "compressed run lengths end within a number"),
        (coco([[[1, 1, 2, 2, 1, 3]]], categories=[]), "category 1 is not among its categories"),
        (
            coco([BOX], categories={"1": "bed"}),
            "categories is {'1': 'bed'}; input should be a valid",
        ),
        (image(0, 40), "images.0.height is 0; input should be greater than or equal to 1."),
        (image(10**400, 40), "pixels, more than 67 million; write the masks of a smaller image"),
        (coco([{"counts": [1200]}]), "annotation 70: its segmentation has no 'size'."),
        (coco([{"size": [30], "counts": [30]}]), "its mask has [30] pixels, but the image has"),
        (coco([{"size": [30, 40], "counts": [10**30]}]), "its runs cover too many pixels, not"),
        (
            coco([{"size": [30, 40], "counts": "o" * 9_999}]),
            "a number of its compressed run lengths",
        ),
    ],
)
def test_what_is_no_image_of_masks(read, data, said):
    with pytest.raises(InputError) as error:
        read(data)
    assert said in str(error.value)


def test_a_large_image_of_many_masks_takes_little_memory(read):
    """Masks are decoded one at a time: all 40 masks of 4 million pixels would take 160 MB, and
    their polygons another 128 MB."""
    side = 2_000
    boxes = [[[0, 0, 90 * k, 0, 90 * k, 50, 0, 50]] for k in range(1, 21)]
    runs = [{"size": [side, side], "counts": [side * k, side, side * (side - k - 1)]}
            for k in range(20)]  # fmt: skip
    everything = [[-1e9, -1e9, 1e9, -1e9, 1e9, 1e9, -1e9, 1e9]]
    sizes = [{"id": 1, "height": side, "width": side}]
    tracemalloc.start()
    ids, _ = read(coco([*boxes, *runs, everything], images=sizes))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 150e6
    # The smallest is in front, of two as large (20 columns of 2,000 pixels) the later.
    assert [int(each) for each in ids[10, [5, 25, 95, 1999]]] == [26, 1, 2, 41]
    assert ids[1000, 19] == 40
