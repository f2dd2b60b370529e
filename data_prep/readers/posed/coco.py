"""Reads COCO annotation files (JSON) of single images, of images with tracks, and of videos.

Source: cocodataset.org (data format); the format of YouTube-VIS, whose annotations have one mask
per frame in `segmentations`; CocoVID and CVAT, whose annotations of images have a track.
"""

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from data_prep.readers.posed.mask_format import MaskFormat, instead, main_classes
from data_prep.readers.posed.recording import PosedFrame
from sceneprior.core.checked import checked, shown
from sceneprior.core.coco import (
    CROWD,
    Category,
    CocoId,
    Side,
    check_size,
    decode,
    paint,
    read_coco_json,
)
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import LARGEST_ID

FILES = ("*coco*.json", "instances*.json", "annotations*.json", "annotations/*.json")
"""Glob patterns of COCO's JSON in a room's folder."""
_TRACKS = ("track_id", "instance_id")


@dataclass
class SegmentedFrame:
    """Masks of one frame as polygons or run lengths, which are decoded when the frame is read."""

    size: tuple[int, int]
    where: str
    """File and frame, for messages."""
    masks: list[tuple[int, Any, str]] = field(default_factory=list)
    """Id, segmentation and place of each mask."""
    classes: dict[int, str] = field(default_factory=dict)

    def add(self, number: int, name: str, segmentation: Any, where: str) -> None:
        """Add a mask; `where` names it within the frame."""
        self.masks.append((number, segmentation, f"{self.where}, {where}"))
        self.classes[number] = name


class SegmentedFrames(MaskFormat):
    """Masks as polygons or run lengths. Masks of one frame may overlap (`paint`)."""

    @property
    @abstractmethod
    def frames(self) -> dict[str, SegmentedFrame]:
        """Frames by the stems of their pictures' names."""

    @staticmethod
    def put(frames: dict[str, SegmentedFrame], file_name: str, frame: SegmentedFrame) -> None:
        """Add a frame, whose name must be unique."""
        check_size(frame.size, frame.where)
        if frames.setdefault(stem := Path(file_name).stem, frame) is not frame:
            raise InputError(
                f"{frame.where}: two pictures are named {shown(stem)}; a room has one of each name."
            )

    def has(self, frame: PosedFrame) -> bool:
        return frame.stem in self.frames

    def wanted(self, frame: PosedFrame) -> str:
        return f"a picture {shown(frame.stem)} in {self.find(self.folder)[0]}{instead(self.frames)}"

    def size(self, frame: PosedFrame) -> tuple[int, int]:
        return self.frames[frame.stem].size

    def read(self, frame: PosedFrame) -> np.ndarray:
        found = self.frames[frame.stem]
        masks = ((k, decode(mask, found.size, where)) for k, mask, where in found.masks)
        return paint(masks, found.size)

    def classes(self) -> dict[int, str]:
        classes, self.notes = main_classes(frame.classes for frame in self.frames.values())
        return classes

    def frame_classes(self, frame: PosedFrame) -> dict[int, str]:
        return self.frames[frame.stem].classes


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
        for key in _TRACKS:
            for value in (getattr(self, key), attributes.get(key)):
                if isinstance(value, CocoId):
                    return value
        return None


class _VideoAnnotation(_Annotation):
    video_id: CocoId
    segmentations: list[Any]


class _Coco(BaseModel):
    categories: list[Category]


class _Images(_Coco):
    images: list[_Image]
    annotations: list[_ImageAnnotation]


class _Videos(_Coco):
    videos: list[_Video]
    annotations: list[_VideoAnnotation]


class CocoMasks(SegmentedFrames):
    """The masks of one JSON. Ids are tracked if every annotation has a track or belongs to a
    video."""

    name = "coco"
    title = "a COCO JSON"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        return sorted({path for pattern in FILES for path in folder.glob(pattern)})

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
        coco = self._content
        return isinstance(coco, _Videos) or all(row.track is not None for row in coco.annotations)

    @cached_property
    def frames(self) -> dict[str, SegmentedFrame]:
        coco, (path,) = self._content, self.find(self.folder)
        names = {row.id: row.name for row in coco.categories}
        for row in coco.annotations:
            if row.category_id not in names:
                raise InputError(
                    f"{path}, annotation {shown(row.id)}: category {shown(row.category_id)} is not "
                    "among its categories."
                )
        class_of = [CROWD if row.iscrowd else names[row.category_id] for row in coco.annotations]
        if isinstance(coco, _Videos):
            return self._of_video(coco, class_of, path)
        return self._of_images(coco, class_of, path)

    def _of_images(
        self, coco: _Images, class_of: list[str], path: Path
    ) -> dict[str, SegmentedFrame]:
        of_id: dict[CocoId, SegmentedFrame] = {}
        frames: dict[str, SegmentedFrame] = {}
        for image in coco.images:
            frame = SegmentedFrame((image.height, image.width), str(path))
            of_id[image.id] = frame
            self.put(frames, image.file_name, frame)
        tracks = dict.fromkeys(row.track for row in coco.annotations)
        if self.tracked and len(tracks) >= LARGEST_ID:
            raise InputError(f"{path} has {len(tracks)} tracks; expected at most {LARGEST_ID - 1}.")
        number = {track: k for k, track in enumerate(tracks, start=1)}
        for k, (row, name) in enumerate(zip(coco.annotations, class_of, strict=True), start=1):
            if row.image_id not in of_id:
                raise InputError(
                    f"{path}, annotation {shown(row.id)}: image {shown(row.image_id)} is not among "
                    "its images."
                )
            own = number[row.track] if self.tracked else k
            of_id[row.image_id].add(own, name, row.segmentation, f"annotation {shown(row.id)}")
        return frames

    def _of_video(
        self, coco: _Videos, class_of: list[str], path: Path
    ) -> dict[str, SegmentedFrame]:
        (video,) = coco.videos
        count = len(video.file_names)
        ordered = [SegmentedFrame((video.height, video.width), str(path)) for _ in range(count)]
        if len(coco.annotations) >= LARGEST_ID:
            raise InputError(
                f"{path} has {len(coco.annotations)} objects; expected at most {LARGEST_ID - 1}."
            )
        for k, (row, name) in enumerate(zip(coco.annotations, class_of, strict=True), start=1):
            if row.video_id != video.id or len(row.segmentations) != count:
                raise InputError(
                    f"{path}, annotation {shown(row.id)}: it has {len(row.segmentations)} masks of "
                    f"video {shown(row.video_id)}, but video {shown(video.id)} has {count} frames; "
                    "an annotation has a mask, or null, for each frame."
                )
            for at, mask in enumerate(row.segmentations):
                if mask is not None:
                    ordered[at].add(k, name, mask, f"annotation {shown(row.id)}, frame {at}")
        frames: dict[str, SegmentedFrame] = {}
        for file_name, frame in zip(video.file_names, ordered, strict=True):
            self.put(frames, file_name, frame)
        return frames
