"""Tables of instance ids, and what the values of masks become."""

import numpy as np
import pytest

from sceneprior.core.classes import STUFF
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import IdTable, read_class_table, stuff_of


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("classes.json", "{", "classes.json cannot be read (Expecting property name"),
        ("classes.json", "{}", "classes.json is empty; expected a class for each instance id."),
        ("classes.json", "[[1]]", 'is not an object of ids and class names, as {"1": "bed", "2"'),
        ("classes.json", '"bed"', "is not an object of ids and class names"),
        ("classes.json", '{"0": "bed"}', "'0' is not an instance id; expected a number from 1 to"),
        ("classes.json", '{"1": "bed", "1": "sofa"}', "instance id 1 is listed twice."),
        ("classes.csv", "1,bed\n1,sofa", "instance id 1 is listed twice."),
        ("classes.csv", "1\n", "classes.csv cannot be read (a row '1' has no class)."),
    ],
)  # fmt: skip
def test_bad_tables(tmp_path, name, text, said):
    with pytest.raises(InputError) as error:
        (tmp_path / name).write_text(text)
        read_class_table(tmp_path / name)
    assert said in str(error.value)


def test_a_missing_table_is_a_sentence(tmp_path):
    with pytest.raises(InputError, match=r"a\.csv cannot be read \(.*No such file"):
        read_class_table(tmp_path / "a.csv")


def test_values_become_ids_in_the_tables_order():
    names = {7: "Wall", 5: "night_stand", 9: "teapot", 2: "Double Bed"}
    table = IdTable(names, "front3d_bedroom", "here")
    ids = table.ids(np.array([[0, 7, 5], [9, 2, 4]]))
    # 2, 5 and 9 are instances; the wall is nothing; 4 is not in the table: one more than the last.
    np.testing.assert_array_equal(ids, [[0, 0, 2], [3, 1, 4]])
    np.testing.assert_array_equal(table.classes > 0, [True, False, False, False])
    assert table.unlisted == {4}
    assert table.notes == ["classes outside the label set are void: night_stand (1), teapot (1)"]


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


def test_a_table_without_any_class_of_the_set():
    with pytest.raises(
        InputError, match=r"here: none of its classes \(teapot\) is in the label set"
    ):
        IdTable({1: "teapot"}, "front3d_bedroom", "here")


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


def test_rows_of_segmenters_that_name_no_class(tmp_path):
    for text in ('[{"id": 1, "category_id": 3}]', '[{"label": "bed"}]', '[{"id": 1, "label": 3}]'):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(InputError, match="is not an object of ids and class names"):
            read_class_table(tmp_path / "a.json")
