"""Damaged shards: read, or refused in one sentence that names file and room."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from mutating import MUTATIONS, assert_one_sentence, damaged_bytes
from toy_rooms import LABEL_SET, make_toy_room, write_shard

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shard(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "a.h5"
    rng = np.random.default_rng(0)
    write_shard(path, LABEL_SET, [make_toy_room(f"toy/{k}", rng) for k in range(2)])
    return path.read_bytes()


def read_all(path: Path) -> None:
    """Everything that a shard is asked for."""
    from sceneprior.core.dataset import FlatViews
    from sceneprior.core.shards import Shard

    with Shard(path) as opened:
        for room_id in opened.room_ids:
            views = opened.read_room(room_id, images=True)
            opened.read_room(room_id)
            opened.read_instance_ids(room_id, range(len(views.visible)), step=4)
            opened.read_checksum(room_id)
            if opened.has_ground_truth(room_id):
                opened.read_ground_truth(room_id)
            FlatViews.of([views])


def check(path: Path) -> None:
    """Result of `inspect --verify` for a shard."""
    from data_prep.inspection.verify import verify

    verify(path.parent.parent)


def _change(group: h5py.Group, name: str, rng: np.random.Generator) -> None:
    """Damage one dataset of a room: its type, shape, values, or the whole of it."""
    old = group[name][()]
    del group[name]
    match int(rng.integers(9)):
        case 0:
            return
        case 1:
            group.create_dataset(name, data=old.astype(rng.choice(["f8", "i8", "u1", "S3", ">i2"])))
        case 2:
            group.create_dataset(name, data=old[..., :-1])
        case 3:
            group.create_dataset(name, data=old[None])
        case 4:
            huge = (2**40, *old.shape[1:])
            group.create_dataset(name, huge, old.dtype, chunks=(1, *old.shape[1:]))
        case 5:
            group.create_group(name)
        case 6:
            group.create_dataset(name, data="text")
        case 7:
            group.create_dataset(name, data=h5py.Empty(old.dtype))
        case _:
            new = old.copy()
            odd = [np.nan, np.inf, -1e30] if old.dtype.kind == "f" else [-1, 99, 30_000]
            with np.errstate(all="ignore"):
                new.flat[rng.integers(0, max(1, old.size), 3)] = np.array(rng.choice(odd)).astype(
                    old.dtype
                )
            group.create_dataset(name, data=new)


def _change_attribute(group: h5py.Group, name: str, rng: np.random.Generator) -> None:
    odd = [1, -1.5, np.nan, "", "text\n", b"\xff\xfe", [1, 2, 3], np.zeros((2, 2)), "[1, {}]"]
    del group.attrs[name]
    if rng.random() < 0.9:
        group.attrs[name] = odd[rng.integers(len(odd))]


def restructured(path: Path, rng: np.random.Generator) -> None:
    """Damage what is in a shard, in a way that HDF5 itself does not notice."""
    with h5py.File(path, "r+") as file:
        rooms = list(file["rooms"].values())
        room = rooms[rng.integers(len(rooms))]
        group = room["ground_truth"] if rng.random() < 0.3 else room
        where = rng.random()
        if where < 0.1:
            _change_attribute(file, str(rng.choice(list(file.attrs))), rng)
        elif where < 0.3:
            _change_attribute(group, str(rng.choice(list(group.attrs))), rng)
        elif where < 0.33:
            del file["rooms"]
        else:
            names = [name for name in group if name != "ground_truth"]
            _change(group, str(rng.choice(names)), rng)


@pytest.mark.parametrize("function", ["read_all", "check"])
@pytest.mark.parametrize("what", ["bytes", "structure"])
def test_damaged_shards_are_read_or_refused_in_one_sentence(shard, tmp_path, what, function):
    rng = np.random.default_rng(1)
    paths = []
    for number in range(MUTATIONS):
        path = tmp_path / f"{number}" / "train" / "a.h5"
        path.parent.mkdir(parents=True)
        path.write_bytes(damaged_bytes(shard, rng) if what == "bytes" else shard)
        if what == "structure":
            restructured(path, rng)
        (path.parent.parent / "index.json").write_text(json.dumps({"label_set": LABEL_SET}))
        paths.append(path)
    said = assert_one_sentence(__file__, function, paths)
    for path, sentence in zip(paths, said, strict=True):
        assert not sentence or str(tmp_path) in sentence, (path, sentence)
    if function == "read_all":
        refused = [sentence for sentence in said if sentence]
        assert all(sentence.startswith("ShardError: ") for sentence in refused)
        assert len(refused) > MUTATIONS / 4
        if what == "structure":
            assert sum("room toy/" in sentence for sentence in refused) > MUTATIONS / 3
