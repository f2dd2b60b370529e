"""Reads COCO's panoptic format: PNGs whose colours are segment ids, and one JSON for all of them.

Ids must be tracked: the same id is the same object in all frames, as video segmenters write them.
Those of COCO's own single images are not.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_prep.posed.recording import checked
from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.files import read_json
from sceneprior.instances.pngs import read_rgb
from sceneprior.instances.tables import LARGEST_ID, tidy

FILE_NAME = "panoptic.json"
_CROWD = "crowd"
"""Class of segments that are no single object."""
_STUFF = "background"

_Id = Annotated[int, Field(ge=0, lt=2**24)]


class _Category(BaseModel):
    model_config = ConfigDict(strict=True)

    id: int
    name: str
    isthing: int = 1


class _Segment(BaseModel):
    model_config = ConfigDict(strict=True)

    id: _Id
    category_id: int
    iscrowd: int = 0


class _Annotation(BaseModel):
    model_config = ConfigDict(strict=True)

    file_name: str = ""
    segments_info: list[_Segment]


class _Panoptic(BaseModel):
    model_config = ConfigDict(strict=True)

    categories: list[_Category]
    annotations: list[_Annotation]


@dataclass(frozen=True)
class PanopticIds:
    """The segments of a room's frames, numbered anew."""

    segments: np.ndarray
    """(n,) their ids, ascending."""
    classes: dict[int, str]
    """k + 1 of the k-th -> its class; "background" for stuff, such as walls and floors."""

    def read(self, path: Path) -> np.ndarray:
        """(height, width) int32 of a PNG: k + 1 of the k-th segment, 0 for nothing, n + 1 for ids
        that the JSON does not have. An `InputError` where it is no RGB PNG."""
        red, green, blue = np.moveaxis(read_rgb(path).astype(np.int64), 2, 0)
        ids = red + 256 * green + 65536 * blue
        place = np.searchsorted(self.segments, ids)
        there = self.segments[np.minimum(place, len(self.segments) - 1)] == ids
        numbers = np.where(there, place + 1, len(self.segments) + 1)
        return np.where(ids == 0, 0, numbers).astype(np.int32)


def read_panoptic(path: Path, label_set_name: str) -> PanopticIds:
    """Read a room's JSON of panoptic annotations. Stuff is nothing unless the label set has it.

    Raises:
        InputError: the file is damaged, or its ids are not tracked over frames.
    """
    data = read_json(path)
    room = checked(_Panoptic, data if isinstance(data, dict) else {}, str(path))
    names = {
        item.id: item.name
        if item.isthing or tidy(item.name) in map(tidy, label_set(label_set_name))
        else _STUFF
        for item in room.categories
    }
    of_id: dict[int, tuple[str, str]] = {}
    for frame in room.annotations:
        for segment in frame.segments_info:
            if segment.category_id not in names:
                raise InputError(
                    f"{path}, '{frame.file_name}': category {segment.category_id} of segment "
                    f"{segment.id} is not among its categories."
                )
            name = _CROWD if segment.iscrowd else names[segment.category_id]
            before, where = of_id.setdefault(segment.id, (name, frame.file_name))
            if before != name:
                raise InputError(
                    f"{path}: segment {segment.id} is {before} in '{where}', but {name} in "
                    f"'{frame.file_name}'. Ids must be tracked: the same object has the same id "
                    "in all frames, as video segmenters write them."
                )
    of_id.pop(0, None)
    if not of_id or len(of_id) >= LARGEST_ID:
        raise InputError(f"{path} has {len(of_id)} segments; expected 1 to {LARGEST_ID - 1}.")
    segments = sorted(of_id)
    classes = {k + 1: of_id[segment][0] for k, segment in enumerate(segments)}
    return PanopticIds(np.array(segments), classes)
