"""Toy rooms in every format that a reader knows, and how each is read as the engine reads it."""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import capture_files as tools
import numpy as np
import untracked_room
from colmap_files import SCALE, write_colmap
from posed_files import SET, PosedRoom, Thing, furniture
from public_files import (
    cam_from_uv,
    furnished,
    write_blenderproc,
    write_hypersim,
    write_scannetpp,
    write_structured3d,
)
from room_scans import ROOM_TABLE, make_room_scan
from scan_files import make_scan, write_table
from scipy.spatial.transform import Rotation

from data_prep.engine.source import PreparedRoom, Source
from data_prep.engine.workers import pool
from data_prep.readers import open_reader
from data_prep.readers.posed.reader import Posed
from data_prep.readers.scannet import ScanNet

Write = Callable[[Path], Source]


def attic(folder: Path) -> PosedRoom:
    """A bed, a chair that stands before a part of it in some views, and the backpack."""
    things = furniture()
    things[1] = Thing(300, "Chair", (0.3, 0.4, 0.0), (0.7, 0.8, 0.9))
    room = PosedRoom(folder, things)
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7), (-2, 2.3, 1)]:
        room.look(eye, (0.1, 0.1, 0.3))
    tools.write_plain(room)
    return room


def posed(change: Callable[[PosedRoom], object], **settings: Any) -> Write:
    def write(folder: Path) -> Source:
        change(attic(folder / "attic"))
        return Posed(folder, classes=SET, **settings)

    return write


def through_a_lens(room: PosedRoom, **keys: Any) -> None:
    room.write_transforms(room.data | keys | {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]})


def shaken(folder: Path) -> Source:
    """Seven pieces by cameras whose poses are wrong by half a degree and a centimetre, in a turned
    world; the floor is not given."""
    room = untracked_room.furnished(folder / "attic")
    room.size, room.focal_px = (240, 320), 160.0
    room.write()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    ways = np.random.default_rng(0).normal(size=(len(room.poses), 2, 3))
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    for k, (pose, (axis, way)) in enumerate(zip(room.poses, ways, strict=True)):
        wrong = pose.copy()
        wrong[:3, :3] = Rotation.from_rotvec(np.radians(0.5) * axis).as_matrix() @ pose[:3, :3]
        wrong[:3, 3] += 0.01 * way
        room.poses[k] = turn @ wrong
    room.write_transforms(room.data)
    return Posed(folder, classes="void,bed,chair,cabinet,nightstand,lamp")


def colmap(model: str, binary: bool) -> Write:
    return posed(lambda room: write_colmap(room, model, binary), metres_per_unit=1 / SCALE)


def public(name: str, write: Callable[[Path, PosedRoom], object], **settings: Any) -> Write:
    def written(folder: Path) -> Source:
        write(folder, furnished(folder))
        return open_reader(name, folder, **settings)

    return written


def hypersim(shift: float, horizontal: float) -> Callable[[Path, PosedRoom], object]:
    def write(folder: Path, room: PosedRoom) -> None:
        room.focal_px = 75.0
        write_hypersim(folder, "ai_001_002", room, cam_from_uv(room, shift, horizontal))

    return write


def scannet(folder: Path) -> Source:
    make_scan(folder / "scans" / "scene0000_00").write(mask_size=(242, 324))
    table = write_table(folder / "labels.tsv")
    return ScanNet(folder / "scans", labels=table, frame_step=1, image_size=(121, 162))


def unaligned(folder: Path) -> Source:
    """A walled room whose file has no axisAlignment."""
    scan = make_room_scan(folder / "scans" / "scene0000_00")
    scan.poses = scan.poses[::4]
    scan.write(mask_size=(242, 324))
    scan.path(".txt").write_text("sceneType = Bedroom / Hotel\n")
    table = write_table(folder / "labels.tsv", ROOM_TABLE)
    return ScanNet(folder / "scans", labels=table, frame_step=1)


FORMATS: dict[str, Write] = {
    "transforms": posed(lambda room: None),
    "transforms, small": posed(lambda room: None, max_side=60, max_views=4),
    "transforms, no floor": posed(lambda room: room.write()),
    "opencv": posed(lambda room: through_a_lens(room, k1=-0.2, k2=0.05, p1=0.001, p2=-0.002)),
    "fisheye": posed(
        lambda room: through_a_lens(room, camera_model="OPENCV_FISHEYE", k1=0.05, k2=-0.01)
    ),
    "colmap": colmap("PINHOLE", True),
    "colmap, text": colmap("OPENCV", False),
    "wrong poses": shaken,
    "polycam": posed(tools.write_polycam),
    "record3d": posed(tools.write_record3d),
    "sam2": posed(tools.write_sam2),
    "grounded-sam2": posed(tools.write_grounded_sam2),
    "grounded-sam2, images": posed(tools.write_grounded_sam2_images),
    "coco": posed(tools.write_coco_images),
    "coco, tracks": posed(lambda room: tools.write_coco_images(room, "track_id")),
    "coco, polygons": posed(
        lambda room: tools.write_coco_images(room, "attributes", polygons=True)
    ),
    "coco, video": posed(tools.write_coco_video),
    "panoptic": posed(tools.write_panoptic),
    "png, untracked": posed(lambda room: None, tracks="auto"),
    "blenderproc": public(
        "blenderproc", lambda folder, room: write_blenderproc(folder, "house", room)
    ),
    "hypersim": public("hypersim", hypersim(0.0, 0.0)),
    "hypersim, tilted": public("hypersim", hypersim(-0.2, 0.3), max_side=64),
    "structured3d": public(
        "structured3d",
        lambda folder, room: write_structured3d(folder, "scene_00007", "480", room),
    ),
    "scannetpp": public("scannetpp", lambda folder, room: write_scannetpp(folder, "0a5c01", room)),
    "scannetpp, colmap": public(
        "scannetpp", lambda folder, room: write_scannetpp(folder, "0a5c01", room, "colmap")
    ),
    "scannetpp, iphone": public(
        "scannetpp", lambda folder, room: write_scannetpp(folder, "0a5c01", room, "iphone"),
        max_side=160,
    ),
    "scannet": scannet,
    "scannet, unaligned": unaligned,
}  # fmt: skip
"""Writes one room's files into an empty folder, and returns the source that reads them."""


def read(name: str, folder: Path) -> PreparedRoom:
    """The only room of a format, read as the engine does."""
    folder.mkdir(parents=True, exist_ok=True)
    source = FORMATS[name](folder)
    source.settings(None)
    with pool(1) as run:
        (task,) = source.survey(run).rooms
    made = source.prepare(task, None)
    assert isinstance(made, PreparedRoom)
    return made


def arrays_of(made: PreparedRoom) -> dict[str, np.ndarray]:
    """Everything that the shard of a room will hold, by name."""
    found: dict[str, Any] = {}
    for part, prefix in ((made.views, ""), (made.truth, "truth ")):
        for item in fields(part) if part is not None else ():
            found[prefix + item.name] = getattr(part, item.name)
    for name, mesh in made.models.items():
        found[f"{name} vertices"], found[f"{name} faces"] = mesh.vertices_m, mesh.faces
    found["notes"] = "\n".join(made.notes)
    found["cameras"] = made.cameras.get("room_from_world")
    return {name: np.asarray(value) for name, value in found.items() if value is not None}
