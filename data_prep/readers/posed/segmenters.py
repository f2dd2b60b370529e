"""Masks as segmenters write them: PNGs of ids, SAM 2's folders, Grounded-SAM-2's arrays and JSONs.

Source: `save_masks_to_dir` of `tools/vos_inference.py` in facebookresearch/sam2, which writes them
with `--per_obj_png_file`, and SA-V, which has the same layout;
`grounded_sam2_tracking_demo_with_continuous_id.py`, `utils/mask_dictionary_model.py` and
`grounded_sam2_local_demo.py` in IDEA-Research/Grounded-SAM-2.
"""

import re
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from data_prep.readers.posed.masks import (
    TABLES,
    FrameMask,
    FramePngs,
    MaskFormat,
    SegmentedFrame,
    find_table,
    instead,
)
from data_prep.readers.posed.recording import INSTANCES, PosedFrame
from sceneprior.core.checked import checked, plain
from sceneprior.core.coco import paint
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, list_folders, read_arrays, read_json
from sceneprior.core.id_tables import LARGEST_ID, mask_size, read_class_table, read_mask

MASKS, LABELS, PREFIX = "mask_data", "json_data", "mask_"
"""Folders of Grounded-SAM-2's ids and classes, and the beginning of their files' names."""
PLACES = ("masks", ".")
"""Possible parents of the objects' folders, within a room's folder."""


class IdPngs(FramePngs):
    """PNGs whose values are ids. The classes are in the room's table or, for ids of single frames,
    in a JSON beside each PNG with the same stem, in any form of `read_class_table`."""

    name = "png"
    title = "PNGs of ids (instances/)"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        inside = folder / INSTANCES
        return [*list_files(inside, "*.png", deep=True), *list_files(inside, "*.json", deep=True)]

    @property
    def tracked(self) -> bool:
        """False if the classes are beside each PNG and the room has no table."""
        beside = list_files(self.folder / INSTANCES, "*.json", deep=True)
        return any((self.folder / name).is_file() for name in TABLES) or not beside

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


class ObjectFolders(MaskFormat):
    """One folder per object (`<object:03d>/<frame>.png`), whose number is the id; a pixel above 0
    shows the object.

    SAM 2 knows no classes: they are in the room's table of classes. Masks may overlap (`paint`).
    """

    name = "sam2"
    title = "SAM 2 (a folder per object)"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        return [path for place in _object_folders(folder) for path in list_files(place, "*.png")]

    @cached_property
    def _objects(self) -> dict[int, Path]:
        """Folder of each object."""
        folders: dict[int, Path] = {}
        for path in _object_folders(self.folder):
            other = folders.setdefault(int(path.name), path)
            if other != path:
                raise InputError(
                    f"{other} and {path.name} are folders of one object; keep one of them."
                )
        for number, path in folders.items():
            if not 0 < number < LARGEST_ID:
                raise InputError(
                    f"{path}: its object has the number {number}, expected 1 to {LARGEST_ID - 1}; "
                    "rename the folder, and the object in the table of classes."
                )
        return folders

    @cached_property
    def frames(self) -> dict[str, FrameMask]:
        paths: dict[str, dict[int, Path]] = {}
        for number, folder in sorted(self._objects.items()):
            for path in list_files(folder, "*.png"):
                paths.setdefault(path.stem, {})[number] = path
        return {
            stem: FrameMask(
                partial(mask_size, next(iter(own.values()))), partial(_painted, own), self.classes
            )
            for stem, own in paths.items()
        }

    def wanted(self, frame: PosedFrame) -> str:
        return f"{min(self._objects.values())}/{frame.stem}.png{instead(self.frames)}"

    def classes(self) -> dict[int, str]:
        try:
            return read_class_table(find_table(self.folder))
        except InputError as error:
            raise InputError(
                f"{str(error).removesuffix('.')}; SAM 2's masks have no classes, so write one for "
                f'each object\'s folder: {{"{min(self._objects)}": "bed", ...}}.'
            ) from None


