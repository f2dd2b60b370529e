"""Recipes: what ships, how rules change, and what is no rule."""

import pytest

from data_prep.front.recipe import load_recipe, recipe_text
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.furniture import category_table


def test_recipes_load_and_say_what_is_wrong():
    recipe = load_recipe("bedroom", ("max_floor_m=null", "views.per_m2=3"))
    assert recipe.max_floor_m is None and recipe.views.per_m2 == 3
    assert recipe.of_type("MasterBedroom") and not recipe.of_type("LivingRoom")
    assert load_recipe("living").of_type("LivingDiningRoom")
    with pytest.raises(
        InputError, match="No recipe is called 'attic'; choose from all, atiss_bedroom, atiss_d"
    ):
        load_recipe("attic")
    with pytest.raises(
        InputError,
        match=r"bedroom\.yaml: unknown key 'max_flor_m'; the nearest valid key is 'max_fl",
    ):
        load_recipe("bedroom", ("max_flor_m=3",))
    with pytest.raises(InputError, match=r"--rule takes section\.key=value, got 'max_floor_m'"):
        load_recipe("bedroom", ("max_floor_m",))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("max_floor_m=[", "--rule max_floor_m=.: '.' is not a YAML value"),
        (
            "max_floor_m=wide",
            r"bedroom\.yaml: 'max_floor_m': input should be a valid number .got 'wide'",
        ),
        ("min_objects=2.5", "'min_objects': input should be a valid integer .got 2.5"),
        ("scale_range=[1]", r"'scale_range\.1' is missing"),
        (
            "required_classes=[bed]",
            r"bedroom\.yaml: 'bed' is not in its label set, which has void, armchair,",
        ),
        ("categories=[crib]", r"'categories': input should be a valid dictionary"),
        ("label_set=attic", "No label set is called 'attic'; there are front3d_bedroom,"),
        (
            "label_set=[bed, bed]",
            r"'label_set': the class 'bed' is in the label set twice; list it once .got",
        ),
        (
            "views.image_size=[0, 0]",
            r"'views\.image_size\.0': .* greater than or equal to 8 .got 0",
        ),
    ],
)
def test_values_that_a_rule_does_not_take(change, said):
    with pytest.raises(InputError, match=said):
        load_recipe("bedroom", (change,))


TYPES = {
    "bedroom": ["Bedroom", "MasterBedroom", "SecondBedroom"],
    "living": ["LivingRoom", "LivingDiningRoom"],
    "dining": ["DiningRoom", "LivingDiningRoom"],
    "library": ["Library"],
    "kitchen": ["Kitchen"],
}
ALL_TYPES = [
    *sorted({kind for kinds in TYPES.values() for kind in kinds}),
    "Bathroom", "KidsRoom", "ElderlyRoom", "OtherRoom", "none", "",
]  # fmt: skip


@pytest.mark.parametrize("name", [*TYPES, "all"])
def test_every_room_type_has_a_recipe_and_a_label_set(name):
    recipe = load_recipe(name)
    assert recipe.label_set == f"front3d_{name}"
    wanted = TYPES.get(name, ALL_TYPES)
    assert [kind for kind in ALL_TYPES if recipe.of_type(kind)] == sorted(
        wanted, key=ALL_TYPES.index
    )
    classes = {recipe.class_of(category) for category in category_table()}
    assert classes == set(label_set(recipe.label_set))
    # Any rule can be switched off.
    off = [f"{rule}=null" for rule in ("min_objects", "max_objects", "max_floor_m", "max_height_m")]
    recipe = load_recipe(name, (*off, "required_classes=null", "scale_range=null"))
    assert (
        recipe.min_objects is recipe.max_objects is recipe.max_floor_m is recipe.scale_range is None
    )
    assert recipe.required_classes == ()


