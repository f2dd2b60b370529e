"""NYU40 classes by id, for data sets with images of NYU40 ids, and by free-text label."""

import numpy as np

from data_prep.readers.scannet.labels import SHELL
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import LARGEST_ID, stuff_of

NYU40 = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf",
    "picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser", "pillow", "mirror",
    "floor mat", "clothes", "ceiling", "books", "refridgerator", "television", "paper", "towel",
    "shower curtain", "box", "whiteboard", "person", "night stand", "toilet", "sink", "lamp",
    "bathtub", "bag", "otherstructure", "otherfurniture", "otherprop",
)  # fmt: skip
"""Names of the ids 1 to 40, in the spelling of ScanNet's nyu40class and of its label set."""

LIKE_NYU40 = {
    "wall": "wall", "floor": "floor", "ceiling": "ceiling", "door": "door", "door frame": "door",
    "doorframe": "door", "window": "window", "window frame": "window", "windowsill": "window",
    "window sill": "window", "blinds": "blinds", "mirror": "mirror", "picture": "picture",
    "painting": "picture", "poster": "picture", "carpet": "floor mat", "rug": "floor mat",
    "office chair": "chair", "armchair": "chair", "dining chair": "chair", "stool": "chair",
    "couch": "sofa", "storage cabinet": "cabinet", "kitchen cabinet": "cabinet",
    "cupboard": "cabinet", "wardrobe": "cabinet", "file cabinet": "cabinet",
    "bathroom cabinet": "cabinet", "bookcase": "bookshelf", "book shelf": "bookshelf",
    "shelf": "shelves", "wall shelf": "shelves", "kitchen counter": "counter",
    "office desk": "desk", "coffee table": "table", "dining table": "table",
    "side table": "table", "bedside table": "night stand", "nightstand": "night stand",
    "chest of drawers": "dresser", "ceiling lamp": "lamp", "table lamp": "lamp",
    "floor lamp": "lamp", "desk lamp": "lamp", "tv": "television", "tv screen": "television",
    "refrigerator": "refridgerator", "fridge": "refridgerator", "bath tub": "bathtub",
    "blackboard": "whiteboard", "washbasin": "sink",
}  # fmt: skip
"""NYU40 class of common free-text labels, such as those of ScanNet++."""


def ids_and_classes(
    instances: np.ndarray, semantics: np.ndarray, where: str
) -> tuple[np.ndarray, dict[int, str], np.ndarray]:
    """Combine images of instance ids (-1 = none) with images of NYU40 ids (0 or less = none).

    An instance has the class of most of its pixels, over all images. A pixel without an instance is
    background if its class is a part of the room, and unknown otherwise. Instances that are parts
    of the room are also background.

    Returns:
        Images of numbers, int32 of the same shape: instance + 1, 0 for background, -1 for unknown;
        the class of each number; and images of indices into `STUFF`, uint8.

    Example: instance 7 is a chair (5) with one pixel of a table; a wall (1), a lamp without an id.

        >>> instances, semantics = np.array([[7, 7, 7, -1, -1]]), np.array([[5, 5, 7, 1, 35]])
        >>> ids, classes, stuff = ids_and_classes(instances, semantics, "scene")
        >>> ids.tolist(), classes, stuff.tolist()
        ([[8, 8, 8, 0, -1]], {8: 'chair'}, [[0, 0, 0, 2, 0]])
    """
    if semantics.max(initial=0) > len(NYU40):
        raise InputError(
            f"{where}: a semantic id is {semantics.max()}, expected NYU40's 1 to {len(NYU40)}; "
            "it is another label set, or the file is damaged."
        )
    if instances.max(initial=0) >= LARGEST_ID:
        raise InputError(
            f"{where}: an instance id is {instances.max()}, expected at most {LARGEST_ID - 1}; the "
            "file is damaged."
        )
    names = ("void", *NYU40)
    is_shell = np.array([name in SHELL for name in names])
    numbers = np.maximum(instances, -1).astype(np.int64) + 1
    semantics = np.maximum(semantics, 0).astype(np.int64)
    count = int(numbers.max(initial=0)) + 1
    keys = (numbers * len(names) + semantics).ravel()
    votes = np.bincount(keys, minlength=count * len(names)).reshape(count, len(names))
    best = votes.argmax(axis=1)
    ids = np.where(is_shell[best], 0, np.arange(count)).astype(np.int32)[numbers]
    ids[numbers == 0] = np.where(is_shell[semantics[numbers == 0]], 0, -1)
    found = np.flatnonzero(votes.any(axis=1) & ~is_shell[best]).tolist()
    stuff = np.array([stuff_of(name) for name in names], dtype=np.uint8)
    return ids, {k: names[best[k]] for k in found if k}, stuff[semantics]
