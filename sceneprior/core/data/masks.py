"""Compressed in-memory store of a split's downsampled instance-id images."""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from zlib_ng import zlib_ng

from sceneprior.core.shards import Shard

_OPEN_SHARDS = 32


class MaskStore:
    """Instance-id images of a split, downsampled by `step`, read on first use and kept compressed.

    Images of ids consist of large uniform areas: a view of 480 x 360 pixels, downsampled by 4, has
    10,800 pixels and takes about 400 bytes compressed, so 100,000 views take 40 MB. Decompressing a
    view takes a twentieth of the time of reading it from the shard again.
    """

    def __init__(self, rooms: Sequence[tuple[Path, str]], step: int):
        self.rooms, self.step = tuple(rooms), step
        self._packed: dict[int, dict[int, bytes]] = {}
        self._forms: dict[int, tuple[tuple[int, ...], np.dtype]] = {}
        self._shards: OrderedDict[Path, Shard] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        # Open files cannot be pickled; each worker process opens its own.
        return {**self.__dict__, "_shards": OrderedDict()}

    def read(self, room: int, views: np.ndarray) -> np.ndarray:
        """Read images of a room: (views, H/step, W/step), 0 = background, k + 1 = object k."""
        packed = self._packed.setdefault(room, {})
        wanted = views.tolist()
        missing = sorted(set(wanted).difference(packed))
        if missing:
            path, room_id = self.rooms[room]
            images = self._shard(path).read_instance_ids(room_id, missing, self.step)
            self._forms[room] = images.shape[1:], images.dtype
            for view, image in zip(missing, images, strict=True):
                # Level 6 would save another third of the memory but take twice the time.
                packed[view] = zlib_ng.compress(image, 3)
        shape, dtype = self._forms[room]
        plain = b"".join(zlib_ng.decompress(packed[view]) for view in wanted)
        return np.frombuffer(plain, dtype).reshape(-1, *shape)

    def _shard(self, path: Path) -> Shard:
        if path in self._shards:
            self._shards.move_to_end(path)
        else:
            self._shards[path] = Shard(path)
            if len(self._shards) > _OPEN_SHARDS:
                self._shards.popitem(last=False)[1].close()
        return self._shards[path]
