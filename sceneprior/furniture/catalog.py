"""Makes the furniture catalogue: a dozen models per class, with realistic sizes."""

import csv
import re
import uuid
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.resources import files
from statistics import NormalDist
from zlib import crc32

import numpy as np
import trimesh

from sceneprior.core.classes import label_set
from sceneprior.furniture.solids import Parts, Vector, fit_to
from sceneprior.furniture.tables import DEEP_SOFA_M, DINING_WIDTH_M, build

VARIANTS = 12
"""Models per class in one data set; the demo promises at least five."""

STYLES = ("Modern", "Japanese", "Vintage/Retro")
"""Styles that the models of a class take in turn."""

HEIGHT_CORRELATION = {"stool": 0.4, "table": 0.75, "ceiling_lamp": 0.2}
"""Correlation of height (and of depth, unless listed below) with width, where it is not 0.3."""

DEPTH_CORRELATION = {
    "table": 0.9, "stool": 0.8, "ceiling_lamp": 0.97, "sofa": 0.75, "armchair": 0.8, "chair": 0.7,
    "dressing_chair": 0.8, "pendant_lamp": 0.6, "double_bed": 0.98, "single_bed": 0.98,
}  # fmt: skip
"""Correlation of depth with width."""

Percentiles = tuple[tuple[float, ...], ...]
"""The 10th, 50th and 90th percentiles of width, of height and of depth, in metres."""

# Half of 3D-FUTURE's 41 dressing chairs are wider than 2.29 m, so they are presumably sets of
# table, mirror and seat (not checked). We want only the seat, whose size is near their 10th
# percentile.
SIZES_OF_OURS: dict[str, Percentiles] = {
    "dressing_chair": ((0.50, 0.53, 0.62), (0.53, 0.68, 0.85), (0.50, 0.575, 0.64))
}

_SYNONYMS = {
    "bedside_table": "nightstand", "night_stand": "nightstand", "bookcase": "bookshelf",
    "shelves": "shelf", "couch": "sofa", "fridge": "refrigerator", "refridgerator": "refrigerator",
}  # fmt: skip
_GENERAL = ("bed", "chair", "desk", "sofa", "table")
"""Classes whose names, at the end of a longer name, stand for the object itself."""

_LOUNGE_CHAIR = "Lounge Chair / Cafe Chair / Office Chair"

# Super-category, then the categories that models take in turn, in 3D-FUTURE's spelling.
_CATEGORIES = {
    "armchair": ("Sofa", "armchair"),
    "bookshelf": ("Cabinet/Shelf/Desk", "Bookcase / jewelry Armoire"),
    "cabinet": (
        "Cabinet/Shelf/Desk",
        "Sideboard / Side Cabinet / Console Table",
        "Drawer Chest / Corner cabinet",
    ),
    "ceiling_lamp": ("Lighting", "Ceiling Lamp"),
    "chair": ("Chair", *3 * ("Dining Chair",), _LOUNGE_CHAIR, "Dining Chair", _LOUNGE_CHAIR),
    "children_cabinet": ("Cabinet/Shelf/Desk", "Children Cabinet"),
    "coffee_table": ("Table", "Coffee Table", "Tea Table"),
    "desk": ("Cabinet/Shelf/Desk", "Desk"),
    "double_bed": ("Bed", "King-size Bed", "Double Bed"),
    "dressing_chair": ("Chair", "Dressing Chair"),
    "dressing_table": ("Table", "Dressing Table"),
    "kids_bed": ("Bed", "Kids Bed"),
    "nightstand": ("Cabinet/Shelf/Desk", "Nightstand"),
    "pendant_lamp": ("Lighting", "Pendant Lamp"),
    "shelf": ("Cabinet/Shelf/Desk", "Shelf"),
    "single_bed": ("Bed", "Single bed"),
    "stool": ("Pier/Stool", "Footstool / Sofastool / Bed End Stool / Stool"),
    "tv_stand": ("Cabinet/Shelf/Desk", "TV Stand"),
    "wardrobe": ("Cabinet/Shelf/Desk", "Wardrobe"),
}


