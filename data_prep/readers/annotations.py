"""Annotations that several data sets have: tables as text, arrays in HDF5, and NYU40 classes by id,
by ScanNet's raw categories and by free-text label."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprior.core.checked import plain
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import open_hdf5, read_table, reading
from sceneprior.core.id_tables import LARGEST_ID, stuff_of

_MOST_VALUES = 64 << 20
"""Maximum number of values in an array; images and trajectories have far fewer."""
LABEL_SET = "scannet"
TABLE = "scannetv2-labels.combined.tsv"
SHELL = frozenset(
    ["wall", "floor", "ceiling", "door", "window", "blinds", "floor mat", "mirror", "picture"]
)
"""NYU40 classes of the room itself. They have id 0 in the images, because they surround all
furniture and rarely occlude it."""
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


def read_records(path: Path, hint: str) -> list[dict[str, str]]:
    """Rows of a comma separated table by the names in its header; short rows lack their ends."""
    header, *rows = read_table(path, hint) or [[]]
    return [dict(zip(header, row, strict=False)) for row in rows if row]


def read_hdf5(path: Path, names: Sequence[str], hint: str) -> list[np.ndarray]:
    """Read the arrays with these names; `hint` ends the message if one is missing or unusable."""
    import h5py  # here, because most data sets do not need it

    if not path.is_file():
        raise InputError(f"{path} is missing; {hint}.")
    with reading(path, then=f": it is damaged; {hint}."), open_hdf5(path) as file:
        missing = [name for name in names if not isinstance(file.get(name), h5py.Dataset)]
        if missing:
            there = ", ".join(plain(str(name)) for name in list(file)[:8]) or "nothing"
            raise InputError(f"{path} has no '{missing[0]}' (it has {there}); {hint}.")
        for name in names:
            if file[name].size is None or file[name].size > _MOST_VALUES:
                raise InputError(f"{path}: '{name}' has {file[name].size} values; {hint}.")
        return [np.asarray(file[name][()]) for name in names]


def download(path: Path) -> str:
    """Advice about a scan's file that is missing or cannot be read."""
    return f"download it into the scan's folder, or leave {path.parent.name} out of the scans"


@dataclass(frozen=True)
class Labels:
    """Classes of the annotators' raw categories."""

    nyu40: dict[str, str]
    """NYU40 class by raw category, both in lower case."""
    source: str

    def nyu40_class(self, category: str) -> str | None:
        """NYU40 class of a raw category; None if the table does not list it."""
        return self.nyu40.get(_lower(category))

    def label(self, category: str) -> str:
        """Class in the label set `scannet`; `void` for anything outside its 19 classes."""
        name = self.nyu40_class(category) or ""
        return name if name in label_set(LABEL_SET) else "void"

    def is_shell(self, category: str) -> bool:
        """Test whether this is a part of the room, such as a wall, rather than furniture."""
        return self.nyu40_class(category) in SHELL

    def stuff(self, category: str) -> int:
        """Index into `STUFF`; 0 for furniture, and for parts of the room without such a class."""
        return stuff_of(self.nyu40_class(category) or "")


def read_labels(path: Path) -> Labels:
    """Read `scannetv2-labels.combined.tsv`; of a repeated category, the last row wins."""
    # Some categories contain a literal quotation mark (inches).
    dialect = {"delimiter": "\t", "quoting": csv.QUOTE_NONE}
    rows = read_table(Path(path), f"--labels names ScanNet's {TABLE}", **dialect)
    columns = [name.strip().lower() for name in rows[0]] if rows else []
    if "raw_category" not in columns and {"category", "nyu40class"} <= set(columns):
        raise InputError(
            f"{path} is the label table of ScanNet's first release; give the second one's, "
            f"{TABLE}, with --labels: it works for scans of either."
        )
    if "raw_category" not in columns or "nyu40class" not in columns:
        raise InputError(
            f"{path} has no columns raw_category and nyu40class (it begins with "
            f"{', '.join(columns[:4]) or 'nothing'}); --labels names ScanNet's "
            f"{TABLE}, which is tab separated."
        )
    raw, nyu = columns.index("raw_category"), columns.index("nyu40class")
    meanings = {_lower(row[raw]): _lower(row[nyu]) for row in rows[1:] if len(row) > max(raw, nyu)}
    if not meanings:
        raise InputError(f"{path} lists no categories; download the label table again.")
    return Labels(meanings, Path(path).name)


def _lower(text: str) -> str:
    return text.strip().lower()


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
    best = (2 * votes - np.eye(1, len(names), dtype=int)).argmax(axis=1)  # void loses ties
    ids = np.where(is_shell[best], 0, np.arange(count)).astype(np.int32)[numbers]
    ids[numbers == 0] = np.where(is_shell[semantics[numbers == 0]], 0, -1)
    found = np.flatnonzero(votes.any(axis=1) & ~is_shell[best]).tolist()
    stuff = np.array([stuff_of(name) for name in names], dtype=np.uint8)
    return ids, {k: names[best[k]] for k in found if k}, stuff[semantics]
