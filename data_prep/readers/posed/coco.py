"""Masks as polygons or run lengths in COCO's JSON: of images, of images with tracks, of videos.

Source: cocodataset.org (data format); the format of YouTube-VIS, whose annotations have one mask
per frame in `segmentations`; CocoVID and CVAT, whose annotations of images have a track. The JSON
that a demo of Grounded-SAM-2 writes for each picture: `grounded_sam2_local_demo.py` in
IDEA-Research/Grounded-SAM-2.
"""

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from data_prep.readers.posed.masks import FrameMask, MaskFormat, instead, main_classes
from data_prep.readers.posed.recording import PosedFrame
from data_prep.readers.posed.sam2 import LABELS, MASKS, PREFIX, GroundedSam2
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
from sceneprior.core.files import read_json
from sceneprior.core.id_tables import LARGEST_ID

FILES = ("*coco*.json", "instances*.json", "annotations*.json", "annotations/*.json")
"""Glob patterns of COCO's JSON in a room's folder."""


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

    def read(self) -> np.ndarray:
        """Ids, (height, width)."""
        masks = ((k, decode(mask, self.size, where)) for k, mask, where in self.masks)
        return paint(masks, self.size)


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

    def of(self, frame: PosedFrame) -> FrameMask | None:
        found = self.frames.get(frame.stem)
        if found is None:
            return None
        return FrameMask(partial(getattr, found, "size"), found.read, lambda: found.classes)

    def wanted(self, frame: PosedFrame) -> str:
        return f"a picture {shown(frame.stem)} in {self.find(self.folder)[0]}{instead(self.frames)}"

    def classes(self) -> dict[int, str]:
        classes, self.notes = main_classes(frame.classes for frame in self.frames.values())
        return classes


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


class _Videos(BaseModel):
    categories: list[Category]
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
        frames: dict[str, SegmentedFrame] = {}
        if isinstance(coco, _Videos):
            pictures = _frames_of_video(coco, class_of, path)
        else:
            pictures = _frames_of_images(coco, class_of, path, self.tracked)
        for file_name, frame in pictures:
            self.put(frames, file_name, frame)
        return frames


def _frames_of_images(
    coco: _Images, class_of: list[str], path: Path, tracked: bool
) -> list[tuple[str, SegmentedFrame]]:
    ordered = [SegmentedFrame((image.height, image.width), str(path)) for image in coco.images]
    of_id = {image.id: frame for image, frame in zip(coco.images, ordered, strict=True)}
    tracks = dict.fromkeys(row.track for row in coco.annotations)
    if tracked and len(tracks) >= LARGEST_ID:
        raise InputError(f"{path} has {len(tracks)} tracks; expected at most {LARGEST_ID - 1}.")
    number = {track: k for k, track in enumerate(tracks, start=1)}
    for k, (row, name) in enumerate(zip(coco.annotations, class_of, strict=True), start=1):
        if row.image_id not in of_id:
            raise InputError(
                f"{path}, annotation {shown(row.id)}: image {shown(row.image_id)} is not among "
                "its images."
            )
        own = number[row.track] if tracked else k
        of_id[row.image_id].add(own, name, row.segmentation, f"annotation {shown(row.id)}")
    return [(image.file_name, frame) for image, frame in zip(coco.images, ordered, strict=True)]


def _frames_of_video(
    coco: _Videos, class_of: list[str], path: Path
) -> list[tuple[str, SegmentedFrame]]:
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
    return list(zip(video.file_names, ordered, strict=True))


class _Found(BaseModel):
    class_name: str
    segmentation: Any


class _Picture(BaseModel):
    image_path: str
    annotations: list[_Found]
    img_width: int = Field(ge=1)
    img_height: int = Field(ge=1)


class GroundedSam2Images(SegmentedFrames):
    """Ids of single images: the JSON that a demo writes for each picture, in `json_data/`.

    The key `image_path` identifies the frame; the JSON's file name does not matter.
    """

    name = "grounded-sam2"
    title = f"Grounded-SAM-2 of single images ({LABELS}/)"
    tracked = False

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        return [] if GroundedSam2.find(folder) else sorted((folder / LABELS).glob("*.json"))

    @cached_property
    def frames(self) -> dict[str, SegmentedFrame]:
        frames: dict[str, SegmentedFrame] = {}
        count = 0
        for path in self.find(self.folder):
            where = f"{path} (there is no {MASKS}/{PREFIX}*.npy, so it is read as a single image's)"
            picture = checked(_Picture, read_json(path), where)
            frame = SegmentedFrame((picture.img_height, picture.img_width), str(path))
            for row in picture.annotations:
                count += 1
                frame.add(count, row.class_name, row.segmentation, f"annotation {len(frame.masks)}")
            self.put(frames, picture.image_path, frame)
        return frames
