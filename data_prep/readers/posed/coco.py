"""Masks in COCO's formats: polygons or run lengths of images, of images with tracks or of videos;
and panoptic PNGs, whose colours are the ids of segments.

Source: cocodataset.org (data format); the format of YouTube-VIS, whose annotations have one mask
per frame in `segmentations`; CocoVID and CVAT, whose annotations of images have a track.
"""

from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_prep.readers.posed.masks import (
    PANOPTIC,
    FrameMask,
    FramePngs,
    MaskFormat,
    SegmentedFrame,
    find_table,
)
from data_prep.readers.posed.recording import INSTANCES
from sceneprior.core.checked import checked, shown
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.coco import CROWD, Category, CocoId, Side, check_ids, read_coco_json
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, read_json
from sceneprior.core.id_tables import LARGEST_ID, mask_size, read_rgb, stuff_of, tidy

FILES = ("*coco*.json", "instances*.json", "annotations*.json")
"""Glob patterns of COCO's JSON in a room's folder; it may also be in a folder `annotations`."""
_BACKGROUND = "background"


class _Image(BaseModel):
    id: CocoId
    file_name: str
    height: Side
    width: Side


class _Video(BaseModel):
    id: CocoId
    file_names: list[str]
    height: Side
    width: Side


class _Annotation(BaseModel):
    id: Any = None
    category_id: CocoId
    iscrowd: bool = False


class _ImageAnnotation(_Annotation):
    image_id: CocoId
    segmentation: Any = None
    track_id: CocoId | None = None
    instance_id: CocoId | None = None
    attributes: Any = None

    @property
    def track(self) -> CocoId | None:
        """The track id, which CVAT stores among the attributes."""
        attributes = self.attributes if isinstance(self.attributes, dict) else {}
        for key in ("track_id", "instance_id"):
            for value in (getattr(self, key), attributes.get(key)):
                if isinstance(value, CocoId):
                    return value
        return None


class _VideoAnnotation(_Annotation):
    video_id: CocoId
    segmentations: list[Any]


class _Images(BaseModel):
    categories: list[Category]
    images: list[_Image]
    annotations: list[_ImageAnnotation]

    @property
    def tracks(self) -> list[CocoId | None]:
        """The track of each annotation."""
        return [row.track for row in self.annotations]

    @property
    def pictures(self) -> list[tuple[str, tuple[int, int]]]:
        """Name and (height, width) of each picture."""
        return [(image.file_name, (image.height, image.width)) for image in self.images]

    def masks(self, path: Path) -> Iterator[tuple[int, int, Any, str]]:
        """Index of the annotation, index of the picture, segmentation, and place of each mask."""
        check_ids(path, "image", [(image.id, image.file_name) for image in self.images])
        place_of = {image.id: place for place, image in enumerate(self.images)}
        for k, row in enumerate(self.annotations):
            where = f"annotation {shown(row.id)}"
            if row.image_id not in place_of:
                raise InputError(
                    f"{path}, {where}: image {shown(row.image_id)} is not among its images."
                )
            yield k, place_of[row.image_id], row.segmentation, where


class _Videos(BaseModel):
    categories: list[Category]
    videos: list[_Video]
    annotations: list[_VideoAnnotation]

    @property
    def tracks(self) -> list[CocoId | None]:
        """Each annotation is a track."""
        return [*range(len(self.annotations))]

    @property
    def pictures(self) -> list[tuple[str, tuple[int, int]]]:
        """Name and (height, width) of each frame of the only video."""
        (video,) = self.videos
        return [(name, (video.height, video.width)) for name in video.file_names]

    def masks(self, path: Path) -> Iterator[tuple[int, int, Any, str]]:
        """See `_Images.masks`; a frame without the object has null in place of a mask."""
        (video,) = self.videos
        count = len(video.file_names)
        for k, row in enumerate(self.annotations):
            where = f"annotation {shown(row.id)}"
            if row.video_id != video.id or len(row.segmentations) != count:
                raise InputError(
                    f"{path}, {where}: it has {len(row.segmentations)} masks of video "
                    f"{shown(row.video_id)}, but video {shown(video.id)} has {count} frames; an "
                    "annotation has a mask, or null, for each frame."
                )
            for at, mask in enumerate(row.segmentations):
                if mask is not None:
                    yield k, at, mask, f"{where}, frame {at}"