@dataclass(frozen=True)
class Model:
    """One product: its entry in `model_info.json`, its size, and the seed it is built from."""

    jid: str
    name: str
    """Class in the label sets."""
    super_category: str
    category: str
    style_name: str
    size_m: Vector
    """Width, height and depth: full extents along x, y, z."""
    style: int
    seed: tuple[int, ...]

    @cached_property
    def parts(self) -> Parts:
        """Closed solids whose bounding box is `size_m`, centred, bottom at y = 0."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed))
        return fit_to(build(self.name, self.size_m, self.style, rng), self.size_m)

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """All parts as one mesh."""
        arrays = [part.vertices for part in self.parts], [part.faces for part in self.parts]
        return trimesh.Trimesh(*trimesh.util.append_faces(*arrays), process=False)


Catalog = dict[str, list[Model]]
"""Models of each class."""


@lru_cache(maxsize=4)  # meshes are built once per process
def make_catalog(seed: int, label_set_name: str) -> Catalog:
    """Make `VARIANTS` models of every class but void, the same in all label sets."""
    return {name: make_variants(seed, name) for name in label_set(label_set_name)[1:]}


def furniture_classes() -> frozenset[str]:
    """Classes for which `make_variants` makes models."""
    return frozenset(_CATEGORIES) | {"sofa", "table"}


def make_variants(seed: int, name: str) -> list[Model]:
    """Make `VARIANTS` models of a class, in sizes of real furniture (`real_sizes`)."""
    own = (seed, crc32(name.encode()))
    rng = np.random.default_rng(np.random.SeedSequence(own))
    models = []
    for index, size in enumerate(_sizes(name, rng)):
        jid = str(uuid.uuid5(uuid.NAMESPACE_OID, f"sceneprior homes {seed} {name} {index}"))
        style_name = STYLES[index % len(STYLES)]
        kinds = _category(name, size, index)
        models.append(Model(jid, name, *kinds, style_name, size, index, (*own, index)))
    return models


def _category(name: str, size_m: Vector, index: int) -> tuple[str, str]:
    """3D-FUTURE's super-category and category for a model of this class and size."""
    width, _, depth = size_m
    if name == "sofa":
        short = "Loveseat Sofa" if width < 1.9 else "Three-Seat / Multi-seat Sofa"
        return "Sofa", "L-shaped Sofa" if depth > DEEP_SOFA_M else short
    if name == "table":
        small = "Corner/Side Table" if index % 5 else "Round End Table"
        return "Table", "Dining Table" if width >= DINING_WIDTH_M else small
    super_category, *categories = _CATEGORIES[name]
    return super_category, categories[index % len(categories)]


def _sizes(name: str, rng: np.random.Generator) -> list[Vector]:
    """Sample sizes whose three marginals match the real 10th, 50th and 90th percentiles.

    Width, height and depth are correlated normal scores. Their ranks are mapped to evenly spaced
    quantiles, so that a dozen models cover the range as well as a thousand would.
    """
    high_with = HEIGHT_CORRELATION.get(name, 0.3)
    deep_with = DEPTH_CORRELATION.get(name, high_with)
    even = [NormalDist().inv_cdf((k + 0.5) / VARIANTS) for k in range(VARIANTS)]
    wide = rng.permutation(even)
    high = high_with * wide + np.sqrt(1 - high_with**2) * rng.normal(size=VARIANTS)
    deep = deep_with * wide + np.sqrt(1 - deep_with**2) * rng.normal(size=VARIANTS)
    sides = []
    for (p10, p50, p90), scores in zip(real_sizes()[name], (wide, high, deep), strict=True):
        ranked = [even[rank] for rank in np.argsort(np.argsort(scores))]
        # Two half log-normals, joined at the median; no size is far beyond the percentiles.
        growth = [((p10 if score < 0 else p90) / p50, min(abs(score), 1.7)) for score in ranked]
        sides.append([round(p50 * ratio ** (score / 1.2816), 4) for ratio, score in growth])
    return list(zip(*sides, strict=True))


def real_size(name: str) -> Percentiles | None:
    """Percentiles of the sizes of a class, by any of its usual names; None if they are unknown."""
    whole = "_".join(re.findall("[a-z]+", name.lower()))
    last = whole.rpartition("_")[2]
    sizes = real_sizes()
    return sizes.get(_SYNONYMS.get(whole, whole)) or (sizes[last] if last in _GENERAL else None)


@lru_cache(maxsize=1)
def real_sizes() -> dict[str, Percentiles]:
    """Percentiles of the sizes of every class; those of 0 models are usual sizes of products."""
    text = files("sceneprior.furniture").joinpath("furniture_sizes.csv").read_text()
    sizes: dict[str, Percentiles] = {}
    for row in csv.DictReader(text.splitlines()):
        sizes[row["class"]] = tuple(
            tuple(float(row[f"{side}_{p}"]) for p in ("p10", "p50", "p90"))
            for side in ("width", "height", "depth")
        )
    return sizes | SIZES_OF_OURS
