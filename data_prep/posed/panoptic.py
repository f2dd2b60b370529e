"""Reads COCO's panoptic format: PNGs whose colours encode segment ids, and one JSON for all PNGs.

Ids must be tracked: an object has the same id in all frames, as in the output of video segmenters.
The ids of COCO's own single images are not tracked.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.instances.checked import checked
from sceneprior.core.instances.pngs import read_rgb
from sceneprior.core.instances.tables import LARGEST_ID, stuff_of, tidy

FILE_NAME = "panoptic.json"
_CROWD = "crowd"
"""Class of segments that are not a single object."""
_BACKGROUND = "background"

_Id = Annotated[int, Field(ge=0, lt=2**24)]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True)


class _Category(_Strict):
    id: int
    name: str
    isthing: int = 1


class _Segment(_Strict):
    id: _Id
    category_id: int
    iscrowd: int = 0


class _Annotation(_Strict):
    file_name: str = ""
    segments_info: list[_Segment]


class _Panoptic(_Strict):
    categories: list[_Category]
    annotations: list[_Annotation]


@dataclass(frozen=True)
class PanopticIds:
    """Segments of a room, renumbered to consecutive ids."""

    segments: np.ndarray
    """(n,) segment ids, ascending."""
    classes: dict[int, str]
    """Class by new id: k + 1 for the k-th segment; stuff is of a class of `STUFF`, or
    "background"."""
    of_frame: dict[str, dict[int, str]]
    """The same for the segments of each frame alone, by the stem of its PNG."""

    def read(self, path: Path) -> np.ndarray:
        """Read a PNG as new ids, (height, width) int32.

        0 is background, k + 1 the k-th segment, n + 1 any id that is missing from the JSON.
        """
        red, green, blue = np.moveaxis(read_rgb(path).astype(np.int64), 2, 0)
        ids = red + 256 * green + 65536 * blue
        place = np.searchsorted(self.segments, ids)
        there = self.segments[np.minimum(place, len(self.segments) - 1)] == ids
        numbers = np.where(there, place + 1, len(self.segments) + 1)
        return np.where(ids == 0, 0, numbers).astype(np.int32)


def read_panoptic(path: Path, label_set_name: str, tracked: bool = True) -> PanopticIds:
    """Read a room's annotations. Stuff is no object, unless the label set has its class.

    Segments that are not `tracked` may have another class in each frame. A tracked segment of stuff
    with several classes is background.
    """
    room = checked(_Panoptic, read_json(path), str(path))
    own = {tidy(name) for name in label_set(label_set_name)}
    names, stuff = {}, {_BACKGROUND, *STUFF[1:]}
    for item in room.categories:
        if item.isthing or tidy(item.name) in own:
            names[item.id] = item.name
        else:
            name = STUFF[stuff_of(item.name)]
            names[item.id] = name if name in stuff - own else _BACKGROUND
    of_id: dict[int, tuple[str, str]] = {}
    by_frame: dict[str, dict[int, str]] = {}
    for frame in room.annotations:
        for segment in frame.segments_info:
            if segment.category_id not in names:
                raise InputError(
                    f"{path}, '{frame.file_name}': category {segment.category_id} of segment "
                    f"{segment.id} is not among its categories."
                )
            name = _CROWD if segment.iscrowd else names[segment.category_id]
            by_frame.setdefault(Path(frame.file_name).stem, {})[segment.id] = name
            before, where = of_id.setdefault(segment.id, (name, frame.file_name))
            if before != name and {before, name} <= stuff:
                of_id[segment.id] = _BACKGROUND, where
            elif tracked and before != name:
                raise InputError(
                    f"{path}: segment {segment.id} is {before} in '{where}', but {name} in "
                    f"'{frame.file_name}'. Ids must be tracked: the same object has the same id "
                    "in all frames, as video segmenters write them; else pass --tracks auto."
                )
    of_id.pop(0, None)
    if not of_id or len(of_id) >= LARGEST_ID:
        raise InputError(f"{path} has {len(of_id)} segments; expected 1 to {LARGEST_ID - 1}.")
    segments = sorted(of_id)
    classes = {k + 1: of_id[segment][0] for k, segment in enumerate(segments)}
    number = {segment: k + 1 for k, segment in enumerate(segments)}
    of_frame = {
        stem: {number[segment]: name for segment, name in names.items() if segment}
        for stem, names in by_frame.items()
    }
    return PanopticIds(np.array(segments), classes, of_frame)
