"""Recipes: what ships, how rules change, and what is no rule."""

import pytest

from data_prep.front.recipe import load_recipe
from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.furniture import category_classes


def test_recipes_load_and_say_what_is_wrong():
    recipe = load_recipe("front3d_bedroom", ("max_floor_m=null", "views.per_m2=3"))
    assert recipe.max_floor_m is None and recipe.views.per_m2 == 3
    assert recipe.of_type("MasterBedroom") and not recipe.of_type("LivingRoom")
    assert load_recipe("front3d_living").of_type("LivingDiningRoom")
    with pytest.raises(InputError, match="No recipe is called 'front3d_attic'; there are front3d"):
        load_recipe("front3d_attic")
    with pytest.raises(
        InputError,
        match=r"front3d_bedroom\.yaml: unknown key 'max_flor_m'; the nearest valid key is 'max_fl",
    ):
        load_recipe("front3d_bedroom", ("max_flor_m=3",))
    with pytest.raises(InputError, match="'max_floor_m' is not a rule"):
        load_recipe("front3d_bedroom", ("max_floor_m",))


def test_required_classes_are_switched_off_by_null_as_by_an_empty_list():
    for value in ("null", "[]"):
        recipe = load_recipe("front3d_bedroom", (f"required_classes={value}",))
        assert recipe.required_classes == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("max_floor_m=[", "The value of 'max_floor_m=.' is no YAML"),
        (
            "max_floor_m=wide",
            r"front3d_bedroom\.yaml: 'max_floor_m': input should be a valid number .got 'wide'",
        ),
        ("max_floor_m=.nan", "'max_floor_m': input should be a finite number .got nan"),
        ("min_objects=2.5", "'min_objects': input should be a valid integer .got 2.5"),
        ("min_objects=true", "'min_objects': input should be a valid integer .got True"),
        ("allow_mirrored=1", "'allow_mirrored': input should be a valid boolean .got 1"),
        ("scale_range=[1]", r"'scale_range\.1' is missing"),
        ("room_types=bedroom", "'room_types': input should be a valid tuple .got 'bedroom'"),
        (
            "required_classes=[bed]",
            "the label set front3d_bedroom has no class 'bed'; it has void,",
        ),
        ("class_columns=[x]", r"front3d_categories\.csv has no column 'x'"),
        ("views.tries=0", r"'views\.tries': input should be greater than 0 .got 0"),
        (
            "views.image_size=[0, 0]",
            r"'views\.image_size\.0': .* greater than or equal to 8 .got 0",
        ),
        (
            "views.fov_deg=180",
            r"'views\.fov_deg': .* less than or equal to 170 .got 180",
        ),
        ("views.per_m2=[1]", r"'views\.per_m2': input should be a valid number .got \[1\]"),
    ],
)
def test_values_that_a_rule_does_not_take(change, said):
    with pytest.raises(InputError, match=said):
        load_recipe("front3d_bedroom", (change,))


TYPES = {
    "bedroom": ["Bedroom", "MasterBedroom", "SecondBedroom"],
    "living": ["LivingRoom", "LivingDiningRoom"],
    "dining": ["DiningRoom", "LivingDiningRoom"],
    "library": ["Library"],
}
ALL_TYPES = [
    *sorted({kind for kinds in TYPES.values() for kind in kinds}),
    "Kitchen", "Bathroom", "KidsRoom", "ElderlyRoom", "OtherRoom", "none", "",
]  # fmt: skip


@pytest.mark.parametrize("name", [*TYPES, "all"])
def test_every_room_type_has_a_recipe_and_a_label_set(name):
    recipe = load_recipe(f"front3d_{name}")
    assert recipe.label_set == f"front3d_{name}"
    wanted = TYPES.get(name, ALL_TYPES)
    assert [kind for kind in ALL_TYPES if recipe.of_type(kind)] == sorted(
        wanted, key=ALL_TYPES.index
    )
    assert set(recipe.classes.values()) == set(label_set(recipe.label_set))
    # Any rule can be switched off.
    off = [f"{rule}=null" for rule in ("min_objects", "max_objects", "max_floor_m", "max_height_m")]
    recipe = load_recipe(f"front3d_{name}", (*off, "required_classes=[]", "scale_range=null"))
    assert (
        recipe.min_objects is recipe.max_objects is recipe.max_floor_m is recipe.scale_range is None
    )


def test_all_rooms_have_the_classes_of_both_lists():
    classes = load_recipe("front3d_all").classes
    assert classes["king-size bed"] == "double_bed" and classes["nightstand"] == "nightstand"
    assert classes["barstool"] == "stool"  # void in bedrooms
    assert classes["children cabinet"] == "children_cabinet"  # a cabinet in living rooms
    assert classes["wine cooler"] == "void"


def test_categories_with_slashes():
    assert category_classes(("bedroom_class",))["corner/side table"] == "table"
