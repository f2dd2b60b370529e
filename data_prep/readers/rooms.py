"""Turns frames of instance ids with cameras and 3D boxes into a prepared room."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from data_prep.engine.source import PreparedRoom, RoomTask
from data_prep.readers.frames import (
    FrameChoice,
    choose_frames,
    first_fault,
    mask_intrinsics,
    room_cameras,
    sampled_lines,
    shrunk,
)
from data_prep.readers.heading import find_turn, note_of_turn, turn_matrix
from data_prep.readers.scannet.labels import LABEL_SET
from sceneprior.core.boxes import CUBE_CORNERS
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import IdTable, tidy
from sceneprior.core.observations import Observations, observe
from sceneprior.core.outline import rectangle
from sceneprior.core.shards import RoomGroundTruth, thinned_stuff


@dataclass(frozen=True)
class FramedRoom:
    """Frames of one room, in a right-handed world in metres whose y points up."""

    ids: np.ndarray
    """(views, height, width) int32: number of an object, 0 = background, -1 = unknown."""
    classes: dict[int, str]
    """Class of each object's number; a name outside the label set makes the object void."""
    camera_to_world: np.ndarray
    """(views, 4, 4) float64, OpenCV axes."""
    intrinsics: np.ndarray
    """(3, 3), or (views, 3, 3), in pixels of `ids`."""
    boxes: dict[int, np.ndarray] = field(default_factory=dict)
    """Points, (P, 3), such as the corners of an oriented box, of each object for which they are
    known."""
    floor_y: float | None = None
    """Height of the floor; None takes the lowest point of the visible objects' boxes."""
    floor_m: np.ndarray | None = None
    """(P, 2) x, z of the floor's outline; None takes the rectangle around these boxes."""
    ceiling_y: float | None = None
    """Height of the ceiling; None takes the highest point of all boxes and cameras."""
    stuff: np.ndarray | None = None
    """(views, height, width) uint8 indices into `STUFF`; None if the data set has no such
    images."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class FoundRoom:
    """A room found in a scene's folder."""

    image_size: tuple[int, int]
    """(height, width) of its images of ids, before they are shrunk."""
    extra: dict[str, Any] = field(default_factory=dict)
    """JSON values that reading the room needs (`RoomTask.extra`)."""


@dataclass(frozen=True)
class Reader(ABC):
    """Reads the files of one data set."""

    name: ClassVar[str]
    """Name of the data set in `index.json`."""
    folder: Path
    """The folder of scenes."""

    @property
    def label_set(self) -> str:
        """Name of the label set."""
        return LABEL_SET

    @property
    def room_type(self) -> str:
        """Type of the rooms; also in the shards' names."""
        return self.name

    def settings(self) -> dict[str, Any]:
        """Settings that the shards depend on; checks the files that all scenes share."""
        return {}

    @abstractmethod
    def scenes(self) -> list[str]:
        """Sorted names of the scene folders. All rooms of a scene are in the same split."""

    def official_split(self, scene: str) -> str | None:
        """Split of a scene, if the data set states it in the scene's name."""
        return None

    @abstractmethod
    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """Rooms of a scene by id, which is `<scene>` or `<scene>_<room>`."""

    @abstractmethod
    def read(self, task: RoomTask, max_side: int | None, max_views: int) -> FramedRoom:
        """Read one room with at most `max_views` views, and shrink its images to `max_side`."""


