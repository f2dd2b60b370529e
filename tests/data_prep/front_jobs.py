"""Small jobs on small data sets, and what lies on disk after them."""

import hashlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
from front_files import FrontFolder, bedroom, four_models

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from sceneprior.core.shard_writing import room_checksum
from sceneprior.core.shards import Shard

SMALL = ("views.image_size=[90, 120]", "views.per_m2=0.5", "views.min_object_pixels=20")


def front_job(front: FrontFolder, out: Path, **changes: Any) -> Job:
    """A job on small images; `changes` are fields of FrontSource or Job, or more `rules`."""
    recipe = load_recipe("bedroom", (*SMALL, *changes.pop("rules", ())))
    names = {item.name for item in fields(FrontSource)}
    of_source = {name: changes.pop(name) for name in list(changes) if name in names}
    source = FrontSource(front.front, front.future, **{"recipe": recipe, **of_source})
    return Job(source, out, **{"renderer": "software", **changes})


def three_houses(front: FrontFolder) -> None:
    """Six bedrooms."""
    for k in range(3):
        front.house(f"house{k}", bedroom(f"Bedroom-{k}"), bedroom(f"MasterBedroom-{k}"))


def bedroom_shards(folder: Path, *rules: str) -> None:
    """Shards of one bedroom."""
    front = four_models(folder.parent / f"{folder.name}.data")
    front.house("house", bedroom("Bedroom-0"))
    build_shards(front_job(front, folder, rules=rules, only="house"))


def six_bedrooms_shards(folder: Path, *rules: str) -> None:
    front = four_models(folder.parent / f"{folder.name}.data")
    three_houses(front)
    build_shards(front_job(front, folder, rules=rules))


def homes_shards(folder: Path, rooms: int, *rules: str, seed: int = 0) -> None:
    """Shards of bedrooms made from a seed."""
    data = folder.parent / f"{folder.name}.data"
    make_homes(data, rooms, "bedroom", seed)
    source = FrontSource(data / "3D-FRONT", data / "3D-FUTURE-model", load_recipe("bedroom", rules))
    build_shards(Job(source, folder, renderer="software"))


def digests(folder: Path, *patterns: str) -> dict[str, str]:
    """Path -> SHA-256 of every file (that matches)."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for pattern in patterns or ("**/*",)
        for path in sorted(folder.glob(pattern))
        if path.is_file()
    }


def rooms_of(folder: Path) -> dict[str, Any]:
    """Room id -> (views with images, ground truth)."""
    found = {}
    for split in ("train", "val", "test"):
        for path in sorted((folder / split).glob("*.h5")):
            with Shard(path) as shard:
                for room_id in shard.room_ids:
                    truth = shard.read_ground_truth(room_id)
                    found[room_id] = (shard.read_room(room_id, images=True), truth)
    return found


def change_room(
    path: Path, change: Callable[[Any], None], number: int = 0, seal: bool = True
) -> str:
    """Change one room of a shard, and its checksum with it; its id."""
    with h5py.File(path, "a") as file:
        group = list(file["rooms"].values())[number]
        change(group)
        room_id = group.attrs["room_id"].decode()
    if seal:
        with Shard(path) as shard:
            views = shard.read_room(room_id, images=True)
            known = shard.has_ground_truth(room_id)
            truth = shard.read_ground_truth(room_id) if known else None
            checksum = room_checksum(views, truth)
        with h5py.File(path, "a") as file:
            list(file["rooms"].values())[number].attrs["sha256"] = checksum
    return room_id
