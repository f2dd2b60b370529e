"""Turns frames of instance ids with cameras into a prepared room: its frame, views and truth."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from data_prep.engine.source import Line, PreparedRoom, RoomTask
from data_prep.readers.corrected import correct
from data_prep.readers.frames import room_cameras
from data_prep.readers.heading import find_turn, note_of_turn, turn_matrix
from data_prep.readers.upright import find_floor, fit_upright
from sceneprior.core.boxes import CUBE_CORNERS
from sceneprior.core.cameras import rigid, to_camera, to_pixels
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import IdTable, tidy
from sceneprior.core.observations import Observations, RoomGroundTruth, observe, thinned_stuff
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen.zbuffer import NEAR_PLANE_M, rasterize

_BEHIND_M = 0.05
"""Minimum depth of a vertex behind the rendered surface to count as occluded; smaller depths occur
at borders between objects."""
_CUT_SHARE = 0.005
"""Tolerance of the sides of the 2D box, relative to the image's longer side."""


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
    outside: Mapping[str, int] = field(default_factory=dict)
    """Number of objects (estimated without tracks) by name outside the user's label set."""
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

    def ends(self, objects: Sequence[int]) -> np.ndarray:
        """Lower and upper corners of the boxes of these objects, (n, 2, 3)."""
        boxes = [self.boxes[k] for k in objects]
        return np.array([(points.min(axis=0), points.max(axis=0)) for points in boxes])

    def moved(self, transform: np.ndarray) -> "FramedRoom":
        """The room after a turn about y or a shift, (4, 4), that leaves heights above the floor as
        they are; `floor_y`, `ceiling_y` and `top_y` stay those of before."""
        level, shift = transform[:3:2, :3:2], transform[:3:2, 3]
        scan = self.scan
        if scan is not None:
            vertices_m = to_camera(scan.mesh.vertices_m, transform)
            scan = scan._replace(mesh=Mesh(vertices_m, scan.mesh.faces))
        return replace(
            self,
            camera_to_world=transform @ self.camera_to_world,
            world_from_file=transform @ self.world_from_file,
            boxes={k: to_camera(points, transform) for k, points in self.boxes.items()},
            scan=scan,
            floor_m=None if self.floor_m is None else self.floor_m @ level.T + shift,
            center_m=None if self.center_m is None else level @ self.center_m + shift,
        )


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
        line = Line(room_id, task.house, "filtered", "no_view", why, notes=notes)
        return replace(line, unknown_categories=dict(room.outside))
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
        room = room.moved(turn_matrix(degrees)) if degrees else room
    objects = [*seen.tracked.tolist(), *(k for k in seen.unseen.tolist() if k in room.boxes)]
    around = [k for k in (objects if room.floor_of_unseen else seen.tracked) if k in room.boxes]
    outline, origin = _floor(room, seen, room.ends(around), notes)
    ceiling_y = room.ceiling_y
    if ceiling_y is None:
        ceiling_y = max(room.camera_to_world[:, 1, 3].max(), room.top_y)
    room = replace(room, floor_m=outline).moved(rigid(np.eye(3), -origin))
    cameras = room_cameras(room.camera_to_world)
    views = seen.room_views(room_id, cameras, room.intrinsics, room.stuff)
    if degrees:
        views = replace(views, turned_deg=degrees, room_from_world=room.world_from_file)
    truth: RoomGroundTruth | None = None
    models: dict[str, Mesh] = {}
    missing = sum(k not in room.boxes for k in seen.tracked)
    if not missing:
        truth, models = _truth(room, objects, float(ceiling_y - origin[1]))
        if room.scan is not None:
            whole = unoccluded(room.scan, seen.tracked, cameras, room.intrinsics, views.image_size)
            truth = replace(truth, unoccluded=whole)
    elif room.boxes:
        notes.append(f"{missing} of {len(seen.tracked)} objects have no 3D box: no ground truth")
    origin_of = {"file": room.poses_file, "room_from_world": room.world_from_file.round(9).tolist()}
    return PreparedRoom(
        views, truth, models, tuple(notes), room.outside, origin_of if room.poses_file else {}
    )