def sampled(
    size: tuple[int, int], max_side: int | None, intrinsics: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Index that shrinks an image of this (height, width), and the intrinsics of the result."""
    stored = shrunk(size, max_side)
    lines = np.ix_(*(sampled_lines(*sides) for sides in zip(size, stored, strict=True)))
    return lines, mask_intrinsics(intrinsics, size, size, stored)


def chosen_frames(
    where: str, camera_to_world: np.ndarray, with_mask: list[int], at_most: int
) -> FrameChoice:
    """Choose the frames that become views (`choose_frames`); an error if none is usable."""
    choice = choose_frames(camera_to_world, with_mask, 1, at_most)
    if not choice.frames:
        bad = first_fault(camera_to_world)
        fault = f"; frame {bad[0]}: {bad[1]}" if bad else ""
        raise InputError(
            f"{where} has no usable frame: {choice.bad_poses} of {choice.candidates} have no "
            f"usable pose, {choice.without_mask} no image of ids{fault}. Download it again."
        )
    return choice


def prepare_room(room_id: str, room: FramedRoom, label_set_name: str) -> PreparedRoom | None:
    """Label the views of a room; None if no view shows an object of the label set.

    The ground truth has the boxes of all objects with a class and a box. If a visible object has no
    box, there is no ground truth.
    """
    names = {tidy(name) for name in label_set(label_set_name)} - {"void"}
    if not names & {tidy(name) for name in room.classes.values()}:
        return None
    table = IdTable(room.classes, label_set_name, room_id)
    seen = observe(table.ids(room.ids), table.classes)
    if not len(seen.tracked):
        return None
    cameras = room_cameras(room.camera_to_world, np.eye(4))
    stuff = None if room.stuff is None else thinned_stuff(room.stuff)
    degrees = find_turn(seen.room_views(room_id, cameras, room.intrinsics, stuff))
    if degrees:
        room = _turned(room, degrees)
    boxes_of = {
        k: np.stack([points.min(axis=0), points.max(axis=0)]) for k, points in room.boxes.items()
    }
    tracked = [table.objects[k] for k in seen.tracked]
    boxes = np.array([boxes_of[k] for k in tracked if k in boxes_of]).reshape(-1, 2, 3)
    eyes = room.camera_to_world[:, :3, 3]
    floor_y = room.floor_y
    if floor_y is None:
        if not len(boxes):
            raise InputError(f"{room_id}: no visible object has a 3D box, so the floor is unknown.")
        floor_y = float(boxes[:, 0, 1].min())
    if eyes[:, 1].min() <= floor_y:
        raise InputError(
            f"{room_id}: its lowest camera is at {eyes[:, 1].min():.2f} m, below the floor at "
            f"{floor_y:.2f} m; poses and boxes do not belong together, or a file is damaged."
        )
    outline = room.floor_m
    if outline is None:
        ends = (boxes.reshape(-1, 3) if len(boxes) else eyes)[:, ::2]
        outline = rectangle(ends.min(axis=0), ends.max(axis=0))
    center = (outline.min(axis=0) + outline.max(axis=0)) / 2
    origin = np.array([center[0], floor_y, center[1]])
    room_from_world = np.eye(4)
    room_from_world[:3, 3] = -origin
    world_to_camera = room_cameras(room.camera_to_world, room_from_world)
    truth = None
    if len(boxes) == len(tracked):
        tops = [eyes[:, 1].max(), *(box[1, 1] for box in boxes_of.values())]
        ceiling_y = max(tops) if room.ceiling_y is None else room.ceiling_y
        height_m = float(ceiling_y - floor_y)
        truth = _truth(boxes_of, table, seen, origin, outline - center, height_m)
    views = seen.room_views(room_id, world_to_camera, room.intrinsics, stuff)
    if degrees:
        world = room_from_world @ turn_matrix(degrees)
        views = replace(views, turned_deg=degrees, room_from_world=world)
    notes = [*room.notes, *table.notes, *note_of_turn(degrees)]
    if boxes_of and truth is None:
        missing = len(tracked) - len(boxes)
        notes.append(f"{missing} of {len(tracked)} objects have no 3D box: no ground truth")
    return PreparedRoom(views, truth, notes=tuple(notes))


def _turned(room: FramedRoom, degrees: float) -> FramedRoom:
    """Turn the world of a room about +y."""
    turn = turn_matrix(degrees)
    level = turn[:3:2, :3:2]
    return replace(
        room,
        camera_to_world=turn @ room.camera_to_world,
        boxes={k: points @ turn[:3, :3].T for k, points in room.boxes.items()},
        floor_m=None if room.floor_m is None else room.floor_m @ level.T,
    )


def _truth(
    boxes: dict[int, np.ndarray], table: IdTable, seen: Observations, origin: np.ndarray,
    floor_m: np.ndarray, height_m: float,
) -> RoomGroundTruth:  # fmt: skip
    """Ground truth of the objects with a box, the visible ones first; they have no meshes."""
    unseen = [k for k in seen.unseen if k < len(table.objects) and table.objects[k] in boxes]
    order = np.array([*seen.tracked, *unseen], dtype=np.int64)
    corners = np.array([boxes[table.objects[k]] for k in order]) - origin
    centers_m, sizes_m = corners.mean(axis=1), corners[:, 1] - corners[:, 0]
    places = np.zeros((len(order), 4, 4))
    places[:, range(3), range(3)] = sizes_m  # from the unit cube, since there are no models
    places[:, :3, 3], places[:, 3, 3] = centers_m, 1
    return RoomGroundTruth(
        object_class=table.classes[order],
        centers_m=centers_m.astype(np.float32),
        sizes_m=sizes_m.astype(np.float32),
        yaw_rad=np.zeros(len(order), dtype=np.float32),
        model_ids=("",) * len(order),
        model_to_room=places.astype(np.float32),
        floor_m=floor_m.astype(np.float32),
        height_m=height_m,
    )


def corners_of(center: np.ndarray, axes: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Corners, (8, 3), of an oriented box.

    The rows of `axes` are the unit axes of the box, `half` its half sizes along them.

        >>> corners_of(np.zeros(3), np.eye(3)[[2, 1, 0]], np.array([1.0, 2, 3])).max(axis=0)
        array([3., 2., 1.])
    """
    return center + CUBE_CORNERS * half @ axes
