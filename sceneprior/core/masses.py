"""Masses of furniture, for simulators."""

from sceneprior.core.scene import SceneObject

DENSITY_KG_M3 = {
    "armchair": 55, "bar": 70, "bathtub": 90, "bed": 25, "bookshelf": 75, "cabinet": 120,
    "ceiling_lamp": 40, "chair": 25, "children_cabinet": 110, "coffee_table": 45, "counter": 120,
    "desk": 55, "double_bed": 25, "dresser": 130, "dressing_chair": 30, "dressing_table": 65,
    "kids_bed": 25, "lamp": 25, "night stand": 140, "nightstand": 140, "pendant_lamp": 25,
    "refridgerator": 110, "shelf": 75, "shelves": 75, "single_bed": 25, "sink": 90, "sofa": 40,
    "stool": 45, "table": 40, "television": 120, "toilet": 130, "tv_stand": 85, "wardrobe": 70,
    "whiteboard": 150,
}  # fmt: skip
"""Mass per volume of the bounding box, by class. Estimates, accurate to a factor of about two: the
mass of one common piece of the class over its outer volume (a chair of 5 kg in 0.5 x 0.9 x 0.45 m,
a wardrobe of 80 kg in 1 x 2 x 0.58 m, a double bed with mattress of 90 kg in 1.7 x 1 x 2.1 m)."""
OTHER_KG_M3 = 60
"""Density of classes that are not in the table."""


def mass_kg(item: SceneObject) -> float:
    """Mass of an object, from its class and the volume of its box.

    >>> mass_kg(SceneObject("double_bed", (0.0, 0.5, 0.0), (1.7, 1.0, 2.1)))
    89.25
    """
    width, height, depth = item.size_m
    return round(DENSITY_KG_M3.get(item.label, OTHER_KG_M3) * width * height * depth, 3)
