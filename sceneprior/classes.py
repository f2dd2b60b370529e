"""Label sets: the class names a prior distinguishes, in the paper's order, and their colours."""

import colorsys

import numpy as np

from sceneprior.errors import InputError

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
"""Supplement A of the paper; `refridgerator` is spelt as ScanNet spells it."""

VOID = 0
"""Index of `void` in every label set: furniture outside the list."""


def label_set(name: str) -> tuple[str, ...]:
    """The class names of a label set, `void` first.

    Raises:
        InputError: no label set has this name.
    """
    if name not in LABEL_SETS:
        raise InputError(f"No label set is called '{name}'; there are {', '.join(LABEL_SETS)}.")
    return LABEL_SETS[name]


def class_colors(count: int) -> np.ndarray:
    """One flat RGB colour per class, (count, 3) uint8, the same in every process.

    Hues advance by the golden ratio, so that neighbours in the list differ most; lightness
    takes turns, so that classes differ in a grey print too. Void is grey; black and white
    stay free for backgrounds.
    """
    colors = np.empty((count, 3), dtype=np.uint8)
    for index in range(count):
        hue = (index * 0.6180339887498949) % 1.0
        lightness = (0.42, 0.56, 0.70)[index % 3]
        rgb = colorsys.hls_to_rgb(hue, lightness, 0.72)
        colors[index] = [round(255 * channel) for channel in rgb]
    if count:
        colors[VOID] = (128, 128, 128)
    return colors
