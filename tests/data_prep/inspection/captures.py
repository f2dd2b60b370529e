"""Captures of made homes, as a user would bring them, and mistakes in their files."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from data_prep.readers.posed.reader import Posed
from sceneprior.core.classes import label_set
from sceneprior.core.shards import Shard, iterate_rooms, read_index

FLIP = np.diag([1.0, -1, -1, 1])
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From y up to z up."""


def make_captures(folder: Path, rooms: int = 6, seed: int = 0, views_per_m2: float = 0.8) -> None:
    """Posed rooms of made bedrooms: `transforms.json`, masks, classes; z up, metres."""
    data, shards = folder.parent / f"{folder.name}.homes", folder.parent / f"{folder.name}.front"
    make_homes(data, rooms, "bedroom", seed=seed)
    rules = (f"views.per_m2={views_per_m2}", "views.image_size=[90, 120]",
             "views.min_object_pixels=20")  # fmt: skip
    source = FrontSource(data / "3D-FRONT", data / "3D-FUTURE-model", load_recipe("bedroom", rules))
    build_shards(Job(source, shards, renderer="software"))
    write_captures(shards, folder)


def write_captures(shards: Path, folder: Path) -> None:
    """Rooms of shards as a user's captures."""
    names = label_set(read_index(shards)["label_set"])
    for split in ("train", "val", "test"):
        if any((shards / split).glob("*.h5")):
            for shard, room_id in iterate_rooms(shards, split):
                _write_room(shard, room_id, names, folder / room_id[-40:])


def _write_room(shard: Shard, room_id: str, names: tuple[str, ...], room: Path) -> None:
    views = shard.read_room(room_id, images=True)
    height, width = views.image_size
    (room / "instances").mkdir(parents=True)
    # The room stands elsewhere in the user's world.
    world = np.eye(4)
    world[:3, 3] = 1.3, -0.7, 0.0
    poses = world @ Z_UP @ np.linalg.inv(views.world_to_camera.astype(np.float64)) @ FLIP
    frames = []
    for k, (pose, ids) in enumerate(zip(poses, views.instance_ids, strict=True)):
        values = np.where(ids == len(views.object_class) + 1, 0, ids)
        Image.fromarray(values.astype(np.uint16)).save(room / f"instances/frame_{k + 1}.png")
        frames.append({"file_path": f"images/frame_{k + 1}.jpg", "transform_matrix": pose.tolist()})
    K = views.intrinsics[0].astype(float)
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height}
    (room / "transforms.json").write_text(json.dumps({**lens, "floor_m": 0.0, "frames": frames}))
    table = {str(k + 1): names[index] for k, index in enumerate(views.object_class)}
    (room / "classes.json").write_text(json.dumps(table))


def changed(folder: Path, target: Path, change: Callable[[Path, dict], None]) -> Path:
    """A copy of captures in which `change` changes each room's files, given its transforms.json."""
    shutil.copytree(folder, target)
    for room in sorted(target.iterdir()):
        data = json.loads((room / "transforms.json").read_text())
        change(room, data)
        if (room / "transforms.json").is_file():
            (room / "transforms.json").write_text(json.dumps(data))
    return target


def of_poses(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path, dict], None]:
    """A change of all matrices, (T, 4, 4), of a room."""

    def changes(room: Path, data: dict) -> None:
        matrices = np.array([frame["transform_matrix"] for frame in data["frames"]])
        for frame, matrix in zip(data["frames"], change(matrices.copy()), strict=True):
            frame["transform_matrix"] = matrix.tolist()

    return changes


def of_keys(**changes: Callable[[dict], float]) -> Callable[[Path, dict], None]:
    """A change of keys of transforms.json."""
    return lambda room, data: data.update({key: value(data) for key, value in changes.items()})


def of_ids(change: Callable[[np.ndarray, int], np.ndarray]) -> Callable[[Path, dict], None]:
    """A change of each frame's image of ids, given the number of the frame."""

    def changes(room: Path, data: dict) -> None:
        for k in range(len(data["frames"])):
            path = room / f"instances/frame_{k + 1}.png"
            with Image.open(path) as image:
                ids = np.array(image)
            Image.fromarray(change(ids, k).astype(np.uint16)).save(path)

    return changes


def shards_of(folder: Path, out: Path, label_set_name: str = "front3d_bedroom", **settings) -> Path:
    """Shards of captures."""
    build_shards(Job(Posed(folder, classes=label_set_name, **settings), out))
    return out
