"""Images of instance ids, tables of their classes, and values in messages."""

from typing import Any

import numpy as np
import pytest
from PIL import Image

from sceneprior.core.checked import shown
from sceneprior.core.classes import STUFF
from sceneprior.core.id_tables import IdTable, mask_size, read_class_table, read_mask, stuff_of


def test_values_become_ids_in_the_tables_order():
    names = {7: "Wall", 5: "night_stand", 9: "teapot", 2: "Double Bed"}
    table = IdTable(names, "front3d_bedroom", "here")
    ids = table.ids(np.array([[0, 7, 5], [9, 2, 4]]))
    # 2, 5 and 9 are instances; the wall is nothing; 4 is not in the table: one more than the last.
    np.testing.assert_array_equal(ids, [[0, 0, 2], [3, 1, 4]])
    np.testing.assert_array_equal(table.classes > 0, [True, False, False, False])
    assert table.unlisted == {4}
    assert table.notes == [
        "classes outside the label set are void: night_stand (1: nightstand?), teapot (1)"
    ]


@pytest.mark.parametrize(
    ("name", "stuff"),
    [
        ("Wall", "wall"), ("wall-other-merged", "wall"), ("floor-wood", "floor"),
        ("rug-merged", "floor"), ("carpet", "floor"), ("ceiling-merged", "ceiling"),
        ("door-stuff", "door"), ("window-blind", "window"), ("windowpane", "window"),
        ("floor lamp", "unknown"), ("wall cabinet", "unknown"), ("bed", "unknown"),
        ("background", "unknown"), ("doormat", "unknown"),
    ],
)  # fmt: skip
def test_stuff_has_names_of_public_data_sets(name, stuff):
    assert STUFF[stuff_of(name)] == stuff


def test_stuff_is_background_unless_the_label_set_has_its_class():
    table = IdTable({1: "bed", 2: "rug", 3: "wall-wood", 4: "picture"}, "void,bed", "here")
    values = np.array([0, 1, 2, 3, 4, 5, -1])
    np.testing.assert_array_equal(table.ids(values), [0, 1, 0, 0, 0, 2, 2])
    floor, wall = STUFF.index("floor"), STUFF.index("wall")
    np.testing.assert_array_equal(table.stuff(values), [0, 0, floor, wall, 0, 0, 0])
    own = IdTable({1: "bed", 2: "rug"}, "void,bed,rug", "here")
    np.testing.assert_array_equal(own.ids(values[:3]), [0, 1, 2])
    assert not own.stuff(values).any()


@pytest.mark.parametrize(
    "text",
    [
        '[{"id": 1, "label": "bed", "score": 0.9}, {"id": 7, "label": "chair"}]',
        '[{"value": 0, "label": "background"}, {"value": 1, "label": "bed"}, '
        '{"value": 7, "label": "chair"}]',
        '{"segments_info": [{"id": 1, "class_name": "bed"}, {"id": 7, "class_name": "chair"}]}',
        '{"mask_name": "a.npy", "labels": {"1": "bed", "7": "chair"}}',
    ],
)
def test_tables_as_segmenters_write_them(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    assert read_class_table(tmp_path / "a.json") == {1: "bed", 7: "chair"}


IDS = np.array([[0, 1, 2], [7, 200, 255]])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.png"


@pytest.mark.parametrize("kind", ["8 bits", "16 bits", "palette"])
def test_the_values_are_the_ids(path, kind):
    ids = IDS * 257 if kind == "16 bits" else IDS
    picture = Image.fromarray(ids.astype(np.uint16 if kind == "16 bits" else np.uint8))
    if kind == "palette":
        picture.putpalette(list(range(255, -1, -1)) * 3)
        assert picture.mode == "P"
    picture.save(path)
    read = read_mask(path)
    np.testing.assert_array_equal(read, ids)
    assert read.dtype == np.uint16 and mask_size(path) == (2, 3)


def test_deep_and_long_values_are_shown_short():
    deep: Any = 0
    for _ in range(5000):
        deep = [deep]
    for value in (deep, {"\ud800": deep}, ["x" * 9999] * 9999, 10**9999, float("nan")):
        assert len(shown(value)) <= 62 and shown(value).isprintable()
