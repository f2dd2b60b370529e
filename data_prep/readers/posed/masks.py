"""Reads a room's masks of instance ids, undistorts and downsamples them."""

import numpy as np

from data_prep.readers.frames import mask_intrinsics, sampled_lines
from data_prep.readers.posed.lens import Lens, Straightened, straighten
from data_prep.readers.posed.mask_format import MaskFormat
from data_prep.readers.posed.recording import PosedFrame, frame_intrinsics
from sceneprior.core.checked import shown
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import IdTable, read_mask


class MaskPixels:
    """Reads the values of masks, all of one size, undistorted and downsampled.

    `size` is the (height, width) of all masks, and `stored` that of the downsampled images.
    """

    def __init__(self, masks: MaskFormat, size: tuple[int, int], stored: tuple[int, int]):
        self._masks, self._size, self._stored = masks, size, stored
        self._views: dict[tuple[Lens, bytes], Straightened] = {}

    @property
    def notes(self) -> list[str]:
        """Notes on the lenses straightened so far."""
        notes = []
        for lens in dict.fromkeys(lens for lens, _ in self._views):
            cut = max(view.cut_share for (other, _), view in self._views.items() if other == lens)
            notes.append(f"the lens {lens} is undistorted; {cut:.0%} of its pictures is cut away")
        return notes

    def read(self, frame: PosedFrame) -> tuple[np.ndarray, np.ndarray]:
        """Read a frame's values, int32 with -1 where unknown, and their intrinsics."""
        values = self._values(frame)
        K, picture = frame_intrinsics(frame, self._size)
        K = mask_intrinsics(K, picture, self._size, self._size)
        if not (lens := frame.camera.lens).is_straight:
            key = lens, K.tobytes()
            if key not in self._views:
                try:
                    self._views[key] = straighten(lens, K, self._size)
                except InputError as error:
                    raise InputError(f"frame {shown(frame.name)}: {error}") from None
            view = self._views[key]
            K, values = view.intrinsics, values[view.rows, view.columns]
        lines = [sampled_lines(*sides) for sides in zip(self._size, self._stored, strict=True)]
        sampled = mask_intrinsics(K, self._size, self._size, self._stored)
        return values[np.ix_(*lines)], sampled

    def _values(self, frame: PosedFrame) -> np.ndarray:
        """Read the ids of one frame, int32; -1 where they are unknown."""
        ids = self._masks.read(frame).astype(np.int32)
        size = self._size
        if ids.shape != size:
            raise InputError(
                f"the mask of frame {shown(frame.name)} is {ids.shape[1]} x {ids.shape[0]} pixels, "
                f"but the first frame's {size[1]} x {size[0]}; a room has one size"
            )
        if frame.known is not None:
            known = read_mask(frame.known)
            if known.shape != size:
                raise InputError(
                    f"{frame.known} is {known.shape[1]} x {known.shape[0]} pixels, but the ids "
                    f"{size[1]} x {size[0]}"
                )
            ids[known == 0] = -1
        return ids


class RoomMasks:
    """Masks of one room with tracked ids, and notes about them; see `MaskPixels`."""

    def __init__(self, masks: MaskFormat, size: tuple[int, int], stored: tuple[int, int]):
        self.table = IdTable(masks.classes(), masks.label_set_name, str(masks.folder))
        self._notes = masks.notes
        self._pixels = MaskPixels(masks, size, stored)

    @property
    def notes(self) -> list[str]:
        """Notes on everything left out or changed so far."""
        notes = [*self._notes, *self.table.notes]
        if self.table.unlisted:
            listed = ", ".join(map(str, sorted(self.table.unlisted)[:20]))
            notes.append(f"masks show ids that the table of classes does not have ({listed}): void")
        return notes + self._pixels.notes

    def read(self, frame: PosedFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Read a frame's uint32 ids for `observe` and its stuff, at the stored size, and their
        intrinsics."""
        values, intrinsics = self._pixels.read(frame)
        return self.table.ids(values), self.table.stuff(values), intrinsics
