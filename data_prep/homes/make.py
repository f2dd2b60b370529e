"""Makes a data set of furnished homes from a seed."""

import shutil
import uuid
from pathlib import Path
from zlib import crc32

import numpy as np
from rich.console import Console
from rich.progress import track

from data_prep.homes.bedroom import BEDROOM, BEDS
from data_prep.homes.furnish import furnish
from data_prep.homes.layout import Layout
from data_prep.homes.living import LIVING_ROOM
from data_prep.homes.write import (
    PlacedRoom,
    house_json,
    model_record,
    write_compact_json,
    write_model,
)
from sceneprior.core.errors import InputError
from sceneprior.core.files import only_writer
from sceneprior.furniture.catalog import Catalog, make_catalog

ROOM_TYPES = {"bedroom": BEDROOM, "living": LIVING_ROOM}

ROOMS_IN_HOUSE = {1: 0.75, 2: 0.13, 3: 0.08, 4: 0.04}
"""Share of houses per number of rooms."""

TEST_SHARE, VAL_SHARE = 0.2, 0.1
"""Shares of all rooms. With fewer than about fifty test rooms, results vary more between test sets
than between methods; the remaining 70% suffice for training."""

_GOLDEN = (5**0.5 - 1) / 2


def make_homes(out: Path, rooms: int, room_type: str, seed: int) -> None:
    """Write furnished homes and their furniture in the layout of 3D-FRONT and 3D-FUTURE.

        OUT/3D-FRONT/<house uid>.json
        OUT/3D-FUTURE-model/<jid>/raw_model.obj, OUT/3D-FUTURE-model/model_info.json
        OUT/splits/<room type>.csv    rows `<house uid>_<room instanceid>,train|val|test`

    The same arguments write the same bytes, and room k does not depend on `rooms`. The folder must
    be new or empty, and appears only when it is complete.
    """
    out = Path(out).expanduser().absolute()
    _check(out, rooms, room_type, seed)
    staging = out.with_name(f".{out.name}.partial")
    with only_writer(out):
        _check(out, rooms, room_type, seed)  # again: another process may have finished just now
        try:
            shutil.rmtree(staging, ignore_errors=True)  # left by a process that was killed
            staging.mkdir()
            _write(staging, rooms, room_type, seed)
            staging.replace(out)
        except OSError as error:
            error.filename = error.filename or str(out)
            raise
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def _check(out: Path, rooms: int, room_type: str, seed: int) -> None:
    if room_type not in ROOM_TYPES:
        raise InputError(
            f"No room type is called '{room_type}'; choose one of {', '.join(ROOM_TYPES)}."
        )
    if rooms < 2:
        raise InputError(
            f"Expected at least 2 rooms, one to train on and one to test on, but got {rooms}; "
            f"try --rooms 400."
        )
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; choose a new folder for the homes.")
    if out.exists() and any(out.iterdir()):
        raise InputError(
            f"{out} already holds files; choose another folder, such as {out}_{room_type}_{seed}."
        )


def _write(folder: Path, rooms: int, room_type: str, seed: int) -> None:
    catalog = make_catalog(seed, ROOM_TYPES[room_type].label_set)
    for name in ("3D-FRONT", "3D-FUTURE-model", "splits"):
        (folder / name).mkdir()
    models = [model for variants in catalog.values() for model in variants]
    console = Console(stderr=True)
    for model in track(models, "Building furniture", console=console, transient=True):
        write_model(folder / "3D-FUTURE-model", model)
    write_compact_json(
        folder / "3D-FUTURE-model" / "model_info.json", [model_record(m) for m in models]
    )
    contents: dict[str, list[str]] = {}
    houses = _houses(rooms, room_type, seed)
    for house, numbers in enumerate(
        track(houses, "Furnishing homes", console=console, transient=True)
    ):
        uid = str(uuid.uuid5(uuid.NAMESPACE_OID, f"sceneprior homes {seed} {room_type} {house}"))
        placed = _house(catalog, room_type, seed, house, numbers)
        write_compact_json(folder / "3D-FRONT" / f"{uid}.json", house_json(uid, placed))
        for room in placed:
            names = sorted(piece.model.name for piece in room.layout.pieces)
            contents[f"{uid}_{room.instanceid}"] = names
    _write_split(folder / "splits" / f"{room_type}.csv", contents, seed)


