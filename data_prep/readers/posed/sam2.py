"""Reads the masks of SAM 2's videos and of Grounded-SAM-2's trackers.

Source: `save_masks_to_dir` of `tools/vos_inference.py` in facebookresearch/sam2, which writes them
with `--per_obj_png_file`, and SA-V, which has the same layout;
`grounded_sam2_tracking_demo_with_continuous_id.py` and `utils/mask_dictionary_model.py` in
IDEA-Research/Grounded-SAM-2.
"""

import re
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from data_prep.readers.posed.masks import FrameMask, MaskFormat, instead, main_classes
from data_prep.readers.posed.pngs import find_table
from data_prep.readers.posed.recording import PosedFrame
from sceneprior.core.checked import checked, plain
from sceneprior.core.coco import paint
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.id_tables import LARGEST_ID, mask_size, read_class_table, read_mask

MASKS, LABELS, PREFIX = "mask_data", "json_data", "mask_"
"""Folders of Grounded-SAM-2's ids and classes, and the beginning of their files' names."""
PLACES = ("masks", ".")
"""Possible parents of the objects' folders, within a room's folder."""


class ObjectFolders(MaskFormat):
    """One folder per object (`<object:03d>/<frame>.png`), whose number is the id; a pixel above 0
    shows the object.

    SAM 2 knows no classes: they are in the room's table of classes. Masks may overlap (`paint`).
    """

    name = "sam2"
    title = "SAM 2 (a folder per object)"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        return [path for place in _object_folders(folder) for path in sorted(place.glob("*.png"))]

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
    def _stems(self) -> dict[str, list[int]]:
        """Ids of the objects that have a mask in each frame, by the frame's stem."""
        stems: dict[str, list[int]] = {}
        for number, folder in sorted(self._objects.items()):
            for path in folder.glob("*.png"):
                stems.setdefault(path.stem, []).append(number)
        return stems

    def of(self, frame: PosedFrame) -> FrameMask | None:
        numbers = self._stems.get(frame.stem, [])
        paths = {number: self._objects[number] / f"{frame.stem}.png" for number in numbers}
        if not paths:
            return None
        size = partial(mask_size, next(iter(paths.values())))
        return FrameMask(size, lambda: _painted(paths, size()), self.classes)

    def wanted(self, frame: PosedFrame) -> str:
        return f"{min(self._objects.values())}/{frame.stem}.png{instead(self._stems)}"

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
            for path in sorted((room / place).glob("[0-9]*"))
            if re.fullmatch("[0-9]{1,9}", path.name) and any(path.glob("*.png"))
        ]
        if folders:
            return folders
    return []


def _painted(paths: dict[int, Path], size: tuple[int, int]) -> np.ndarray:
    """Ids of a frame, (height, width), from the PNG of each object."""
    masks = {}
    for number, path in paths.items():
        masks[number] = read_mask(path) > 0
        if masks[number].shape != size:
            came = masks[number].shape
            raise InputError(
                f"{path} is {came[1]} x {came[0]} pixels, but the masks of other objects "
                f"{size[1]} x {size[0]}; write all masks at the size of the pictures."
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
        masks = sorted((folder / MASKS).glob(f"{PREFIX}*.npy"))
        return [*masks, *sorted((folder / LABELS).glob(f"{PREFIX}*.json"))] if masks else []

    def _path(self, frame: PosedFrame) -> Path:
        return self.folder / MASKS / f"{PREFIX}{frame.stem}.npy"

    def of(self, frame: PosedFrame) -> FrameMask | None:
        path = self._path(frame)
        if not path.is_file():
            return None
        labels = self.folder / LABELS / f"{PREFIX}{frame.stem}.json"
        return FrameMask(
            lambda: _open(path).shape, partial(_read_ids, path), partial(_labels, labels)
        )

    def wanted(self, frame: PosedFrame) -> str:
        there = (path.stem for path in (self.folder / MASKS).glob(f"{PREFIX}*.npy"))
        return f"{self._path(frame)}{instead(there)}"

    def classes(self) -> dict[int, str]:
        paths = sorted((self.folder / LABELS).glob(f"{PREFIX}*.json"))
        classes, self.notes = main_classes(map(_labels, paths))
        if not classes:
            raise InputError(
                f"{self.folder / LABELS} names no class; expected {PREFIX}<frame>.json for each "
                f"mask of {MASKS}, as Grounded-SAM-2 writes them."
            )
        return classes


def _read_ids(path: Path) -> np.ndarray:
    """Ids of a frame, (height, width) int64."""
    ids = np.array(_open(path)).astype(np.int64)
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
