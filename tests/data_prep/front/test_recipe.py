"""Recipes: what ships, how rules change, and what is no rule."""

import pytest
from golden_values import hold
from refusals import refused

from data_prep.front.recipe import load_recipe, recipe_text
from sceneprior.core.classes import label_set
from sceneprior.core.furniture import category_table

SHIPPED = ("bedroom", "living", "dining", "library", "kitchen", "all", "atiss_bedroom",
           "atiss_living", "atiss_dining")  # fmt: skip
KITCHEN = """
label_set: [fridge, sink, table]
room_types: [kitchen]
categories: {Washbasin / Basin: sink, "cutting board": void}
scale_range: [1e-3, 5]
"""


@pytest.mark.parametrize("name", SHIPPED)
def test_what_ships_is_as_before_and_prints_itself(name, tmp_path):
    shipped = load_recipe(name)
    classes = {category: shipped.class_of(category) for category in category_table()}
    hold("recipes", {name: {**shipped.model_dump(), "classes": classes}})
    assert set(classes.values()) == set(label_set(shipped.label_set))
    # Every category that ATISS lists has a class, so counting all pieces or classes is one.
    assert all(classes[category] != "void" for category in shipped.allowed_categories)
    path = tmp_path / f"{name}.yaml"
    path.write_text(recipe_text(name))
    printed = load_recipe(str(path))
    assert printed.categories and not shipped.categories
    assert printed.model_copy(update={"categories": {}}) == shipped
    assert all(printed.class_of(category) == label for category, label in classes.items())


def test_rules_change_and_can_be_switched_off():
    recipe = load_recipe("bedroom", ("max_floor_m=null", "views.per_m2=3", "required_classes=null"))
    assert recipe.max_floor_m is None and recipe.views.per_m2 == 3 and recipe.required_classes == ()
    assert recipe.of_type("MasterBedroom") and not recipe.of_type("LivingRoom")
    assert load_recipe("living").of_type("LivingDiningRoom") and load_recipe("all").of_type("")


@pytest.mark.parametrize(
    "change",
    ["max_flor_m=3", "max_floor_m", "max_floor_m=[", "max_floor_m=wide", "min_objects=2.5",
     "scale_range=[1]", "required_classes=[bed]", "categories=[crib]", "label_set=attic",
     "label_set=[bed, bed]", "views.image_size=[0, 0]", "invalid_models=/nowhere/none.txt"],
)  # fmt: skip
def test_values_that_a_rule_does_not_take(change):
    with refused(f"front/rule {change}"):
        load_recipe("bedroom", (change,))


def test_a_recipe_of_the_users_own(tmp_path):
    path = tmp_path / "kitchens.yaml"
    path.write_text(KITCHEN)
    recipe = load_recipe(str(path), ("views.per_m2=3",))
    assert (recipe.name, recipe.label_set) == ("kitchens", "void,fridge,sink,table")
    with refused("front/print a recipe of the user's own", tmp=tmp_path):
        recipe_text(str(path))
    assert recipe.scale_range == (1e-3, 5.0) and recipe.views.per_m2 == 3
    classes = {
        "fridge": "fridge",  # the class of its own name
        "washbasin/basin": "sink",  # as `categories` says, tidied as the data set's are
        "dining table": "table",  # as the paper's table says
        "nightstand": "void", "cutting board": "void", "stove": "void",
    }  # fmt: skip
    assert {category: recipe.class_of(category) for category in classes} == classes
    # The paper's table decides nothing about void in a list of classes that is not the paper's.
    unknown = [category for category in classes if not recipe.knows(category)]
    assert unknown == ["nightstand", "stove"]
    assert load_recipe("bedroom").knows("floor lamp") and not load_recipe("bedroom").knows("stove")


@pytest.mark.parametrize(
    ("name", "text"),
    [("attic", None), ("none.yaml", None), ("list.yaml", "[1, 2]"), ("cut.yaml", "label_set: ["),
     ("short.yaml", "room_types: [kitchen]"), ("\n.yaml", KITCHEN)],
)  # fmt: skip
def test_files_that_are_no_recipe(tmp_path, name, text):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with refused(f"front/recipe {name.strip()}", tmp=tmp_path):
        load_recipe(str(path) if "." in name else name)


def test_lists_of_what_is_invalid_are_read_where_the_user_has_them(tmp_path):
    path = tmp_path / "rooms.txt"
    path.write_text("Bedroom-2\n\nBedroom-1\n")
    recipe = load_recipe("bedroom", (f"invalid_rooms={path}", "invalid_models=[a, b]"))
    assert recipe.invalid_rooms == ("Bedroom-1", "Bedroom-2")
    assert recipe.invalid_models == ("a", "b")
