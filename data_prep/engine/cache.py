"""What was read last, up to so many bytes: a key and a way to load it in, the loaded thing out."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Item = TypeVar("Item")


class ByteCache(Generic[Item]):
    """Keeps what was used last within a budget of bytes; what was used longest ago goes first.

    Not for several threads: a worker process does one room at a time.

    Args:
        limit_bytes: The budget. An item larger than all of it is handed out and not kept.
        size_of: Bytes of an item.
    """

    def __init__(self, limit_bytes: int, size_of: Callable[[Item], int]):
        self.limit_bytes = limit_bytes
        self.used_bytes = 0
        self._size_of = size_of
        self._items: OrderedDict[Hashable, Item] = OrderedDict()

    def __len__(self) -> int:
        return len(self._items)

    def get(self, key: Hashable, load: Callable[[], Item]) -> Item:
        """The item of this key, loaded if it is not here. What `load` raises is not remembered."""
        if key in self._items:
            self._items.move_to_end(key)
            return self._items[key]
        item = load()
        size = self._size_of(item)
        if size <= self.limit_bytes:
            self._items[key] = item
            self.used_bytes += size
        while self.used_bytes > self.limit_bytes:
            _, oldest = self._items.popitem(last=False)
            self.used_bytes -= self._size_of(oldest)
        return item
