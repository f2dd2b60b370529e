"""Toy rooms in every format that a reader knows, and how each is read as the engine reads it."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import capture_files as tools
import cv2
import numpy as np
import untracked_room
from colmap_files import SCALE, write_colmap
from PIL import Image
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
from scan_files import ScanFolder, make_scan, write_table
from scipy.spatial.transform import Rotation

from data_prep.engine.source import PreparedRoom, Source
from data_prep.readers import open_reader
from data_prep.readers.posed.reader import Posed
from data_prep.readers.scannet import ScanNet


class Toy(NamedTuple):
    """A toy room in its files, and what is true of it in a world whose z points up."""

    source: Source
    eyes_m: np.ndarray
    """Centres of the cameras that become views."""
    corners_m: dict[str, np.ndarray]
    """Corners of the box of each class."""
    level: bool = True
    """True if the files state which way is up, or cameras that do not roll show it."""
    mirrored: bool = False


Write = Callable[[Path], Toy]


def toy(source: Source, room: PosedRoom, views: Sequence[int] = (), **others: Any) -> Toy:
    """The toy of a posed room, of which these frames become views (none: all)."""
    eyes = np.stack([room.poses[k][:3, 3] for k in views or range(len(room.poses))])
    corners = {thing.name.lower(): thing.corners for thing in room.things[:2]}
    return Toy(source, eyes, corners, **others)


def attic(folder: Path) -> PosedRoom:
    """A bed, a chair that stands before a part of it in some views, and the backpack."""
    things = furniture()
    things[1] = Thing(300, "Chair", (0.3, 0.4, 0.0), (0.7, 0.8, 0.9))
    room = PosedRoom(folder, things)
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7), (-2, 2.3, 1)]:
        room.look(eye, (0.1, 0.1, 0.3))
    tools.write_plain(room)
    return room


def posed(
    change: Callable[[PosedRoom], object], views: Sequence[int] = (), **settings: Any
) -> Write:
    def write(folder: Path) -> Toy:
        room = attic(folder / "attic")
        change(room)
        return toy(Posed(folder, classes=SET, **settings), room, views)

    return write


def seen_through(room: PosedRoom, view: int, model: str, keys: dict[str, float]) -> np.ndarray:
    """The picture through a lens: OpenCV finds the ray of each pixel, and a wide pinhole picture
    gives the value on that ray."""
    wide = PosedRoom(room.folder, room.things, (1200, 1600), 400.0, list(room.poses))
    height, width = room.size
    v, u = np.indices(room.size) + 0.5
    points = np.stack([u - width / 2, v - height / 2], axis=-1).reshape(-1, 1, 2) / room.focal_px
    if model == "OPENCV":
        bent = np.array([keys["k1"], keys["k2"], keys["p1"], keys["p2"]])
        rays = cv2.undistortPoints(points, np.eye(3), bent)
    else:
        bent = np.array([keys[f"k{i}"] for i in range(1, 5)])
        rays = cv2.fisheye.undistortPoints(points, np.eye(3), bent)
    places = np.floor(rays.reshape(-1, 2) * 400 + [800, 600]).astype(int)
    assert (places >= 0).all() and (places < [1600, 1200]).all()
    return wide.ids(view)[places[:, 1], places[:, 0]].reshape(room.size)


def lens(model: str, in_colmap: bool = False, **keys: float) -> Write:
    """Pictures through a lens; the poses are those of nerfstudio or of COLMAP."""

    def through(room: PosedRoom) -> None:
        room.size, room.focal_px = (240, 320), 180.0
        if in_colmap:
            write_colmap(room, model, binary=True)
            # A transforms.json without frames has keys about the room.
            room.write_transforms({"metres_per_unit": 1 / SCALE, "floor_m": 0.0})
        else:
            room.write(camera_model=model, **keys, **KEYS)
        for view in range(len(room.poses)):
            Image.fromarray(seen_through(room, view, model, keys)).save(room.png(view))

    return posed(through)


OPENCV = {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}
FISHEYE = {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": 0.0}
KEYS = {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]}


def in_feet(room: PosedRoom, up: np.ndarray, center: list[float]) -> None:
    """Other axes and units, and no last rows of poses."""
    data = room.data
    for frame, pose in zip(data["frames"], room.poses, strict=True):
        pose = up @ pose
        pose[:3, 3] /= 0.3048
        frame["transform_matrix"] = pose[:3].tolist()
    room.write_transforms(data | {"floor_m": 0.0, "floor_center_m": center})


def turned(room: PosedRoom) -> None:
    """A world that is turned about its z axis; masks large enough to show it."""
    room.size, room.focal_px = (192, 256), 160.0
    room.write()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 2.1]).as_matrix()
    poses, room.poses = room.poses, [turn @ pose for pose in room.poses]
    room.write_transforms(room.data | {"floor_m": 0.0})
    room.poses = poses


def shaken(folder: Path) -> Toy:
    """Seven pieces by cameras whose poses are wrong by half a degree and a centimetre, in a turned
    world; the floor is not given."""
    room = untracked_room.furnished(folder / "attic")
    room.size, room.focal_px = (240, 320), 160.0
    room.write()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    ways = np.random.default_rng(0).normal(size=(len(room.poses), 2, 3))
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    true, room.poses = room.poses, []
    for pose, (axis, way) in zip(true, ways, strict=True):
        wrong = pose.copy()
        wrong[:3, :3] = Rotation.from_rotvec(np.radians(0.5) * axis).as_matrix() @ pose[:3, :3]
        wrong[:3, 3] += 0.01 * way
        room.poses.append(turn @ wrong)
    room.write_transforms(room.data)
    room.poses, room.things = true, [room.things[0], room.things[3]]
    return toy(Posed(folder, classes="void,bed,chair,cabinet,nightstand,lamp"), room)


def colmap(model: str, binary: bool) -> Write:
    return posed(lambda room: write_colmap(room, model, binary), metres_per_unit=1 / SCALE)


def public(
    name: str,
    write: Callable[[Path, PosedRoom], object],
    views: Sequence[int] = (),
    mirrored: bool = False,
    **settings: Any,
) -> Write:
    def written(folder: Path) -> Toy:
        room = furnished(folder)
        write(folder, room)
        return toy(open_reader(name, folder, **settings), room, views, mirrored=mirrored)

    return written


def hypersim(shift: float, horizontal: float) -> Callable[[Path, PosedRoom], object]:
    def write(folder: Path, room: PosedRoom) -> None:
        room.focal_px = 75.0
        write_hypersim(folder, "ai_001_002", room, cam_from_uv(room, shift, horizontal))

    return write


def of_scan(scan: ScanFolder, source: Source, classes: dict[str, str]) -> Toy:
    poses = [scan.alignment @ pose for pose in scan.poses if np.isfinite(pose).all()]
    corners = {classes[b.category]: b.corners for b in scan.boxes if b.category in classes}
    return Toy(source, np.stack([pose[:3, 3] for pose in poses]), corners)


def scannet(folder: Path) -> Toy:
    scan = make_scan(folder / "scans" / "scene0000_00").write(mask_size=(242, 324))
    table = write_table(folder / "labels.tsv")
    source = ScanNet(folder / "scans", labels=table, frame_step=1, image_size=(121, 162))
    return of_scan(scan, source, {"bed": "bed", "chair": "chair"})


def unaligned(folder: Path) -> Toy:
    """A walled room whose file has no axisAlignment."""
    scan = make_room_scan(folder / "scans" / "scene0000_00")
    scan.poses = scan.poses[::4]
    scan.write(mask_size=(242, 324))
    scan.path(".txt").write_text("sceneType = Bedroom / Hotel\n")
    table = write_table(folder / "labels.tsv", ROOM_TABLE)
    source = ScanNet(folder / "scans", labels=table, frame_step=1)
    return of_scan(scan, source, {"bed": "bed", "couch": "sofa"})


FORMATS: dict[str, Write] = {
    "transforms": posed(lambda room: None),
    "transforms, small": posed(lambda room: None, (0, 3, 6, 9), max_side=60, max_views=4),
    "transforms, no floor": posed(lambda room: room.write()),
    "transforms, y up": posed(
        lambda room: in_feet(room, tools.Y_UP, [0.1, 0.2]), up="y", metres_per_unit=0.3048
    ),
    "transforms, turned": posed(turned),
    "opencv": lens("OPENCV", **OPENCV),
    "fisheye": lens("OPENCV_FISHEYE", **FISHEYE),
    "colmap, opencv": lens("OPENCV", in_colmap=True, **OPENCV),
    "colmap": colmap("PINHOLE", True),
    "colmap, text": colmap("SIMPLE_PINHOLE", False),
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
        "blenderproc", lambda folder, room: write_blenderproc(folder, "house", room),
        range(4), mirrored=True,
    ),
    "hypersim": public("hypersim", hypersim(0.0, 0.0), range(4)),
    "hypersim, tilted": public("hypersim", hypersim(-0.2, 0.3), range(4), max_side=64),
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


def read(
    name: str, folder: Path, change: Callable[[Path], object] = id
) -> tuple[PreparedRoom, Toy]:
    """The only room of a format, read as the engine does; and what is true of it. `change` changes
    its files before."""
    folder.mkdir(parents=True, exist_ok=True)
    made_of = FORMATS[name](folder)
    change(folder)
    source = made_of.source
    source.settings(None)
    (task,) = source.survey().rooms
    made = source.prepare(task, None)
    assert isinstance(made, PreparedRoom)
    return made, made_of


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
