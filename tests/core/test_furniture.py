"""3D-FUTURE's folder: which class a model has in which label set, and folders that are not it."""

import json

import pytest

from sceneprior.core.errors import InputError
from sceneprior.core.furniture import class_of_category, model_categories


@pytest.mark.parametrize(
    ("category", "name", "wanted"),
    [
        ("king-size bed", "front3d_bedroom", "double_bed"),
        ("children cabinet", "front3d_bedroom", "children_cabinet"),
        ("children cabinet", "front3d_living", "cabinet"),
        ("children cabinet", "front3d_all", "children_cabinet"),
        ("barstool", "front3d_bedroom", "void"),
        ("barstool", "front3d_all", "stool"),
        ("children cabinet", "scannet", "cabinet"),  # no children_cabinet there
        ("king-size bed", "scannet", "void"),
        ("king-size bed", "void,king-size bed,table", "king-size bed"),  # the category's own name
        ("dining table", "void,king-size bed,table", "table"),
        ("others", "front3d_bedroom", "void"),
        ("flying saucer", "front3d_bedroom", "void"),
    ],
)
def test_classes_of_categories(category, name, wanted):
    assert class_of_category(category, name) == wanted


def test_categories_are_tidied_and_damage_is_a_sentence(tmp_path):
    with pytest.raises(InputError, match=r"No folder at .*; --models names the folder"):
        model_categories(tmp_path / "none", "--models")
    with pytest.raises(InputError, match=r"has no model_info\.json .* --models usually ends in"):
        model_categories(tmp_path, "--models")
    path = tmp_path / "model_info_revised.json"
    rows = [
        {"model_id": "a", "category": "Sideboard / Side Cabinet / Console Table"},
        {"model_id": "b", "category": None},
    ]
    path.write_text(json.dumps(rows))
    assert model_categories(tmp_path) == {
        "a": "sideboard/side cabinet/console table",
        "b": "others",
    }
    path.write_text(json.dumps([{"category": "Bed"}]))
    with pytest.raises(InputError, match="is not 3D-FUTURE's list of models"):
        model_categories(tmp_path)