def test_all_rooms_have_the_classes_of_both_lists():
    class_of = load_recipe("all").class_of
    assert class_of("king-size bed") == "double_bed" and class_of("nightstand") == "nightstand"
    assert class_of("barstool") == "stool"  # void in bedrooms
    assert class_of("children cabinet") == "children_cabinet"  # a cabinet in living rooms
    assert class_of("wine cooler") == "void" and class_of("corner/side table") == "table"


@pytest.mark.parametrize("name", [*TYPES, "all"])
def test_a_printed_recipe_is_the_recipe_with_its_categories(tmp_path, name):
    path = tmp_path / f"{name}.yaml"
    path.write_text(recipe_text(name))
    printed, shipped = load_recipe(str(path)), load_recipe(name)
    assert printed.categories and not shipped.categories
    assert printed.model_copy(update={"categories": {}}) == shipped
    for category in category_table():
        assert printed.class_of(category) == shipped.class_of(category)


KITCHEN = """
label_set: [fridge, sink, table]
room_types: [kitchen]
categories: {Washbasin / Basin: sink, "cutting board": void}
scale_range: [1e-3, 5]
"""


def test_a_recipe_of_the_users_own(tmp_path):
    path = tmp_path / "kitchens.yaml"
    path.write_text(KITCHEN)
    recipe = load_recipe(str(path), ("views.per_m2=3",))
    assert (recipe.name, recipe.label_set) == ("kitchens", "void,fridge,sink,table")
    with pytest.raises(
        InputError,
        match=r"kitchens\.yaml is a file, not a recipe of the package.*use yours as it is",
    ):
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
    assert [category for category in classes if not recipe.knows(category)] == [
        "nightstand", "stove",
    ]  # fmt: skip
    assert load_recipe("bedroom").knows("floor lamp") and not load_recipe("bedroom").knows("stove")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("none.yaml", None, r"No recipe at .*none\.yaml; `sceneprior recipe bedroom` prints one"),
        ("odd.yaml", "[1, 2]", r"odd\.yaml holds no settings"),
        ("odd.yaml", "label_set: [", r"odd\.yaml is not a YAML file"),
        ("odd.yaml", "room_types: [kitchen]", r"odd\.yaml: 'label_set' is missing"),
        ("\n.yaml", KITCHEN, r"shards cannot be named by its name, '.n'"),
    ],
)
def test_files_that_are_no_recipe(tmp_path, name, text, said):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=said):
        load_recipe(str(path))


@pytest.mark.parametrize("kind", ["bedroom", "living", "dining"])
def test_atiss_filters_have_a_recipe_of_their_own(kind):
    recipe, ours = load_recipe(f"atiss_{kind}"), load_recipe(kind)
    assert (recipe.min_objects, ours.min_objects) == (3, 2)
    assert recipe.max_objects == (13 if kind == "bedroom" else 21)
    assert recipe.max_floor_m == (6 if kind == "bedroom" else 12)
    assert recipe.furniture_between_m == (-0.005, 4.0) and recipe.max_height_m is None
    assert not recipe.allow_mirrored and recipe.label_set == ours.label_set
    beds = ("double_bed", "single_bed", "kids_bed") if kind == "bedroom" else ()
    assert recipe.required_classes == beds
    # Every category of its list is known and has a class, so counting all pieces or classes is one.
    assert len(recipe.allowed_categories) == (30 if kind == "bedroom" else 26)
    assert set(recipe.allowed_categories) <= set(category_table())
    assert all(recipe.class_of(category) != "void" for category in recipe.allowed_categories)


def test_lists_of_what_is_invalid_are_read_where_the_user_has_them(tmp_path):
    path = tmp_path / "rooms.txt"
    path.write_text("Bedroom-2\n\nBedroom-1\n")
    recipe = load_recipe("bedroom", (f"invalid_rooms={path}", "invalid_models=[a, b]"))
    assert recipe.invalid_rooms == ("Bedroom-1", "Bedroom-2")
    assert recipe.invalid_models == ("a", "b")
    with pytest.raises(InputError, match="invalid_models names a file of ids that cannot be read"):
        load_recipe("bedroom", (f"invalid_models={tmp_path / 'none.txt'}",))
