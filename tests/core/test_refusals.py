"""Refusals of core: damaged files and impossible requests, each in one whole sentence."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from made_shards import make_room, make_truth, with_stuff
from PIL import Image
from refusals import refused
from toy_rooms import write_shard

from sceneprior.core.checked import number_array
from sceneprior.core.classes import label_set, label_set_name
from sceneprior.core.coco import read_coco
from sceneprior.core.furniture import model_categories
from sceneprior.core.id_tables import IdTable, mask_size, read_class_table, read_mask
from sceneprior.core.scene import Opening, Scene, SceneObject, Solid
from sceneprior.core.scene_json import read_scene, scene_to_json
from sceneprior.core.shard_writing import check_room
from sceneprior.core.shards import Shard, list_shards, read_index
from sceneprior.core.shell import floor_polygon, shell_of
from sceneprior.core.views import as_views, image_from_shards, image_of_room

BEDROOM = "front3d_bedroom"
FLOOR = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [2.0, 3.0], [2.0, 2.0], [0.0, 2.0]])
BOX = [[1, 1, 9, 1, 9, 9]]


def text(name: str, content: str, read: Callable[[Path], object]) -> Callable[[Path], object]:
    """Write a file, and read it."""

    def case(folder: Path) -> object:
        (folder / name).write_text(content)
        return read(folder / name)

    return case


def table(content: str, name: str = "classes.json") -> Callable[[Path], object]:
    return text(name, content, read_class_table)


def coco(segmentations: list, **changes: object) -> Callable[[Path], object]:
    """A COCO JSON of one image of 30 x 40 pixels."""
    rows = [{"id": 70, "category_id": 1, "segmentation": each} for each in segmentations]
    data = {
        "images": [{"height": 30, "width": 40}],
        "categories": [{"id": 1, "name": "bed"}],
        "annotations": rows,
    }
    return text("a.json", json.dumps(data | changes), read_coco)


def runs(size: list, counts: object) -> Callable[[Path], object]:
    return coco([{"size": size, "counts": counts}])


def opening(kind: str, start: tuple, end: tuple, low: float, high: float, floor=FLOOR) -> Callable:
    scene = Scene("room", BEDROOM, (), floor, openings=(Opening(kind, start, end, low, high),))
    return text("room.json", json.dumps(scene_to_json(scene)), read_scene)


def solid(low: tuple, high: tuple) -> Callable[[Path], object]:
    chair = SceneObject(
        "chair", (1.0, 0.5, 0.0), (0.5, 1.0, 0.5), solids=(Solid("box", low, high),)
    )
    return text(
        "room.json", json.dumps(scene_to_json(Scene("room", BEDROOM, (chair,)))), read_scene
    )


def png(mode: str, read: Callable[[Path], object]) -> Callable[[Path], object]:
    def case(folder: Path) -> object:
        Image.fromarray(np.zeros((2, 3), np.uint8)).convert(mode).save(folder / "a.png")
        return read(folder / "a.png")

    return case


def models(rows: object) -> Callable[[Path], object]:
    return text("model_info.json", json.dumps(rows), lambda path: model_categories(path.parent))


CASES: dict[str, Callable[[Path], object]] = {
    "label set unknown": lambda _: label_set("attic"),
    "label set twice": lambda _: label_set("void,bed,bed"),
    "label set empty name": lambda _: label_set("void,"),
    "label set long name": lambda _: label_set("void," + "x" * 61),
    "label set comma": lambda _: label_set_name(["bed, large"]),
    "label set of none": lambda _: label_set_name([]),
    "coco list": text("a.json", "[]", read_coco),
    "coco number": text("a.json", "3", read_coco),
    "coco without annotations": text("a.json", '{"images": []}', read_coco),
    "coco no image": coco([], images=[]),
    "coco no object": coco([]),
    "coco two corners": coco([[[1, 1, 2, 2]]]),
    "coco infinite corner": coco([[[1, 1, 2, 2, float("nan"), 3]]]),
    "coco other size": runs([60, 80], [4800]),
    "coco no digit": runs([30, 40], "\u00ff"),
    "coco cut number": runs([30, 40], "P"),
    "coco long number": runs([30, 40], "o" * 9_999),
    "coco too many pixels": runs([30, 40], [10**30]),
    "coco one side": runs([30], [30]),
    "coco no size": coco([{"counts": [1200]}]),
    "coco no category": coco([BOX], categories=[]),
    "coco odd categories": coco([BOX], categories={"1": "bed"}),
    "coco no height": coco([BOX], images=[{"height": 0, "width": 40}]),
    "coco large image": coco([BOX], images=[{"height": 10**400, "width": 40}]),
    "table cut": table("{"),
    "table empty": table("{}"),
    "table list": table("[[1]]"),
    "table text": table('"bed"'),
    "table id 0": table('{"0": "bed"}'),
    "table twice": table('{"1": "bed", "1": "sofa"}'),
    "table csv twice": table("1,bed\n1,sofa", "classes.csv"),
    "table csv no class": table("1\n", "classes.csv"),
    "table missing": lambda folder: read_class_table(folder / "a.csv"),
    "table rows without class": table('[{"id": 1, "category_id": 3}]'),
    "table of no class": lambda _: IdTable({1: "teapot"}, BEDROOM, "here"),
    "png RGB": png("RGB", mask_size),
    "png one bit": png("1", mask_size),
    "png grey with alpha": png("LA", read_mask),
    "png RGBA": png("RGBA", read_mask),
    "png missing": lambda folder: read_mask(folder / "a.png"),
    "png empty": text("a.png", "", mask_size),
    "door in the room": opening("door", (3.0, 1.0), (3.0, 1.9), 0.0, 2.0),
    "door beyond a corner": opening("door", (4.0, 2.8), (4.0, 3.6), 0.0, 2.0),
    "door without width": opening("door", (4.0, 1.0), (4.0, 1.0), 0.0, 2.0),
    "window upside down": opening("window", (4.0, 1.0), (4.0, 1.9), 2.1, 0.9),
    "window below the floor": opening("window", (4.0, 1.0), (4.0, 1.9), -1.0, 0.9),
    "door without floor": opening("door", (4.0, 1.0), (4.0, 1.9), 0.0, 2.0, None),
    "solid elsewhere": solid((-0.2, 0.0, -0.2), (0.2, 0.5, 0.2)),
    "solid flat": solid((0.8, 0.5, -0.2), (1.2, 0.5, 0.2)),
    "solid infinite": solid((0.8, 0.0, -0.2), (1.2, float("nan"), 0.2)),
    "outline crossed": lambda _: shell_of(Scene("a", BEDROOM, (), FLOOR[[0, 2, 1, 3]])),
    "floor without area": lambda _: floor_polygon(Scene("a", BEDROOM, (), FLOOR[[0, 1, 0]])),
    "models no folder": lambda folder: model_categories(folder / "none", "--models"),
    "models no list": lambda folder: model_categories(folder, "--models"),
    "models odd list": models([{"category": "Bed"}]),
    "shard missing": lambda folder: Shard(folder / "none.h5"),
    "shards no folder": lambda folder: list_shards(folder / "none", "train"),
    "shards no index": read_index,
    "shards no index for a split": lambda folder: list_shards(folder, "test"),
    "shards of no split": text(
        "index.json", '{"label_set": ""}', lambda path: list_shards(path.parent, "test")
    ),
    "shards index cut": text("index.json", '{"a"', lambda path: read_index(path.parent)),
}


@pytest.mark.parametrize("name", CASES)
def test_refused(name, tmp_path):
    with refused(f"core/{name}", tmp=tmp_path):
        CASES[name](tmp_path)


DISAGREEING = {
    "boxes of fewer objects": ("boxes", np.zeros((3, 1, 4), np.float32)),
    "fewer images": ("instance_ids", np.zeros((2, 12, 16), np.uint8)),
    "ids beyond void": ("instance_ids", np.full((3, 12, 16), 4, np.uint8)),
    "no images": ("instance_ids", None),
    "stuff of another size": ("stuff", np.zeros((3, 6, 8), np.uint8)),
}


@pytest.mark.parametrize("name", DISAGREEING)
def test_rooms_that_disagree_with_themselves(name):
    key, value = DISAGREEING[name]
    with refused(f"core/room with {name}"):
        check_room("a.h5", replace(make_room(), **{key: value}), None)


def exchange(name: str, **made: object) -> Callable[[h5py.Group], None]:
    """Another array in place of one."""

    def change(room: h5py.Group) -> None:
        del room[name]
        room.create_dataset(name, **made)

    return change


def put(name: str, value: float) -> Callable[[h5py.Group], None]:
    return lambda room: room[name].__setitem__(0, value)


def attribute(name: str, value: object, group: str = "/") -> Callable[[h5py.Group], None]:
    """`group` is relative to the room, or the file for /."""
    return lambda room: (room.file if group == "/" else room[group]).attrs.__setitem__(name, value)


DAMAGES = {
    "boxes of fewer objects": exchange("boxes", data=np.zeros((3, 1, 4), "f4")),
    "boxes of float64": exchange("boxes", data=np.zeros((3, 2, 4))),
    "images that claim terabytes": exchange(
        "instance_ids", shape=(3, 2**20, 2**21), dtype="u1", chunks=(1, 9, 9)
    ),
    "images of float64": exchange("instance_ids", data=np.zeros((3, 12, 16))),
    "ids beyond void": put("instance_ids", 9),
    "infinite poses": put("world_to_camera", np.nan),
    "unknown class": put("object_class", 99),
    "size in words": attribute("image_size", "big", "."),
    "another size": attribute("image_size", (16, 12), "."),
    "infinite truth": put("ground_truth/centers_m", np.inf),
    "models cut": attribute("model_ids", "[1, 2", "ground_truth"),
    "one model": attribute("model_ids", '["a"]', "ground_truth"),
    "a path as model": attribute("model_ids", '["a", "../b", ""]', "ground_truth"),
    "no height": attribute("height_m", np.nan, "ground_truth"),
    "stuff unknown": exchange("stuff", data=np.full((3, 12, 16), 6, np.uint8)),
    "stuff of another size": exchange("stuff", data=np.zeros((3, 6, 16), np.uint8)),
    "stuff of floats": exchange("stuff", data=np.zeros((3, 12, 16), np.float32)),
    "label set of a number": attribute("label_set", 3),
    "label set unknown": attribute("label_set", "unheard"),
    "format of numbers": attribute("format", [1, 2]),
    "another format": attribute("format", "something"),
    "version of the future": attribute("version", 3),
    "id of bytes": attribute("room_id", b"\xff", "."),
    "id of a number": attribute("room_id", 7, "."),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_shards(name, tmp_path):
    path = tmp_path / "a.h5"
    write_shard(path, BEDROOM, [(with_stuff(make_room()), make_truth())])
    with h5py.File(path, "r+") as file:
        DAMAGES[name](file["rooms/house_A"])
    with refused(f"core/shard with {name}", tmp=tmp_path), Shard(path) as shard:
        shard.read_room("house_A", images=True)
        shard.read_ground_truth("house_A")


def test_images_of_rooms(toy_shards):
    with Shard(list_shards(toy_shards, "test")[0]) as shard:
        room = shard.read_room(shard.room_ids[0], images=True)
    with refused("core/image of no view"):
        image_of_room(room, 8, BEDROOM)
    with refused("core/image of nothing"):
        image_of_room(replace(room, visible=np.zeros_like(room.visible)), 2, BEDROOM)
    with refused("core/image of no room", shards=toy_shards):
        image_from_shards(toy_shards, "attic", 0)
    one = image_of_room(room, int(room.visible.any(axis=1).argmax()), BEDROOM)
    with refused("core/images of two sizes"):
        as_views([one, replace(one, instance_ids=one.instance_ids[::2])], 4)


@pytest.mark.parametrize("value", [[1, "2"], [None], "1", [10**400], {"a": 1}])
def test_what_holds_no_numbers(value):
    with pytest.raises(TypeError, match="not all are numbers"):
        number_array(value)
