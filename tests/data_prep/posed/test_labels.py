"""Tables of classes and label sets of one's own."""

import pytest

from data_prep.readers.posed.labels import find_table, read_label_set
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import read_class_table


def table(folder, text, name="classes.json"):
    (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("classes.json", '{"1": "bed", " 300 ": "night stand"}'),
        ("classes.csv", "id,class\n1,bed\n\n300,night stand\n"),
        ("classes.csv", "\ufeff1,bed,note\n 300 ,night stand"),
    ],
)
def test_tables(tmp_path, name, text):
    found = find_table(table(tmp_path, text, name))
    assert read_class_table(found) == {1: "bed", 300: "night stand"}


def test_one_table_a_room(tmp_path):
    with pytest.raises(
        InputError, match=r"has no classes\.json or .* or panoptic\.json; expected one table"
    ):
        find_table(tmp_path)
    table(table(tmp_path, "{}"), "", "classes.csv")
    with pytest.raises(InputError, match=r"has classes\.json and classes\.csv; expected one table"):
        find_table(tmp_path)


def test_label_sets(tmp_path):
    assert read_label_set("scannet") == "scannet"
    assert read_label_set("void, bed,night stand") == "void,bed,night stand"
    path = tmp_path / "classes.txt"
    path.write_text("# mine\nvoid\nbed\n\n night stand \n")
    assert read_label_set(str(path)) == "void,bed,night stand"
    (tmp_path / "a.json").write_text('["bed", "chair"]')
    assert label_set(read_label_set(str(tmp_path / "a.json"))) == ("void", "bed", "chair")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        (
            "a.txt",
            "bed\nbed\n",
            "a.txt: The class 'bed' is in the label set twice; list it once.",
        ),
        ("a.txt", "# nothing\n", "a.txt: A label set needs at least one class in addition to"),
        ("a.json", "{", "a.json holds no class names (Expecting"),
        ("a.json", '{"1": "bed"}', "a.json holds no list of class names."),
        ("a.json", '["bed, large"]', "a.json: The class name 'bed, large' has a comma, which"),
    ],
)
def test_bad_label_sets(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as error:
        read_label_set(str(tmp_path / name))
    assert said in str(error.value)
    with pytest.raises(
        InputError, match=r"nowhere is neither a file with one class per line, nor one"
    ):
        read_label_set("nowhere")