def _seeded(seed: int, *stream: int | str) -> np.random.Generator:
    """Random generator of one stream, so that room 7 is the same in any number of rooms."""
    words = [crc32(str(word).encode()) for word in stream]
    return np.random.default_rng(np.random.SeedSequence([seed, *words]))


def _houses(rooms: int, room_type: str, seed: int) -> list[range]:
    """Split the room numbers into houses."""
    rng = _seeded(seed, room_type, "houses")
    houses: list[range] = []
    first = 0
    while first < rooms:
        count = int(rng.choice(list(ROOMS_IN_HOUSE), p=list(ROOMS_IN_HOUSE.values())))
        houses.append(range(first, min(first + count, rooms)))
        first += count
    return houses


def _house(
    catalog: Catalog, room_type: str, seed: int, house: int, numbers: range
) -> list[PlacedRoom]:
    rng = _seeded(seed, room_type, "house", house)
    x, z = (round(float(value), 2) for value in rng.uniform(-4, 4, 2))
    # Multiples of the golden ratio spread the rooms evenly over the histogram of counts, so
    # that a few hundred follow it as closely as thousands of independent draws would.
    start = _seeded(seed, room_type, "counts").random()
    placed: list[PlacedRoom] = []
    for number in numbers:
        share = (start + number * _GOLDEN) % 1.0
        own = _seeded(seed, room_type, "room", number)
        layout = furnish(ROOM_TYPES[room_type], catalog, own, share)
        kind = _kind(layout, {room.kind for room in placed})
        placed.append(PlacedRoom(layout, kind, f"{kind}-{1000 + number}", x, z))
        x = round(x + layout.width + float(rng.uniform(0.3, 1.0)), 2)
    return placed


def _kind(layout: Layout, taken: set[str]) -> str:
    """The room's type in 3D-FRONT; a house has at most one master bedroom."""
    names = {piece.model.name for piece in layout.pieces}
    if not names & set(BEDS):
        dining = any(p.model.name == "table" and p.model.size_m[0] > 1.0 for p in layout.pieces)
        return "LivingDiningRoom" if dining else "LivingRoom"
    if "kids_bed" in names:
        return "Bedroom"
    master = "double_bed" in names and "MasterBedroom" not in taken
    return "MasterBedroom" if master else "SecondBedroom"


def _write_split(path: Path, contents: dict[str, list[str]], seed: int) -> None:
    """Split the rooms, stratified by bed, number of pieces and furniture.

    The rooms are sorted by these three. Every fifth room is a test room, and every eighth of the
    others a val room, so that a few dozen test rooms represent all rooms. For an unstratified draw
    of 51 from 512 bedrooms, the category KL to the training rooms was 0.05 nats.
    """

    def kind(room: str) -> tuple[list[str], int, list[str]]:
        names = contents[room]
        return [name for name in names if name in BEDS], len(names), names

    alike = sorted(contents, key=kind)
    start = _seeded(seed, "split").random()
    test = _evenly(alike, max(1, round(TEST_SHARE * len(alike))), start)
    others = [room for room in alike if room not in test]
    val = _evenly(others, round(VAL_SHARE * len(alike)), start)
    split = {room: "test" for room in test} | {room: "val" for room in val}
    rows = [f"{room},{split.get(room, 'train')}" for room in contents]
    path.write_text("\n".join(rows) + "\n")


def _evenly(rooms: list[str], count: int, start: float) -> set[str]:
    return {rooms[int((k + start) * len(rooms) / count)] for k in range(count)}
