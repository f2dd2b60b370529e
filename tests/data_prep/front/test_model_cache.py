"""Models are read once a process, and memory stays within the budget."""

import os

import pytest

from data_prep.front import models
from data_prep.front.models import ModelBank
from sceneprior.core.errors import InputError

BOX_BYTES = 240  # 8 vertices and 12 faces


@pytest.fixture
def reads(monkeypatch):
    """The models whose files were read, in order."""
    seen = []

    def noted(path, read=models.read_obj):
        seen.append(path.parent.name)
        return read(path)

    monkeypatch.setattr(models, "read_obj", noted)
    return seen


def test_what_was_used_longest_ago_goes_first(front, reads):
    for name in ("lamp", "desk"):
        front.model(name, "Desk", (1.0, 0.7, 0.5))
    bank = ModelBank(front.future, cache_bytes=2 * BOX_BYTES + 40)
    bank.load("bed"), bank.load("lamp"), bank.load("bed")
    assert reads == ["bed", "lamp"]
    bank.load("desk")  # the lamp goes
    bank.load("bed"), bank.load("lamp")
    assert reads == ["bed", "lamp", "desk", "lamp"]


def test_what_is_larger_than_the_budget_is_handed_out_and_not_kept(front, reads):
    bank = ModelBank(front.future, cache_bytes=BOX_BYTES - 1)
    assert len(bank.load("bed").faces) == len(bank.load("bed").faces) == 12
    assert reads == ["bed", "bed"]
    exact = ModelBank(front.future, cache_bytes=BOX_BYTES)
    assert exact.load("bed") is exact.load("bed") and len(reads) == 3


def test_what_cannot_be_loaded_is_not_remembered(front):
    bank, path = ModelBank(front.future), front.future / "bed" / "raw_model.obj"
    good = path.read_text()
    path.write_text("v 1 2")
    for _ in range(2):
        with pytest.raises(InputError, match="bed/raw_model"):
            bank.load("bed")
    path.write_text(good)
    assert len(bank.load("bed").faces) == 12


def test_a_model_is_read_once_and_again_when_it_changes(front, reads):
    bank = ModelBank(front.future)
    assert bank.load("bed") is bank.load("bed") and len(reads) == 1
    path = front.future / "bed" / "raw_model.obj"
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1_000_000))
    bank.load("bed")
    assert len(reads) == 2
