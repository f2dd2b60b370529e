"""Models are read once a process, and memory stays within the budget."""

import os

from data_prep.engine.cache import ByteCache
from data_prep.front.models import ModelBank


def test_what_was_used_longest_ago_goes_first():
    loads = []

    def get(key, size=40):
        return cache.get(key, lambda: loads.append(key) or b"x" * size)

    cache = ByteCache[bytes](100, len)
    get("a"), get("b"), get("a")
    assert loads == ["a", "b"] and cache.used_bytes == 80
    get("c")  # b goes
    get("a"), get("b")
    assert loads == ["a", "b", "c", "b"] and cache.used_bytes == 80 and len(cache) == 2
    assert len(get("huge", 101)) == 101 and len(cache) == 2
    get("whole", 100)
    assert len(cache) == 1 and cache.used_bytes == 100


def test_what_cannot_be_loaded_is_not_remembered():
    cache = ByteCache[bytes](100, len)
    for _ in range(2):
        try:
            cache.get("a", lambda: {}["nothing"])
        except KeyError:
            continue
        raise AssertionError
    assert cache.get("a", lambda: b"now") == b"now"


def test_a_model_is_read_once_and_again_when_it_changes(front, monkeypatch):
    from data_prep.front import models

    reads = []
    monkeypatch.setattr(
        models, "read_obj", lambda path, read=models.read_obj: reads.append(path) or read(path)
    )
    bank = ModelBank(front.future)
    assert bank.load("bed") is bank.load("bed") and len(reads) == 1
    path = front.future / "bed" / "raw_model.obj"
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1_000_000))
    bank.load("bed")
    assert len(reads) == 2
    small = ModelBank(front.future, cache_bytes=300)  # a box is 8 vertices and 12 faces: 240 bytes
    small.load("bed"), small.load("stand"), small.load("bed")
    assert len(reads) == 5
