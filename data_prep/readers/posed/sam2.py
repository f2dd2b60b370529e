"""Reads SAM 2's masks of videos with one folder per object: `<object:03d>/<frame>.png`.

Source: `save_masks_to_dir` of `tools/vos_inference.py` in facebookresearch/sam2, which writes them
with `--per_obj_png_file`. SA-V has the same layout.
"""

import re
from functools import cached_property
from pathlib import Path

import numpy as np

from data_prep.readers.posed.labels import find_table
from data_prep.readers.posed.mask_format import MaskFormat, instead
from data_prep.readers.posed.recording import PosedFrame
from sceneprior.core.coco import paint
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import LARGEST_ID, mask_size, read_class_table, read_mask

PLACES = ("masks", ".")
"""Possible parents of the objects' folders, within a room's folder."""


class ObjectFolders(MaskFormat):
    """One folder per object, whose number is the id; a pixel above 0 shows the object.

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

    def _masks(self, frame: PosedFrame) -> dict[int, Path]:
        numbers = self._stems[frame.stem]
        return {number: self._objects[number] / f"{frame.stem}.png" for number in numbers}

    def has(self, frame: PosedFrame) -> bool:
        return frame.stem in self._stems

    def wanted(self, frame: PosedFrame) -> str:
        return f"{min(self._objects.values())}/{frame.stem}.png{instead(self._stems)}"

    def size(self, frame: PosedFrame) -> tuple[int, int]:
        return mask_size(next(iter(self._masks(frame).values())))

    def read(self, frame: PosedFrame) -> np.ndarray:
        size = self.size(frame)
        masks = {}
        for number, path in self._masks(frame).items():
            masks[number] = read_mask(path) > 0
            if masks[number].shape != size:
                came = masks[number].shape
                raise InputError(
                    f"{path} is {came[1]} x {came[0]} pixels, but the masks of other objects "
                    f"{size[1]} x {size[0]}; write all masks at the size of the pictures."
                )
        return paint(masks.items(), size)

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
