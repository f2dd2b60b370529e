"""Reads masks as one PNG of ids per frame, with a table of classes."""

from functools import cached_property
from pathlib import Path

import numpy as np

from data_prep.readers.posed.labels import TABLES, find_table
from data_prep.readers.posed.mask_format import MaskFormat
from data_prep.readers.posed.recording import INSTANCES, PosedFrame
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import mask_size, read_class_table, read_mask


class IdPngs(MaskFormat):
    """PNGs whose values are ids. The classes are in the room's table or, for ids of single frames,
    in a JSON beside each PNG with the same stem, in any form of `read_class_table`."""

    name = "png"
    title = "PNGs of ids (instances/)"

    @classmethod
    def find(cls, folder: Path) -> list[Path]:
        inside = folder / INSTANCES
        return sorted(inside.rglob("*.png")) + sorted(inside.rglob("*.json"))

    @property
    def tracked(self) -> bool:
        """False if the classes are beside each PNG and the room has no table."""
        beside = (self.folder / INSTANCES).rglob("*.json")
        return any((self.folder / name).is_file() for name in TABLES) or not any(beside)

    def has(self, frame: PosedFrame) -> bool:
        return frame.instances.is_file()

    def wanted(self, frame: PosedFrame) -> str:
        return str(frame.instances)

    def size(self, frame: PosedFrame) -> tuple[int, int]:
        return mask_size(frame.instances)

    def read(self, frame: PosedFrame) -> np.ndarray:
        return read_mask(frame.instances)

    @cached_property
    def _table(self) -> dict[int, str]:
        return read_class_table(find_table(self.folder))

    def classes(self) -> dict[int, str]:
        return self._table

    def frame_classes(self, frame: PosedFrame) -> dict[int, str]:
        own = frame.instances.with_suffix(".json")
        if own.is_file():
            return read_class_table(own)
        try:
            return self._table
        except InputError as error:
            raise InputError(
                f"{str(error).removesuffix('.')}; or put the classes of a frame's ids into "
                f"{own.name} beside its PNG."
            ) from None