class CocoMasks(MaskFormat):
    """The masks of one JSON. Ids are tracked if every annotation has a track or belongs to a
    video."""

    name = "coco"
    title = "a COCO JSON"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        found = {path for pattern in FILES for path in list_files(folder, pattern)}
        return sorted(found | {*list_files(folder / "annotations", "*.json")})

    @cached_property
    def _content(self) -> _Images | _Videos:
        path, *others = self.find(self.folder)
        if others:
            raise InputError(
                f"{self.folder} has several COCO files ({path.name}, {others[0].name}); a room has "
                "one: merge them, or move the others away."
            )
        data = read_coco_json(path)
        rows = data.get("annotations")
        first = rows[0] if isinstance(rows, list) and rows else None
        where = f"{path} is not a COCO JSON of masks"
        coco: _Images | _Videos
        if not isinstance(first, dict) or "segmentations" not in first:
            coco = checked(_Images, data, where)
        elif len((coco := checked(_Videos, data, where)).videos) != 1:
            raise InputError(
                f"{path} describes {len(coco.videos)} videos; keep that of the room, and its "
                "annotations."
            )
        if not coco.annotations:
            raise InputError(f"{path} has no annotations; expected one for each object's mask.")
        return coco

    @property
    def tracked(self) -> bool:
        return None not in self._content.tracks

    @cached_property
    def frames(self) -> dict[str, FrameMask]:
        coco, (path,) = self._content, self.find(self.folder)
        check_ids(path, "category", [(row.id, row.name) for row in coco.categories])
        names = {row.id: row.name for row in coco.categories}
        for row in coco.annotations:
            if row.category_id not in names:
                raise InputError(
                    f"{path}, annotation {shown(row.id)}: category {shown(row.category_id)} is not "
                    "among its categories."
                )
        class_of = [CROWD if row.iscrowd else names[row.category_id] for row in coco.annotations]
        tracks = coco.tracks if self.tracked else [*range(len(class_of))]
        number = {track: k for k, track in enumerate(dict.fromkeys(tracks), start=1)}
        if self.tracked and len(number) >= LARGEST_ID:
            what = "objects" if isinstance(coco, _Videos) else "tracks"
            raise InputError(f"{path} has {len(number)} {what}; expected at most {LARGEST_ID - 1}.")
        frames = [SegmentedFrame(size, str(path)) for _, size in coco.pictures]
        for k, place, mask, where in coco.masks(path):
            frames[place].add(number[tracks[k]], class_of[k], mask, where)
        found: dict[str, FrameMask] = {}
        for (file_name, _), frame in zip(coco.pictures, frames, strict=True):
            frame.put(found, file_name)
        return found


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


class _PanopticFrame(_Strict):
    file_name: str = ""
    segments_info: list[_Segment]


class _Panoptic(_Strict):
    categories: list[_Category]
    annotations: list[_PanopticFrame]


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
        return (
            [table, *list_files(folder / INSTANCES, "*.png", deep=True)] if table.is_file() else []
        )

    def of_png(self, path: Path) -> FrameMask:
        return FrameMask(
            partial(mask_size, path, rgb=True),
            partial(self._read, path),
            lambda: self._segments[1].get(self._name_of(path), {}),
        )

    def _name_of(self, path: Path) -> str:
        """The name of a PNG's frame in the JSON, which may leave out folders."""
        place, named = self.folder / INSTANCES, self._segments[1]
        whole = _without_suffix(path.relative_to(place) if place in path.parents else path)
        if whole in named:
            return whole
        fits = [
            name
            for name in named
            if f"/{whole}".endswith(f"/{name}") or f"/{name}".endswith(f"/{whole}")
        ]
        stems = [name for name in named if Path(name).name == path.stem]
        if len(fits or stems) > 1:
            raise InputError(
                f"{path} may be {' or '.join(map(shown, sorted(fits or stems)))} of {PANOPTIC}; "
                f"name its frames there by their paths below {INSTANCES}/."
            )
        return (fits or stems or [""])[0]

    @cached_property
    def _segments(self) -> tuple[np.ndarray, dict[str, dict[int, str]], set[str]]:
        """Segment ids, (n,), ascending; the class by new id, k + 1 for the k-th segment, for each
        frame, by the name of its PNG; and the classes of stuff that the label set does not have,
        "background" included, which are no objects."""
        path = find_table(self.folder)
        room = checked(_Panoptic, read_json(path), str(path))
        check_ids(path, "category", [(item.id, item.name) for item in room.categories])
        own = {tidy(name) for name in label_set(self.label_set_name)}
        stuff = {_BACKGROUND, *STUFF[1:]} - own
        names = {}
        for item in room.categories:
            if item.isthing or tidy(self.mapped(item.name)) in own:
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
                of_name = by_frame.setdefault(_without_suffix(Path(frame.file_name)), {})
                of_name[segment.id] = name
        ids = sorted({k for classes in by_frame.values() for k in classes} - {0})
        if not 0 < len(ids) < LARGEST_ID:
            raise InputError(f"{path} has {len(ids)} segments; expected 1 to {LARGEST_ID - 1}.")
        number = {segment: k for k, segment in enumerate(ids, start=1)}
        of_frame = {
            stem: {number[segment]: name for segment, name in classes.items() if segment}
            for stem, classes in by_frame.items()
        }
        return np.array(ids), of_frame, stuff

    def _read(self, path: Path) -> np.ndarray:
        """Read a PNG as new ids, (height, width) int32.

        0 is background, k + 1 the k-th segment, n + 1 any id that is missing from the JSON.
        """
        known = self._segments[0]
        ids = read_rgb(path).astype(np.int64) @ (1, 256, 65536)
        place = np.searchsorted(known, ids)
        there = known[np.minimum(place, len(known) - 1)] == ids
        numbers = np.where(there, place + 1, len(known) + 1)
        return np.where(ids == 0, 0, numbers).astype(np.int32)

    def classes(self) -> dict[int, str]:
        """Class by id; a segment of stuff with several classes is background.

        Raises:
            InputError: A segment has different classes in two frames, so ids are not tracked.
        """
        first: dict[int, tuple[str, str]] = {}
        ids, of_frame, stuff = self._segments
        for stem, classes in of_frame.items():
            for number, name in classes.items():
                before, where = first.setdefault(number, (name, stem))
                if before != name and {before, name} <= stuff:
                    first[number] = _BACKGROUND, where
                elif self.mapped(before) != self.mapped(name):
                    raise InputError(
                        f"{self.folder / PANOPTIC}: segment {ids[number - 1]} is {before} in "
                        f"'{where}', but {name} in '{stem}'. Ids must be tracked: the same object "
                        "has the same id in all frames, as video segmenters write them; else pass "
                        "--tracks auto."
                    )
        return {number: name for number, (name, _) in first.items()}


def _without_suffix(path: Path) -> str:
    return path.with_suffix("").as_posix() if path.name else ""
