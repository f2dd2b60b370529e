"""Turns frames of instance ids with cameras into a prepared room: its frame, views and truth."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from data_prep.engine.source import Line, PreparedRoom, RoomTask
from data_prep.readers.corrected import correct
from data_prep.readers.frames import room_cameras
from data_prep.readers.heading import find_turn, note_of_turn, turn_matrix
from data_prep.readers.scanned_mesh import moved, surface_of, unoccluded
from data_prep.readers.upright import find_floor
from sceneprior.core.boxes import CUBE_CORNERS
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import IdTable, tidy
from sceneprior.core.observations import Observations, RoomGroundTruth, observe, thinned_stuff
from sceneprior.core.scene import Mesh
from sceneprior.core.shell import rectangle


class ScannedObjects(NamedTuple):
    """The mesh of a scan, which occludes objects and holds their surfaces."""

    mesh: Mesh
    """The whole mesh, with its unannotated parts."""
    parts: list[np.ndarray]
    """Indices of the vertices of each object."""
    model_ids: list[str]


@dataclass(frozen=True, kw_only=True)
class FramedRoom:
    """Frames of one room, in a right-handed world in metres whose y points up."""

    where: str
    """The room or a file of it, for messages."""
    ids: np.ndarray
    """(views, height, width) unsigned: k + 1 for object k, 0 = background, n + 1 = unknown."""
    object_class: np.ndarray
    """(n + 1,) class of each object, and VOID for what is unknown."""
    camera_to_world: np.ndarray
    """(views, 4, 4) float64, OpenCV axes."""
    intrinsics: np.ndarray
    """(3, 3), or (views, 3, 3), in pixels of `ids`."""
    stuff: np.ndarray | None = None
    """Indices into `STUFF`, uint8, at the pixels of `thinned_stuff`; None if the data set has no
    such images."""
    notes: tuple[str, ...] = ()
    may_err: bool = False
    """True for measured poses and masks, which are corrected where they contradict each other."""
    is_aligned: bool = False
    """True if walls run along x and z; otherwise their direction is found from the masks."""
    world_from_file: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Rigid transform, (4, 4), from the world of the files, in metres, to this one."""
    poses_file: str = ""
    """Name of the file of poses, for `inspect --verify`."""

    boxes: dict[int, np.ndarray] = field(default_factory=dict)
    """Points, (P, 3), such as the corners of an oriented box, of each object k for which they are
    known."""
    scan: ScannedObjects | None = None
    """None if the ground truth has no meshes."""
    floor_y: float | None = None
    """Height of the floor; None takes the lowest point of the objects' boxes."""
    assumed_camera_m: float | None = None
    """Height of the lowest camera if neither the files nor the views show the floor; None if boxes
    must show it."""
    floor_m: np.ndarray | None = None
    """(P, 2) x, z of the floor's outline; None takes the rectangle around these boxes."""
    center_m: np.ndarray | None = None
    """x, z of the floor's centre; None takes that of the outline or, without boxes, of the
    cameras."""
    floor_of_unseen: bool = False
    """True if floor and outline include the boxes of objects that no view shows."""
    ceiling_y: float | None = None
    """Height of the ceiling; None takes the highest of the cameras and of `top_y`."""
    top_y: float = -np.inf
    """Highest point of all boxes, also of parts of the room."""
    why_below: str | None = "; poses and boxes do not belong together, or a file is damaged."
    """Likely reason why cameras are below the floor, as the end of a sentence; None allows it."""


