"""Reads masks whose ids are inconsistent across frames, and finds the objects that they show."""

import numpy as np

from data_prep.readers.posed.mask_format import MaskFormat
from data_prep.readers.posed.masks import MaskPixels
from data_prep.readers.posed.recording import PosedFrame
from data_prep.tracks.associate import UNKNOWN, FrameMasks, Tracks, associate
from sceneprior.core.classes import VOID
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import LARGEST_ID, IdTable


class UntrackedMasks:
    """Reads the masks of one room, whose ids and classes belong to single frames."""

    def __init__(self, masks: MaskFormat, size: tuple[int, int], stored: tuple[int, int]):
        self._masks = masks
        self.notes: list[str] = []
        self._pixels = MaskPixels(masks, size, stored)

    def read(
        self, frames: list[PosedFrame]
    ) -> tuple[FrameMasks, np.ndarray, np.ndarray, np.ndarray]:
        """Masks of all frames, their original ids, (masks,), the stuff in all frames, and
        intrinsics, (frames, 3, 3)."""
        images, intrinsics = (
            np.stack(arrays)
            for arrays in zip(*(self._pixels.read(frame) for frame in frames), strict=True)
        )
        numbers = np.where(images < 0, -1, 0)
        class_names: dict[int, str] = {}
        original_ids, unlisted = [0], 0
        for image, number, frame in zip(images, numbers, frames, strict=True):
            names = self._masks.frame_classes(frame)
            for k in np.unique(image[image > 0]).tolist():
                if k not in names:
                    number[image == k] = -1
                    unlisted += 1
                    continue
                class_names[len(original_ids)] = names[k]
                number[image == k] = len(original_ids)
                original_ids.append(k)
        if (count := len(original_ids)) > LARGEST_ID:
            raise InputError(
                f"{self._masks.folder} has {count - 1} masks, expected at most {LARGEST_ID - 1}; "
                "use fewer frames (--max-views)."
            )
        table = IdTable(class_names, self._masks.label_set_name, str(self._masks.folder))
        ids = table.ids(numbers).astype(np.int32)
        # The table's last id stands for masks without a class, whose content is unknown.
        ids[ids == len(table.classes)] = UNKNOWN
        kept = np.unique(ids[ids > 0])
        new_id = np.zeros(len(table.classes) + 1, dtype=np.int32)
        new_id[kept] = np.arange(1, len(kept) + 1)
        number_of_id = np.zeros(len(kept) + 1, dtype=np.int64)
        number_of_id[new_id[ids[ids > 0]]] = numbers[ids > 0]
        ids = np.where(ids > 0, new_id[np.maximum(ids, 0)], ids)
        self.notes += table.notes + self._pixels.notes
        if unlisted:
            self.notes.append(f"{unlisted} masks have no class in their frame's table: void")
        masks = FrameMasks(ids, table.classes[kept - 1].astype(np.int64))
        return masks, np.array(original_ids)[number_of_id[1:]], table.stuff(numbers), intrinsics


def track(
    masks: FrameMasks, given: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Images of object ids and the objects' classes, as `observe` reads them, and a note on the
    number of objects found."""
    tracks: Tracks = associate(masks, world_to_camera, intrinsics, given)
    count = len(tracks.object_class)
    images = np.where(tracks.ids < 0, count + 1, tracks.ids).astype(np.uint32)
    note = f"{count} objects are found from {len(given)} masks (--tracks auto)"
    return images, np.array([*tracks.object_class, VOID]), note
