"""Reads the objects of one image from COCO's JSON: polygons and run-length encoded masks."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from sceneprior.core.checked import checked, number_array, shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.id_tables import LARGEST_ID

CROWD = "crowd"
"""Class of regions that are not a single object (`iscrowd`)."""
LARGEST_PIXELS = 64 << 20
"""Maximum number of pixels of an image, because the masks of a larger one would take gigabytes.
Photographs have at most about half as many."""
_PIXELS_AT_ONCE = 1 << 20
_LONGEST_RUN_BITS = 40

Side = Annotated[int, Field(ge=1)]
"""Height or width of an image in pixels."""
CocoId = int | str
"""Id of an image, annotation, category or track; COCO has numbers, other tools also text."""


class _Image(BaseModel):
    height: Side
    width: Side


class Category(BaseModel):
    """An entry of `categories` in a COCO JSON: the id and the name of a class."""

    id: CocoId
    name: str


class _Annotation(BaseModel):
    id: Any = None
    category_id: CocoId
    segmentation: Any
    iscrowd: bool = False


class _Coco(BaseModel):
    images: list[_Image]
    annotations: list[_Annotation]
    categories: list[Category]


def read_coco(path: Path) -> tuple[np.ndarray, dict[int, str]]:
    """Read the instance ids and their class names from a COCO JSON of a single image.

    Objects may overlap (`paint`).

    Returns:
        (height, width) uint16, k + 1 for the k-th annotation, 0 for background; and class names by
        id.
    """
    data = read_coco_json(path)
    coco = checked(_Coco, data, f"{path} is not a COCO JSON of masks")
    if len(coco.images) != 1:
        raise InputError(
            f"{path} describes {len(coco.images)} images; keep one, and its annotations."
        )
    found = coco.annotations
    if not 0 < len(found) < LARGEST_ID:
        raise InputError(f"{path} has {len(found)} annotations; expected 1 to {LARGEST_ID - 1}.")
    size = coco.images[0].height, coco.images[0].width
    check_size(size, str(path))
    check_ids(path, "category", [(row.id, row.name) for row in coco.categories])
    names = {row.id: row.name for row in coco.categories}
    classes, masks = {}, []
    for row, annotation in enumerate(found):
        where = f"{path}, annotation {row if annotation.id is None else shown(annotation.id)}"
        if annotation.category_id not in names:
            raise InputError(
                f"{where}: category {shown(annotation.category_id)} is not among its categories."
            )
        classes[row + 1] = CROWD if annotation.iscrowd else names[annotation.category_id]
        masks.append((row + 1, annotation.segmentation, where))
    ids = paint(((k, decode(mask, size, where)) for k, mask, where in masks), size)
    return ids.astype(np.uint16), classes


def check_ids(path: Path, kind: str, rows: Iterable[tuple[CocoId, str]]) -> None:
    """Reject an id of two images or two categories, as in joined exports."""
    first: dict[CocoId, str] = {}
    for number, name in rows:
        if (before := first.setdefault(number, name)) != name:
            raise InputError(
                f"{path}: {kind} {shown(number)} is {shown(before)} and {shown(name)}; each needs "
                "an id of its own. If exports were joined, number them anew."
            )


def read_coco_json(path: Path) -> dict[str, Any]:
    """Read a JSON of COCO annotations; its top level must be an object."""
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(
            f"{path} is {'a list of results' if isinstance(data, list) else shown(data)}, not a "
            "COCO JSON of masks; expected an object with `images` (their sizes), `annotations` and "
            "`categories`: put results under `annotations` and add the other two."
        )
    return data


def check_size(size: tuple[int, int], where: str) -> None:
    """Raise an `InputError` for a size, (height, width), whose masks would not fit in memory."""
    if size[0] * size[1] > LARGEST_PIXELS:
        raise InputError(
            f"{where}: its image is said to have {_size(size)} pixels, more than "
            f"{LARGEST_PIXELS / 1e6:.0f} million; write the masks of a smaller image."
        )


def paint(masks: Iterable[tuple[int, np.ndarray]], size: tuple[int, int]) -> np.ndarray:
    """Image of ids, (height, width) int32, of (id, mask) pairs whose masks may overlap.

    The mask with fewer pixels is in front, like a cup on a table; in a tie, the later mask is.
    """
    ids = np.zeros(size, dtype=np.int32)
    pixels_of_front = np.full(size, np.iinfo(np.int32).max, dtype=np.int32)
    for number, mask in masks:
        pixels = np.int32(mask.sum())
        front = mask & (pixels <= pixels_of_front)
        ids[front], pixels_of_front[front] = number, pixels
    return ids


def decode(segmentation: Any, size: tuple[int, int], where: str) -> np.ndarray:
    """Decode polygons or run lengths, compressed or not, to a mask, (height, width) bool."""
    if segmentation is None or segmentation == []:
        raise InputError(
            f"{where}: it has no mask (`segmentation` is empty), as if only boxes were drawn; "
            "objects need masks: let a segmenter such as SAM 2 make them from the boxes, or remove "
            "annotations without a mask."
        )
    try:
        if isinstance(segmentation, list):
            return _inside(segmentation, size)
        said, counts = segmentation["size"], segmentation["counts"]
        if list(said) != list(size):
            told = _size(said) if len(said) == 2 else shown(said)
            raise InputError(
                f"{where}: its mask has {told} pixels, but the image has "
                f"{_size(size)}; write the masks at the image's size."
            )
        counts = _unpacked(counts) if isinstance(counts, str) else [int(each) for each in counts]
        total, area = sum(counts), size[0] * size[1]
        if min(counts, default=-1) < 0 or total != area:
            came = total if abs(total) < 1 << _LONGEST_RUN_BITS else "too many"
            raise ValueError(f"its runs cover {came} pixels, not {area}")
        covered = np.arange(len(counts)) % 2 == 1  # the first run is background
        return np.repeat(covered, counts).reshape(size, order="F")
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{where}: its segmentation has no {error}.") from None
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{where}: its segmentation is neither polygons nor run lengths ({str(error)[:120]})."
        ) from None


def _inside(polygons: list[Any], size: tuple[int, int]) -> np.ndarray:
    """Rasterize polygons [x, y, x, y, ...] to a mask of the pixel centres inside any of them."""
    from matplotlib.path import Path as Outline

    inside = np.zeros(size, dtype=bool)
    for polygon in polygons:
        corners = number_array(polygon)
        if corners.ndim != 1 or len(corners) < 6 or len(corners) % 2:
            raise ValueError("a polygon needs three corners or more, as x, y, x, y, x, y")
        if not np.isfinite(corners).all():
            raise ValueError("a corner is not a finite number")
        corners = corners.reshape(-1, 2)
        ends = np.array(size[::-1])
        left, top = np.clip(np.floor(corners.min(axis=0)), 0, ends).astype(int)
        right, bottom = np.clip(np.ceil(corners.max(axis=0)), 0, ends).astype(int)
        rows = max(1, _PIXELS_AT_ONCE // max(1, right - left))
        for first in range(top, bottom, rows):
            part = inside[first : min(first + rows, bottom), left:right]
            y, x = np.indices(part.shape) + 0.5
            centers = np.stack([x.ravel() + left, y.ravel() + first], axis=1)
            part |= Outline(corners).contains_points(centers).reshape(part.shape)
    return inside


def _unpacked(text: str) -> list[int]:
    """Decode COCO's compressed run lengths.

    A number is written in base 32, lowest digit first; the sixth bit of a character is set if more
    digits follow. From the fourth number on, the difference to the number two before it is stored.
    pycocotools is not used, because it returns uninitialised memory for damaged texts.
    """
    counts: list[int] = []
    value = shift = 0
    for character in text:
        digit = ord(character) - 48
        if not 0 <= digit < 64:
            raise ValueError(f"{character!a} is not a digit of compressed run lengths")
        value |= (digit & 31) << shift
        shift += 5
        if digit & 32:
            if shift > _LONGEST_RUN_BITS:
                raise ValueError("a number of its compressed run lengths is too long")
            continue
        if digit & 16:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("its compressed run lengths end within a number")
    return counts


def _size(size: Any) -> str:
    return " x ".join(shown(side) for side in reversed(list(size)))