def _floor(
    room: FramedRoom, seen: Observations, boxes: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Outline of the floor, (P, 2) x, z; and its centre, the origin of the room frame.

    `boxes` are lower and upper corners, (n, 2, 3), of the objects that stand on it.
    """
    eyes = room.camera_to_world[:, :3, 3]
    lowest = float(eyes[:, 1].min())
    floor_y = room.floor_y
    if floor_y is None and len(boxes):
        floor_y = float(boxes[:, 0, 1].min())
    elif floor_y is None and room.assumed_camera_m is None:
        raise InputError(f"{room.where}: no visible object has a 3D box, so the floor is unknown.")
    elif floor_y is None:
        size = seen.instance_ids.shape[1:]
        boxes_found = fit_upright(seen, size, room_cameras(room.camera_to_world), room.intrinsics)
        found = find_floor(seen, size, *boxes_found)
        if found is not None and found[0] < lowest:
            floor_y, pieces = found
            under = f"{lowest - floor_y:.2f} m below the lowest camera"
            notes.append(f"the floor is found where {pieces} pieces end, {under}")
        else:
            height, why = room.assumed_camera_m or 0.0, "too few pieces show where they end"
            floor_y = lowest - height
            notes.append(f"the floor is assumed {height:g} m below the lowest camera ({why})")
    if room.why_below is not None and lowest <= floor_y:
        raise InputError(
            f"{room.where}: its lowest camera is at {lowest:.2f} m, below the floor at "
            f"{floor_y:.2f} m{room.why_below}"
        )
    outline = room.floor_m
    if outline is None:
        ends = (boxes.reshape(-1, 3) if len(boxes) else eyes)[:, ::2]
        low, high = ends.min(axis=0), ends.max(axis=0)
        outline = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    center = room.center_m
    if center is None:
        center = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return outline, np.array([center[0], floor_y, center[1]])


def _truth(
    room: FramedRoom, objects: list[int], height_m: float
) -> tuple[RoomGroundTruth, dict[str, Mesh]]:
    """Ground truth of objects, and models: an object of which the scan has triangles has its
    surface, centred in its box, and any other the unit cube, which is no model."""
    ends = room.ends(objects)
    centers_m, sizes_m = ends.mean(axis=1), ends[:, 1] - ends[:, 0]
    places = np.zeros((len(objects), 4, 4))
    places[:, range(3), range(3)] = sizes_m
    places[:, :3, 3], places[:, 3, 3] = centers_m, 1
    scan, models = room.scan, dict[str, Mesh]()
    model_ids = [""] * len(objects)
    if scan is not None:
        for row, k in enumerate(objects):
            surface = surface_of(scan.mesh, scan.parts[k])
            if surface is not None:
                corners = surface.vertices_m.min(axis=0), surface.vertices_m.max(axis=0)
                model_ids[row] = scan.model_ids[k]
                models[model_ids[row]] = Mesh(surface.vertices_m - sum(corners) / 2, surface.faces)
                places[row, range(3), range(3)] = 1
    assert room.floor_m is not None, "set when the floor is found"
    truth = RoomGroundTruth(
        object_class=room.object_class[objects],
        centers_m=centers_m.astype(np.float32),
        sizes_m=sizes_m.astype(np.float32),
        yaw_rad=np.zeros(len(objects), dtype=np.float32),
        model_ids=tuple(model_ids),
        model_to_room=places.astype(np.float32),
        floor_m=room.floor_m.astype(np.float32),
        height_m=height_m,
    )
    return truth, models


def surface_of(mesh: Mesh, part: np.ndarray) -> Mesh | None:
    """Cut the submesh with the vertices `part` out of a mesh; None if it has no triangles.

    All vertices of the part are kept, even if no triangle uses them, as at borders with other
    objects, so that the surface has the same bounding box as the object.
    """
    part = np.sort(part)
    number = np.full(len(mesh.vertices_m), -1)
    number[part] = np.arange(len(part))
    faces = number[mesh.faces]
    faces = faces[(faces >= 0).all(axis=1)]
    return Mesh(mesh.vertices_m[part], faces) if len(faces) else None


def unoccluded(
    scan: ScannedObjects,
    chosen: Iterable[int],
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
) -> np.ndarray:
    """Find the views that show each chosen object without occlusion, (views, len(chosen)) bool.

    The 2D box of its visible vertices is compared with the 2D box of all its vertices. Everything
    in the mesh occludes: walls, doors, objects, unannotated surfaces. Indices from the number of
    objects on are never unoccluded. `intrinsics` is (3, 3).
    """
    mesh, parts = scan.mesh, scan.parts
    height, width = image_size
    projection = focal_and_center(intrinsics)
    slack = _CUT_SHARE * max(height, width)
    chosen = list(chosen)
    whole = np.zeros((len(world_to_camera), len(chosen)), dtype=bool)
    owner = np.full(len(mesh.vertices_m) + 1, -1)
    for k, part in enumerate(parts):
        owner[part] = k
    # The last row is for pixels that show no surface.
    owners = np.concatenate([owner[mesh.faces], [[-1, -1, -1]]])
    for view, camera in enumerate(world_to_camera):
        index, nearest = rasterize(mesh.vertices_m, mesh.faces, camera, projection, image_size)
        for column, k in enumerate(chosen):
            if k >= len(parts):
                continue
            points = to_camera(mesh.vertices_m[parts[k]], camera)
            depth = points[:, 2]
            if (depth <= NEAR_PLANE_M).any():
                continue
            pixels = to_pixels(points, intrinsics)
            columns, rows = np.floor(np.clip(pixels, -1, max(height, width))).astype(np.int64).T
            seen = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
            at = rows[seen], columns[seen]
            hidden = (nearest[at] < depth[seen] - _BEHIND_M) & (owners[index[at]] != k).all(axis=1)
            seen[seen] = ~hidden
            if seen.any():
                ends = [np.stack([ends.min(axis=0), ends.max(axis=0)])
                        for ends in (pixels, pixels[seen])]  # fmt: skip
                whole[view, column] = np.abs(ends[0] - ends[1]).max() <= slack
    return whole


def focal_and_center(K: np.ndarray) -> tuple[float, float, float, float]:
    """Focal lengths and principal point of intrinsics, (3, 3), as `rasterize` takes them."""
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def corners_of(center: np.ndarray, axes: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Corners, (8, 3), of an oriented box.

    The rows of `axes` are the unit axes of the box, `half` its half sizes along them.

        >>> corners_of(np.zeros(3), np.eye(3)[[2, 1, 0]], np.array([1.0, 2, 3])).max(axis=0)
        array([3., 2., 1.])
    """
    return center + CUBE_CORNERS * half @ axes
