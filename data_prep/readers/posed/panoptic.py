"""Reads COCO's panoptic format: PNGs whose colours encode segment ids, and one JSON for all PNGs.

Video segmenters give an object the same id in all frames; the ids of COCO's own single images are
not tracked.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_prep.readers.posed.labels import PANOPTIC, find_table
from data_prep.readers.posed.mask_format import MaskFormat
from data_prep.readers.posed.recording import INSTANCES, PosedFrame
from sceneprior.core.checked import checked
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.coco import CROWD
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.id_tables import LARGEST_ID, mask_size, read_rgb, stuff_of, tidy

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


class PanopticPngs(MaskFormat):
    """The masks of a room whose table is a `panoptic.json`."""

    name = "panoptic"
    title = f"COCO panoptic PNGs ({INSTANCES}/, {PANOPTIC})"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        table = folder / PANOPTIC
        return [table, *sorted((folder / INSTANCES).rglob("*.png"))] if table.is_file() else []

    @cached_property
    def _ids(self) -> "PanopticIds":
        return read_panoptic(find_table(self.folder), self.label_set_name)

    def has(self, frame: PosedFrame) -> bool:
        return frame.instances.is_file()

    def wanted(self, frame: PosedFrame) -> str:
        return str(frame.instances)

    def size(self, frame: PosedFrame) -> tuple[int, int]:
        return mask_size(frame.instances, rgb=True)

    def read(self, frame: PosedFrame) -> np.ndarray:
        return self._ids.read(frame.instances)

    def classes(self) -> dict[int, str]:
        return self._ids.tracked_classes(self.folder / PANOPTIC)

    def frame_classes(self, frame: PosedFrame) -> dict[int, str]:
        return self._ids.of_frame.get(frame.instances.stem, {})


@dataclass(frozen=True)
class PanopticIds:
    """Segments of a room, renumbered to consecutive ids."""

    segments: np.ndarray
    """(n,) segment ids, ascending."""
    of_frame: dict[str, dict[int, str]]
    """Class by new id (k + 1 for the k-th segment) for each frame, by the stem of the frame's PNG;
    stuff has a class of `STUFF`, or "background"."""
    stuff: frozenset[str]
    """Classes of stuff that the label set does not have, "background" included."""

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

    def tracked_classes(self, path: Path) -> dict[int, str]:
        """Class by new id; `path` is the JSON's.

        A segment of stuff with several classes is background.

        Raises:
            InputError: A segment has different classes in two frames, so ids are not tracked.
        """
        first: dict[int, tuple[str, str]] = {}
        for stem, classes in self.of_frame.items():
            for number, name in classes.items():
                before, where = first.setdefault(number, (name, stem))
                if before != name and {before, name} <= self.stuff:
                    first[number] = _BACKGROUND, where
                elif before != name:
                    raise InputError(
                        f"{path}: segment {self.segments[number - 1]} is {before} in '{where}', "
                        f"but {name} in '{stem}'. Ids must be tracked: the same object has the "
                        "same id in all frames, as video segmenters write them; else pass "
                        "--tracks auto."
                    )
        return {number: name for number, (name, _) in first.items()}


def read_panoptic(path: Path, label_set_name: str) -> PanopticIds:
    """Read a room's annotations. Stuff is not an object, unless the label set has its class."""
    room = checked(_Panoptic, read_json(path), str(path))
    own = {tidy(name) for name in label_set(label_set_name)}
    stuff = frozenset({_BACKGROUND, *STUFF[1:]} - own)
    names = {}
    for item in room.categories:
        if item.isthing or tidy(item.name) in own:
            names[item.id] = item.name
        else:
            name = STUFF[stuff_of(item.name)]
            names[item.id] = name if name in stuff else _BACKGROUND
    by_frame: dict[str, dict[int, str]] = {}
    for frame in room.annotations:
        for segment in frame.segments_info:
            if segment.category_id not in names:
                raise InputError(
                    f"{path}, '{frame.file_name}': category {segment.category_id} of segment "
                    f"{segment.id} is not among its categories."
                )
            name = CROWD if segment.iscrowd else names[segment.category_id]
            by_frame.setdefault(Path(frame.file_name).stem, {})[segment.id] = name
    segments = sorted({k for names in by_frame.values() for k in names} - {0})
    if not 0 < len(segments) < LARGEST_ID:
        raise InputError(f"{path} has {len(segments)} segments; expected 1 to {LARGEST_ID - 1}.")
    number = {segment: k + 1 for k, segment in enumerate(segments)}
    of_frame = {
        stem: {number[segment]: name for segment, name in names.items() if segment}
        for stem, names in by_frame.items()
    }
    return PanopticIds(np.array(segments), of_frame, stuff)
