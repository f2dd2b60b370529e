"""Reads the masks that Grounded-SAM-2's trackers and its demos of single images write.

Source: `grounded_sam2_tracking_demo_with_continuous_id.py`, `utils/mask_dictionary_model.py` and
`grounded_sam2_local_demo.py` in IDEA-Research/Grounded-SAM-2.
"""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from data_prep.readers.posed.coco import SegmentedFrame, SegmentedFrames
from data_prep.readers.posed.mask_format import MaskFormat, instead, main_classes
from data_prep.readers.posed.recording import PosedFrame
from sceneprior.core.checked import checked, plain
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.id_tables import LARGEST_ID

MASKS, LABELS, PREFIX = "mask_data", "json_data", "mask_"


class _Label(BaseModel):
    class_name: str


class _Labels(BaseModel):
    labels: dict[str, _Label]


class GroundedSam2(MaskFormat):
    """Tracked ids: `mask_data/mask_<frame>.npy` has the ids of a frame, and
    `json_data/mask_<frame>.json` their classes.

    Classes are detected again in each key frame and may change; the most frequent class is taken.
    """

    name = "grounded-sam2"
    title = f"Grounded-SAM-2 ({MASKS}/, {LABELS}/)"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        masks = sorted((folder / MASKS).glob(f"{PREFIX}*.npy"))
        return [*masks, *sorted((folder / LABELS).glob(f"{PREFIX}*.json"))] if masks else []

    def _path(self, frame: PosedFrame) -> Path:
        return self.folder / MASKS / f"{PREFIX}{frame.stem}.npy"

    def has(self, frame: PosedFrame) -> bool:
        return self._path(frame).is_file()

    def wanted(self, frame: PosedFrame) -> str:
        there = (path.stem for path in (self.folder / MASKS).glob(f"{PREFIX}*.npy"))
        return f"{self._path(frame)}{instead(there)}"

    def size(self, frame: PosedFrame) -> tuple[int, int]:
        height, width = _open(self._path(frame)).shape
        return height, width

    def read(self, frame: PosedFrame) -> np.ndarray:
        ids = np.array(_open(self._path(frame))).astype(np.int64)
        if ids.min(initial=0) < 0 or ids.max(initial=0) >= LARGEST_ID:
            raise InputError(
                f"{self._path(frame)} has ids from {ids.min()} to {ids.max()}; expected 0 to "
                f"{LARGEST_ID - 1}, where 0 means no object."
            )
        return ids

    def classes(self) -> dict[int, str]:
        paths = sorted((self.folder / LABELS).glob(f"{PREFIX}*.json"))
        classes, self.notes = main_classes(map(_labels, paths))
        if not classes:
            raise InputError(
                f"{self.folder / LABELS} names no class; expected {PREFIX}<frame>.json for each "
                f"mask of {MASKS}, as Grounded-SAM-2 writes them."
            )
        return classes

    def frame_classes(self, frame: PosedFrame) -> dict[int, str]:
        return _labels(self.folder / LABELS / f"{PREFIX}{frame.stem}.json")


def _labels(path: Path) -> dict[int, str]:
    """Class of each id of a frame."""
    labels = checked(_Labels, read_json(path), str(path)).labels
    for key in labels:
        if not (key.isascii() and key.isdecimal()) or not 0 < int(key[:9]) < LARGEST_ID:
            raise InputError(
                f"{path}: '{plain(key)}' under `labels` is not an instance id; expected a number "
                f"from 1 to {LARGEST_ID - 1}."
            )
    return {int(key): label.class_name for key, label in labels.items()}


def _open(path: Path) -> np.ndarray:
    """An .npy of ids, (height, width), left on disk."""
    try:
        ids = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy parses the header as Python, with errors of any type
        raise InputError(
            f"{path} cannot be read as an .npy of numbers ({plain(str(error), 120)}); it may be "
            "truncated: write it again."
        ) from None
    if isinstance(ids, np.ndarray) and ids.ndim == 2 and ids.size and ids.dtype.kind in "iu":
        return ids
    found = f"{ids.dtype} of shape {ids.shape}" if isinstance(ids, np.ndarray) else "an archive"
    raise InputError(
        f"{path} holds {found}; expected integer ids, (height, width), as Grounded-SAM-2 writes "
        "them."
    )


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

    @property
    def tracked(self) -> bool:
        return False

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
