"""Reads the objects of one image from COCO's JSON: polygons and run-length encoded masks."""

from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.errors import InputError
from sceneprior.files import read_json
from sceneprior.instances.tables import LARGEST_ID

CROWD = "crowd"
"""Class of regions that are no single object (`iscrowd`)."""


def read_coco(path: Path) -> tuple[np.ndarray, dict[int, str]]:
    """Instance ids of the one image that a COCO JSON describes, and the class name of each id.

    Where objects overlap, the one of fewer pixels is in front: a cup on a table is annotated so.

    Returns:
        (height, width) uint16, k + 1 for the k-th annotation, 0 for nothing; and names by id.

    Raises:
        InputError: it is no such JSON, describes several images or none, or a mask is damaged or
            not of the image's size.
    """
    try:
        data = read_json(path)
        images, annotations = data["images"], data["annotations"]
        names = {row["id"]: str(row["name"]) for row in data["categories"]}
        sizes = [(int(image["height"]), int(image["width"])) for image in images]
        found = [(row["segmentation"], row["category_id"], row) for row in annotations]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is no COCO JSON of masks ({type(error).__name__}: {error}); expected "
            "`images`, `annotations` with `segmentation`, and `categories`."
        ) from None
    if len(sizes) != 1:
        raise InputError(f"{path} describes {len(sizes)} images; keep one, and its annotations.")
    if not 0 < len(found) < LARGEST_ID:
        raise InputError(f"{path} has {len(found)} annotations; expected 1 to {LARGEST_ID - 1}.")
    (size,) = sizes
    masks, classes = [], {}
    for row, (segmentation, category, annotation) in enumerate(found):
        where = f"{path}, annotation {annotation.get('id', row)}"
        if category not in names:
            raise InputError(f"{where}: category {category} is not among its categories.")
        classes[row + 1] = CROWD if annotation.get("iscrowd") else names[category]
        masks.append(_decoded(segmentation, size, where))
    ids = np.zeros(size, dtype=np.uint16)
    for row in sorted(range(len(masks)), key=lambda row: -int(masks[row].sum())):
        ids[masks[row]] = row + 1
    return ids, classes


def _decoded(segmentation: Any, size: tuple[int, int], where: str) -> np.ndarray:
    """(height, width) bool of polygons, or of run lengths, compressed or not."""
    if isinstance(segmentation, dict):
        said = tuple(segmentation.get("size", ()))
        if said != size:
            raise InputError(
                f"{where}: its mask is of an image of {_size(said)} pixels, but the image has "
                f"{_size(size)}; write the masks at the image's size."
            )
    try:
        if isinstance(segmentation, list):
            return _inside(segmentation, size)
        counts = segmentation["counts"]
        counts = _unpacked(counts) if isinstance(counts, str) else [int(each) for each in counts]
        if min(counts, default=-1) < 0 or sum(counts) != size[0] * size[1]:
            raise ValueError(f"its runs are of {sum(counts)} pixels, not of {size[0] * size[1]}")
        covered = np.arange(len(counts)) % 2 == 1  # the first run is of what is not the object
        return np.repeat(covered, counts).reshape(size, order="F")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{where}: its segmentation is neither polygons nor run lengths ({error})."
        ) from None


def _inside(polygons: list[Any], size: tuple[int, int]) -> np.ndarray:
    """(height, width) bool: pixels whose centre is in one of the polygons, [x, y, x, y, ...]."""
    from matplotlib.path import Path as Outline

    y, x = np.indices(size) + 0.5
    centers = np.stack([x.ravel(), y.ravel()], axis=1)
    inside = np.zeros(len(centers), dtype=bool)
    for polygon in polygons:
        corners = np.array(polygon, dtype=np.float64)
        if corners.ndim != 1 or len(corners) < 6 or len(corners) % 2:
            raise ValueError("a polygon needs three corners or more, as x, y, x, y, x, y")
        if not np.isfinite(corners).all():
            raise ValueError("a corner is not a finite number")
        inside |= Outline(corners.reshape(-1, 2)).contains_points(centers)
    return inside.reshape(size)


def _unpacked(text: str) -> list[int]:
    """Run lengths from COCO's text: base 32, low digits first, a sixth bit where more follow; from
    the fourth on as the difference to the one before the last. The library that packs them,
    pycocotools, answers damaged texts with memory that it never wrote."""
    counts: list[int] = []
    value = shift = 0
    for character in text:
        digit = ord(character) - 48
        if not 0 <= digit < 64:
            raise ValueError(f"'{character}' is no digit of packed runs")
        value |= (digit & 31) << shift
        shift += 5
        if digit & 32:
            continue
        if digit & 16:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("its packed runs end within a number")
    return counts


def _size(size: tuple[int, ...]) -> str:
    return " x ".join(str(side) for side in reversed(size)) or "no size"
