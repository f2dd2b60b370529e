"""Masks as one PNG per frame: grey ids with a table of classes, or COCO's panoptic colours."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_prep.readers.posed.masks import FrameMask, MaskFormat
from data_prep.readers.posed.recording import INSTANCES, PosedFrame
from sceneprior.core.checked import checked
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.coco import CROWD
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.id_tables import (
    LARGEST_ID,
    mask_size,
    read_class_table,
    read_mask,
    read_rgb,
    stuff_of,
    tidy,
)

PANOPTIC = "panoptic.json"
TABLES = ("classes.json", "classes.csv", PANOPTIC)
_BACKGROUND = "background"


def find_table(folder: Path) -> Path:
    """Find the only table in a folder that maps the room's ids to classes: one of `TABLES`."""
    found = [folder / name for name in TABLES if (folder / name).is_file()]
    if len(found) != 1:
        named = " and ".join(path.name for path in found) or f"no {' or '.join(TABLES)}"
        raise InputError(f"{folder} has {named}; expected one table with the class of each id.")
    return found[0]


class FramePngs(MaskFormat):
    """One PNG per frame: `PosedFrame.instances`."""

    def wanted(self, frame: PosedFrame) -> str:
        return str(frame.instances)

    def of(self, frame: PosedFrame) -> FrameMask | None:
        path = frame.instances
        return self.of_png(path) if path.is_file() else None

    @abstractmethod
    def of_png(self, path: Path) -> FrameMask:
        """The masks in a PNG."""


class IdPngs(FramePngs):
    """PNGs whose values are ids. The classes are in the room's table or, for ids of single frames,
    in a JSON beside each PNG with the same stem, in any form of `read_class_table`."""

    name = "png"
    title = "PNGs of ids (instances/)"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        inside = folder / INSTANCES
        return sorted(inside.rglob("*.png")) + sorted(inside.rglob("*.json"))

    @property
    def tracked(self) -> bool:
        """False if the classes are beside each PNG and the room has no table."""
        beside = (self.folder / INSTANCES).rglob("*.json")
        return any((self.folder / name).is_file() for name in TABLES) or not any(beside)

    def of_png(self, path: Path) -> FrameMask:
        return FrameMask(
            partial(mask_size, path), partial(read_mask, path), partial(self._classes_of, path)
        )

    @cached_property
    def _table(self) -> dict[int, str]:
        return read_class_table(find_table(self.folder))

    def classes(self) -> dict[int, str]:
        return self._table

    def _classes_of(self, path: Path) -> dict[int, str]:
        own = path.with_suffix(".json")
        if own.is_file():
            return read_class_table(own)
        try:
            return self._table
        except InputError as error:
            raise InputError(
                f"{str(error).removesuffix('.')}; or put the classes of a frame's ids into "
                f"{own.name} beside its PNG."
            ) from None


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True)


class _Category(_Strict):
    id: int
    name: str
    isthing: int = 1


class _Segment(_Strict):
    id: Annotated[int, Field(ge=0, lt=2**24)]
    category_id: int
    iscrowd: int = 0


class _Annotation(_Strict):
    file_name: str = ""
    segments_info: list[_Segment]


class _Panoptic(_Strict):
    categories: list[_Category]
    annotations: list[_Annotation]


class PanopticPngs(FramePngs):
    """COCO's panoptic format: PNGs whose colours encode segment ids, and one JSON for all PNGs.

    Video segmenters give an object the same id in all frames; the ids of COCO's own single images
    are not tracked.
    """

    name = "panoptic"
    title = f"COCO panoptic PNGs ({INSTANCES}/, {PANOPTIC})"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        table = folder / PANOPTIC
        return [table, *sorted((folder / INSTANCES).rglob("*.png"))] if table.is_file() else []

    def of_png(self, path: Path) -> FrameMask:
        return FrameMask(
            partial(mask_size, path, rgb=True),
            lambda: self._segments.read(path),
            lambda: self._segments.of_frame.get(path.stem, {}),
        )

    @cached_property
    def _segments(self) -> "_Segments":
        return _read_segments(find_table(self.folder), self.label_set_name)

    def classes(self) -> dict[int, str]:
        """Class by id; a segment of stuff with several classes is background.

        Raises:
            InputError: A segment has different classes in two frames, so ids are not tracked.
        """
        first: dict[int, tuple[str, str]] = {}
        for stem, classes in self._segments.of_frame.items():
            for number, name in classes.items():
                before, where = first.setdefault(number, (name, stem))
                if before != name and {before, name} <= self._segments.stuff:
                    first[number] = _BACKGROUND, where
                elif before != name:
                    raise InputError(
                        f"{self.folder / PANOPTIC}: segment {self._segments.ids[number - 1]} is "
                        f"{before} in '{where}', but {name} in '{stem}'. Ids must be tracked: the "
                        "same object has the same id in all frames, as video segmenters write "
                        "them; else pass --tracks auto."
                    )
        return {number: name for number, (name, _) in first.items()}


@dataclass(frozen=True)
class _Segments:
    """Panoptic segments of a room, renumbered to consecutive ids."""

    ids: np.ndarray
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
        ids = read_rgb(path).astype(np.int64) @ (1, 256, 65536)
        place = np.searchsorted(self.ids, ids)
        there = self.ids[np.minimum(place, len(self.ids) - 1)] == ids
        numbers = np.where(there, place + 1, len(self.ids) + 1)
        return np.where(ids == 0, 0, numbers).astype(np.int32)


def _read_segments(path: Path, label_set_name: str) -> _Segments:
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
    return _Segments(np.array(segments), of_frame, stuff)
