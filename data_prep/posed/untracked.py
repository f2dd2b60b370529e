"""Reads masks whose ids have no meaning across frames, and finds the objects that they show."""

from pathlib import Path

import numpy as np

from data_prep.posed.labels import find_table
from data_prep.posed.masks import MaskPixels
from data_prep.posed.panoptic import FILE_NAME as PANOPTIC
from data_prep.posed.panoptic import read_panoptic
from data_prep.posed.recording import PosedFrame
from data_prep.tracks.associate import UNKNOWN, FrameMasks, Tracks, associate
from sceneprior.core.classes import VOID
from sceneprior.core.errors import InputError
from sceneprior.core.instances.pngs import read_mask
from sceneprior.core.instances.tables import LARGEST_ID, IdTable, read_class_table


class UntrackedMasks:
    """Masks of one room with ids and classes of single frames, and notes about them.

    A frame's classes are in a JSON of the same stem beside its PNG, in any form of
    `read_class_table`, or else in the room's table.
    """

    def __init__(
        self, folder: Path, label_set_name: str, size: tuple[int, int], stored: tuple[int, int]
    ):
        self._folder, self._label_set = folder, label_set_name
        self._table: dict[int, str] | None = None
        self._panoptic = None
        if (folder / PANOPTIC).is_file():
            self._panoptic = read_panoptic(find_table(folder), label_set_name, tracked=False)
        self.notes: list[str] = []
        read = read_mask if self._panoptic is None else self._panoptic.read
        self._pixels = MaskPixels(read, size, stored)

    def read(self, frames: list[PosedFrame]) -> tuple[FrameMasks, np.ndarray, np.ndarray]:
        """Masks of all frames, the ids that they had, (masks,), and intrinsics, (frames, 3, 3)."""
        images, lenses = (
            np.stack(arrays)
            for arrays in zip(*(self._pixels.read(frame) for frame in frames), strict=True)
        )
        numbers = np.where(images < 0, -1, 0)
        of_number: dict[int, str] = {}
        had, unlisted = [0], 0
        for image, number, frame in zip(images, numbers, frames, strict=True):
            names = self._classes(frame)
            for k in np.unique(image[image > 0]).tolist():
                if k not in names:
                    number[image == k] = -1
                    unlisted += 1
                    continue
                of_number[len(had)] = names[k]
                number[image == k] = len(had)
                had.append(k)
        if len(had) > LARGEST_ID:
            raise InputError(
                f"{self._folder} has {len(had) - 1} masks, expected at most {LARGEST_ID - 1}; use "
                "fewer frames (--max-views)."
            )
        table = IdTable(of_number, self._label_set, str(self._folder))
        ids = table.ids(numbers).astype(np.int32)
        # The table's last entry is what has no class: unknown, but something may be there.
        ids[ids == len(table.classes)] = UNKNOWN
        kept = np.unique(ids[ids > 0])
        back = np.zeros(len(table.classes) + 1, dtype=np.int32)
        back[kept] = np.arange(1, len(kept) + 1)
        of_mask = np.zeros(len(kept) + 1, dtype=np.int64)
        of_mask[back[ids[ids > 0]]] = numbers[ids > 0]
        ids = np.where(ids > 0, back[np.maximum(ids, 0)], ids)
        self.notes += table.notes + self._pixels.notes
        if unlisted:
            self.notes.append(f"{unlisted} masks have no class in their frame's table: void")
        masks = FrameMasks(ids, table.classes[kept - 1].astype(np.int64))
        return masks, np.array(had)[of_mask[1:]], lenses

    def _classes(self, frame: PosedFrame) -> dict[int, str]:
        """Class of each id of a frame."""
        if self._panoptic is not None:
            return self._panoptic.of_frame.get(frame.instances.stem, {})
        own = frame.instances.with_suffix(".json")
        if own.is_file():
            return read_class_table(own)
        if self._table is None:
            try:
                self._table = read_class_table(find_table(self._folder))
            except InputError as error:
                raise InputError(
                    f"{str(error).removesuffix('.')}, or {own.name} beside a PNG that of a frame."
                ) from None
        return self._table


def track(
    masks: FrameMasks, given: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Images of object ids and classes for `observe`, and a note on the objects found."""
    tracks: Tracks = associate(masks, world_to_camera, intrinsics, given)
    count = len(tracks.object_class)
    images = np.where(tracks.ids < 0, count + 1, tracks.ids).astype(np.uint32)
    note = f"{count} objects are found from {len(given)} masks (--tracks auto)"
    return images, np.array([*tracks.object_class, VOID]), note