def numbered(
    numbers: np.ndarray,
    classes: dict[int, str],
    label_set_name: str,
    where: str,
    boxes: Mapping[int, np.ndarray] = MappingProxyType({}),
    stuff: np.ndarray | None = None,
    notes: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The fields of a `FramedRoom` that hold objects, from objects with numbers and class names.

    Args:
        numbers: (views, height, width) int32: number of an object, 0 = background, -1 = unknown.
        classes: Class of each number; a name outside the label set makes the object void.
        boxes: Points of each number (`FramedRoom.boxes`).
        stuff: (views, height, width) indices into `STUFF`.
    """
    made = {"where": where, "stuff": None if stuff is None else thinned_stuff(stuff)}
    names = {tidy(name) for name in label_set(label_set_name)} - {"void"}
    if not names & {tidy(name) for name in classes.values()}:  # nothing to see
        nothing = np.zeros(numbers.shape, np.uint8)
        return made | {"ids": nothing, "object_class": np.array([VOID]), "notes": notes}
    table = IdTable(classes, label_set_name, where)
    return made | {
        "ids": table.ids(numbers),
        "object_class": table.classes,
        "boxes": {k: boxes[key] for k, key in enumerate(table.objects) if key in boxes},
        "top_y": max((float(points[:, 1].max()) for points in boxes.values()), default=-np.inf),
        "notes": (*notes, *table.notes),
    }


def prepare_room(task: RoomTask, room: FramedRoom) -> PreparedRoom | Line:
    """Label the views of a room; a line of the report if none shows an object of the label set.

    In the room frame, y points up, the floor is at y = 0, and the origin is its centre. The ground
    truth has the boxes of all objects with a class and a box. If a visible object has no box, there
    is no ground truth.
    """
    room_id, notes = task.room_id, [*room.notes]
    seen = observe(room.ids, room.object_class)
    if not len(seen.tracked):
        why = f"none of its {len(room.ids)} views shows any object"
        return Line(room_id, task.house, "filtered", "no_view", why, notes=notes)
    room = replace(room, ids=seen.instance_ids)  # frees the given ones
    if room.may_err:
        found = correct(seen, room_cameras(room.camera_to_world), room.intrinsics)
        seen = found.seen
        notes += found.notes
        if found.world_to_camera is not None:
            room = replace(room, camera_to_world=np.linalg.inv(found.world_to_camera))
    degrees: float | None = 0.0
    if not room.is_aligned:
        cameras = room_cameras(room.camera_to_world)
        degrees = find_turn(seen.room_views(room_id, cameras, room.intrinsics, room.stuff))
        notes += note_of_turn(degrees)
        room = _turned(room, degrees) if degrees else room
    boxes_of = {
        k: np.stack([points.min(axis=0), points.max(axis=0)]) for k, points in room.boxes.items()
    }
    objects = [*seen.tracked.tolist(), *(k for k in seen.unseen.tolist() if k in boxes_of)]
    around = [k for k in (objects if room.floor_of_unseen else seen.tracked) if k in boxes_of]
    outline, origin = _floor(room, seen, np.array([boxes_of[k] for k in around]), notes)
    room_from_world = np.eye(4)
    room_from_world[:3, 3] = -origin
    world_to_camera = room_cameras(room.camera_to_world, room_from_world)
    views = seen.room_views(room_id, world_to_camera, room.intrinsics, room.stuff)
    room_from_file = room_from_world @ room.world_from_file
    if degrees:
        views = replace(views, turned_deg=degrees, room_from_world=room_from_file)
    truth: RoomGroundTruth | None = None
    models: dict[str, Mesh] = {}
    missing = sum(k not in boxes_of for k in seen.tracked)
    if not missing:
        ceiling_y = room.ceiling_y
        if ceiling_y is None:
            ceiling_y = max(room.camera_to_world[:, 1, 3].max(), room.top_y)
        truth = _truth(
            room.object_class[objects],
            np.array([boxes_of[k] for k in objects]) - origin,
            outline - origin[::2],
            float(ceiling_y - origin[1]),
        )
        if room.scan is not None:
            scan = room.scan._replace(mesh=moved(room.scan.mesh, room_from_world))
            truth, models = _with_surfaces(truth, scan, objects)
            whole = unoccluded(
                scan.mesh, scan.parts, seen.tracked, world_to_camera, room.intrinsics,
                views.image_size,
            )  # fmt: skip
            truth = replace(truth, unoccluded=whole)
    elif boxes_of:
        notes.append(f"{missing} of {len(seen.tracked)} objects have no 3D box: no ground truth")
    cameras_of = {"file": room.poses_file, "room_from_world": room_from_file.round(9).tolist()}
    return PreparedRoom(
        views, truth, models, notes=tuple(notes), cameras=cameras_of if room.poses_file else {}
    )


def _turned(room: FramedRoom, degrees: float) -> FramedRoom:
    """Turn the world of a room about +y."""
    turn = turn_matrix(degrees)
    rotation, level = turn[:3, :3], turn[:3:2, :3:2]
    scan = room.scan
    return replace(
        room,
        camera_to_world=turn @ room.camera_to_world,
        world_from_file=turn @ room.world_from_file,
        boxes={k: points @ rotation.T for k, points in room.boxes.items()},
        scan=None if scan is None else scan._replace(mesh=moved(scan.mesh, turn)),
        floor_m=None if room.floor_m is None else room.floor_m @ level.T,
        center_m=None if room.center_m is None else level @ room.center_m,
    )


def _floor(
    room: FramedRoom, seen: Observations, boxes: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Outline of the floor, (P, 2) x, z; and its centre, the origin of the room frame.

    `boxes` are lower and upper corners, (n, 2, 3), of the objects that stand on it.
    """
    eyes = room.camera_to_world[:, :3, 3]
    floor_y = room.floor_y
    if floor_y is None and len(boxes):
        floor_y = float(boxes[:, 0, 1].min())
    elif floor_y is None and room.assumed_camera_m is None:
        raise InputError(f"{room.where}: no visible object has a 3D box, so the floor is unknown.")
    elif floor_y is None:
        floor_y, note = _floor_in_views(room, seen, float(eyes[:, 1].min()))
        notes.append(note)
    if room.why_below is not None and eyes[:, 1].min() <= floor_y:
        raise InputError(
            f"{room.where}: its lowest camera is at {eyes[:, 1].min():.2f} m, below the floor at "
            f"{floor_y:.2f} m{room.why_below}"
        )
    outline = room.floor_m
    if outline is None:
        ends = (boxes.reshape(-1, 3) if len(boxes) else eyes)[:, ::2]
        outline = rectangle(ends.min(axis=0), ends.max(axis=0))
    center = room.center_m
    if center is None:
        center = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return outline, np.array([center[0], floor_y, center[1]])


def _floor_in_views(room: FramedRoom, seen: Observations, lowest: float) -> tuple[float, str]:
    """Height of a floor that no file states, found from the views or assumed; and a note on it."""
    found = find_floor(seen, room_cameras(room.camera_to_world), room.intrinsics)
    if found is not None and found[0] < lowest:
        level, pieces = found
        under = f"{lowest - level:.2f} m below the lowest camera"
        return level, f"the floor is found where {pieces} pieces end, {under}"
    height = room.assumed_camera_m or 0.0
    why = "too few pieces show where they end"
    return lowest - height, f"the floor is assumed {height:g} m below the lowest camera ({why})"


def _truth(
    object_class: np.ndarray, corners_m: np.ndarray, floor_m: np.ndarray, height_m: float
) -> RoomGroundTruth:
    """Ground truth of objects with lower and upper corners, (m, 2, 3), and without meshes."""
    centers_m, sizes_m = corners_m.mean(axis=1), corners_m[:, 1] - corners_m[:, 0]
    places = np.zeros((len(corners_m), 4, 4))
    places[:, range(3), range(3)] = sizes_m  # from the unit cube, since there are no models
    places[:, :3, 3], places[:, 3, 3] = centers_m, 1
    return RoomGroundTruth(
        object_class=object_class,
        centers_m=centers_m.astype(np.float32),
        sizes_m=sizes_m.astype(np.float32),
        yaw_rad=np.zeros(len(corners_m), dtype=np.float32),
        model_ids=("",) * len(corners_m),
        model_to_room=places.astype(np.float32),
        floor_m=floor_m.astype(np.float32),
        height_m=height_m,
    )


def _with_surfaces(
    truth: RoomGroundTruth, scan: ScannedObjects, objects: list[int]
) -> tuple[RoomGroundTruth, dict[str, Mesh]]:
    """Give objects that have triangles a model: their surface, its box centred at the origin."""
    models: dict[str, Mesh] = {}
    places, model_ids = truth.model_to_room.copy(), [*truth.model_ids]
    for row, k in enumerate(objects):
        points = scan.mesh.vertices_m[scan.parts[k]]
        surface = surface_of(scan.mesh, scan.parts[k])
        if surface is not None:
            center_m = (points.min(axis=0) + points.max(axis=0)) / 2
            model_ids[row] = scan.model_ids[k]
            models[model_ids[row]] = Mesh(surface.vertices_m - center_m, surface.faces)
            places[row, range(3), range(3)] = 1
    return replace(truth, model_ids=tuple(model_ids), model_to_room=places), models


def corners_of(center: np.ndarray, axes: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Corners, (8, 3), of an oriented box.

    The rows of `axes` are the unit axes of the box, `half` its half sizes along them.

        >>> corners_of(np.zeros(3), np.eye(3)[[2, 1, 0]], np.array([1.0, 2, 3])).max(axis=0)
        array([3., 2., 1.])
    """
    return center + CUBE_CORNERS * half @ axes
