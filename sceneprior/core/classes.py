"""Label sets: lists of class names in the paper's order, and colours of classes."""

import colorsys
from collections.abc import Sequence

import numpy as np

from sceneprior.core.errors import InputError

LABEL_SETS: dict[str, tuple[str, ...]] = {
    "front3d_bedroom": (
        "void", "armchair", "bookshelf", "cabinet", "ceiling_lamp", "chair", "children_cabinet",
        "coffee_table", "desk", "double_bed", "dressing_chair", "dressing_table", "kids_bed",
        "nightstand", "pendant_lamp", "shelf", "single_bed", "sofa", "stool", "table", "tv_stand",
        "wardrobe",
    ),
    "front3d_living": (
        "void", "armchair", "bookshelf", "cabinet", "ceiling_lamp", "chair", "coffee_table",
        "desk", "pendant_lamp", "shelf", "sofa", "stool", "table", "tv_stand", "wardrobe",
    ),
    "scannet": (
        "void", "bathtub", "bed", "bookshelf", "cabinet", "chair", "counter", "desk", "dresser",
        "lamp", "night stand", "refridgerator", "shelves", "sink", "sofa", "table", "television",
        "toilet", "whiteboard",
    ),
}  # fmt: skip
"""Label sets of the paper's supplement A; `refridgerator` is ScanNet's spelling."""
# Room types that are not in the paper. The name of a label set identifies the data of a prior, so
# each room type has its own name, even if its classes are those of another.
LABEL_SETS |= {
    "front3d_dining": LABEL_SETS["front3d_living"],
    "front3d_library": LABEL_SETS["front3d_living"],
    "front3d_kitchen": (
        "void", "bar", "cabinet", "ceiling_lamp", "chair", "pendant_lamp", "shelf", "stool",
        "table",
    ),
    "front3d_all": LABEL_SETS["front3d_bedroom"],  # includes all classes of living rooms
}  # fmt: skip

STUFF = ("unknown", "floor", "wall", "door", "window", "ceiling")
"""Classes of the room itself, by their value in `RoomViews.stuff`."""

VOID = 0
"""Index of `void` in every label set: the class of furniture that belongs to no other class."""

_OWN = "void,"
_LONGEST_NAME = 60


def label_set(name: str) -> tuple[str, ...]:
    """Class names of a label set, `void` first.

    The user's own label set needs no entry in `LABEL_SETS`: its name is the list of its classes, so
    that shards, configs, checkpoints, scene JSONs and workers need only the name.

        >>> label_set("void,bed,night stand")
        ('void', 'bed', 'night stand')
    """
    if name.startswith(_OWN):
        return own_label_set(name.split(",")[1:])
    if name not in LABEL_SETS:
        raise InputError(
            f"No label set is called '{name}'; there are {', '.join(LABEL_SETS)}, "
            "or write your own as void,bed,chair."
        )
    return LABEL_SETS[name]


def own_label_set(names: Sequence[str]) -> tuple[str, ...]:
    """Check a user's list of class names, given without `void`, and prepend `void`."""
    classes = ("void", *names)
    for name in classes:
        if name != name.strip() or not 0 < len(name) <= _LONGEST_NAME or not name.isprintable():
            raise InputError(
                f"'{name[:_LONGEST_NAME]}' is not a class name; expected 1 to {_LONGEST_NAME} "
                "printable characters, without a space at either end."
            )
        if "," in name:
            raise InputError(f"The class name '{name}' has a comma, which separates class names.")
        if classes.count(name) > 1:
            raise InputError(f"The class '{name}' is in the label set twice; list it once.")
    if len(classes) < 2:
        raise InputError("A label set needs at least one class in addition to void.")
    return classes


def label_set_name(names: Sequence[str]) -> str:
    """Name of a user's label set: the list itself, checked by `own_label_set`."""
    return ",".join(own_label_set(names))


def class_colors(count: int) -> np.ndarray:
    """One RGB colour per class, (count, 3) uint8, deterministic.

    Hues advance by the golden ratio, so that neighbours in the list differ clearly; lightness
    cycles through three values, so that classes differ in greyscale prints, too. Void is grey.
    Black and white are never used, because backgrounds have them.
    """
    colors = np.full((count, 3), 128, dtype=np.uint8)
    for index in range(VOID + 1, count):
        hue = (index * 0.6180339887498949) % 1.0
        rgb = colorsys.hls_to_rgb(hue, (0.42, 0.56, 0.70)[index % 3], 0.72)
        colors[index] = [round(255 * channel) for channel in rgb]
    return colors


class UnknownClassError(InputError):
    """A requested or given class that a prior does not draw.

    Args:
        label: The class.
        known: The classes that the prior draws.
    """

    def __init__(self, label: str, known: Sequence[str]):
        super().__init__(f"'{label}' is not a class of this prior; it draws {', '.join(known)}.")
        self.label, self.known = label, known
