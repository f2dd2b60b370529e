"""The label table, with the quirks of the release's."""

import pytest
from scan_files import TABLE, write_table

from data_prep.readers.scannet.labels import read_labels
from sceneprior.core.classes import STUFF
from sceneprior.core.errors import InputError


def test_raw_categories_become_the_nineteen_classes(labels):
    assert labels.label("couch") == "sofa"
    assert labels.label("nightstand") == "night stand"
    assert labels.label(" Bed ") == "bed"
    for category in ("backpack", "wall", "floor", "never heard of"):
        assert labels.label(category) == "void"
    assert labels.knows("backpack") and not labels.knows("never heard of")
    assert labels.is_shell("wall") and labels.is_shell("floor")
    assert not labels.is_shell("backpack") and not labels.is_shell("never heard of")
    for category in ("wall", "floor", "backpack", "never heard of"):
        name = category if labels.is_shell(category) else "unknown"
        assert STUFF[labels.stuff(category)] == name


def test_the_last_row_of_a_category_wins(tmp_path):
    rows = [
        *TABLE,
        ("11", "armoire", "wardrobe", "1", "39", "otherfurniture"),  # a repeated id changes nothing
        ("12", "chair", "chair", "4646", "7", "table"),
    ]
    labels = read_labels(write_table(tmp_path / "a.tsv", rows))
    assert labels.label("chair") == "table"
    assert labels.label("bed") == "bed" and labels.label("armoire") == "void"


def test_columns_are_found_by_name(tmp_path):
    """Version 1 of the table has other columns; rows that are cut short are left out."""
    rows = [("nyu40class", "x", "raw_category"), ("bed", "1", 'a 12" bed'), ("sofa",)]
    labels = read_labels(write_table(tmp_path / "a.tsv", rows))
    assert labels.nyu40 == {'a 12" bed': "bed"} and labels.source == "a.tsv"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no columns raw_category and nyu40class .it begins with nothing"),
        (
            "id,raw_category,nyu40class\n",
            "begins with id,raw_category,nyu40class.; .* tab separated",
        ),
        (
            "category\tcount\tnyuId\tnyu40id\teigen13id\tnyuClass\tnyu40class\nbed\t3\n",
            r"first release; give the second one's, scannetv2-labels\.combined\.tsv, with --labels",
        ),
        ("id\traw_category\tnyu40class\n", "lists no categories"),
    ],
)
def test_what_is_not_the_table(tmp_path, text, words):
    path = tmp_path / "a.tsv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_labels(path)


def test_a_table_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"table .*a\.tsv cannot be read .*scannetv2-labels"):
        read_labels(tmp_path / "a.tsv")
    (tmp_path / "a.tsv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"cannot be read .*utf-8"):
        read_labels(tmp_path / "a.tsv")