def _object_folders(room: Path) -> list[Path]:
    """Folders that are named by a number and contain a PNG, in the first of `PLACES` that has
    any."""
    for place in PLACES:
        folders = [
            path
            for path in list_folders(room / place)
            if re.fullmatch("[0-9]{1,9}", path.name) and list_files(path, "*.png")
        ]
        if folders:
            return folders
    return []


def _painted(paths: dict[int, Path]) -> np.ndarray:
    """Ids of a frame, (height, width), from the PNG of each object."""
    masks = {number: read_mask(path) > 0 for number, path in paths.items()}
    size = next(iter(masks.values())).shape
    for number, mask in masks.items():
        if mask.shape != size:
            raise InputError(
                f"{paths[number]} is {mask.shape[1]} x {mask.shape[0]} pixels, but the masks of "
                f"other objects {size[1]} x {size[0]}; write all masks at the size of the pictures."
            )
    return paint(masks.items(), size)


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
        masks = list_files(folder / MASKS, f"{PREFIX}*.npy")
        return [*masks, *list_files(folder / LABELS, f"{PREFIX}*.json")] if masks else []

    @cached_property
    def frames(self) -> dict[str, FrameMask]:
        return {
            path.stem.removeprefix(PREFIX): FrameMask(
                partial(lambda each: _read_ids(each).shape, path),
                partial(_read_ids, path),
                partial(_labels, self.folder / LABELS / f"{path.stem}.json"),
            )
            for path in list_files(self.folder / MASKS, f"{PREFIX}*.npy")
        }

    def wanted(self, frame: PosedFrame) -> str:
        there = (f"{PREFIX}{stem}" for stem in self.frames)
        return f"{self.folder / MASKS / f'{PREFIX}{frame.stem}.npy'}{instead(there)}"

    def classes(self) -> dict[int, str]:
        paths = list_files(self.folder / LABELS, f"{PREFIX}*.json")
        classes = self.main_classes(map(_labels, paths))
        if not classes:
            raise InputError(
                f"{self.folder / LABELS} names no class; expected {PREFIX}<frame>.json for each "
                f"mask of {MASKS}, as Grounded-SAM-2 writes them."
            )
        return classes


def _read_ids(path: Path) -> np.ndarray:
    """Ids of a frame, (height, width) int64."""
    arrays = read_arrays(path, "write it again, as Grounded-SAM-2 does")
    ids = arrays.get("", np.zeros(0))
    if ids.ndim != 2 or not ids.size or ids.dtype.kind not in "iu":
        found = f"{ids.dtype} of shape {ids.shape}" if "" in arrays else "an archive"
        raise InputError(
            f"{path} holds {found}; expected integer ids, (height, width), as Grounded-SAM-2 "
            "writes them."
        )
    ids = ids.astype(np.int64)
    if ids.min(initial=0) < 0 or ids.max(initial=0) >= LARGEST_ID:
        raise InputError(
            f"{path} has ids from {ids.min()} to {ids.max()}; expected 0 to {LARGEST_ID - 1}, "
            "where 0 means no object."
        )
    return ids


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


class _Found(BaseModel):
    class_name: str
    segmentation: Any


class _Picture(BaseModel):
    image_path: str
    annotations: list[_Found]
    img_width: int = Field(ge=1)
    img_height: int = Field(ge=1)


class GroundedSam2Images(MaskFormat):
    """Ids of single images: the JSON that a demo writes for each picture, in `json_data/`.

    The key `image_path` identifies the frame; the JSON's file name does not matter.
    """

    name = "grounded-sam2"
    title = f"Grounded-SAM-2 of single images ({LABELS}/)"
    tracked = False

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        return [] if GroundedSam2.find(folder) else list_files(folder / LABELS, "*.json")

    @cached_property
    def frames(self) -> dict[str, FrameMask]:
        frames: dict[str, FrameMask] = {}
        count = 0
        for path in self.find(self.folder):
            where = f"{path} (there is no {MASKS}/{PREFIX}*.npy, so it is read as a single image's)"
            picture = checked(_Picture, read_json(path), where)
            frame = SegmentedFrame((picture.img_height, picture.img_width), str(path))
            for row in picture.annotations:
                count += 1
                frame.add(count, row.class_name, row.segmentation, f"annotation {len(frame.masks)}")
            frame.put(frames, picture.image_path)
        return frames
