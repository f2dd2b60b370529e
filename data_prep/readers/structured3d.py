"""Reads Structured3D: perspective views of furnished rooms.

    <folder>/scene_NNNNN/bbox_3d.json          oriented boxes by instance id
    <folder>/scene_NNNNN/annotation_3d.json    junctions, lines and planes of each room
        2D_rendering/<room>/perspective/full/<position>/
            instance.png    uint16, an instance id, 65535 = none
            semantic.png    a palette's indices, NYU40 ids
            camera_pose.txt eye, viewing direction, up, half angles of the fields of view

The world is in millimetres, z up.

Source: data_organization.md, misc/utils.py, visualize_bbox.py and visualize_mesh.py of
bertjiazheng/Structured3D.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, RootModel

from data_prep.engine.source import RoomTask
from data_prep.readers.annotations import ids_and_classes
from data_prep.readers.frames import Y_UP, choose_frames, sampled
from data_prep.readers.reader import FoundRoom, Reader, by_number
from data_prep.readers.rooms import FramedRoom, corners_of, numbered
from sceneprior.core.cameras import odd_field_of_view, rigid
from sceneprior.core.checked import checked, shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_folders, read_json, read_text
from sceneprior.core.id_tables import mask_size, read_mask

_NONE = 65_535
_METRES = 1e-3
_SPLITS = ((3000, "train"), (3250, "val"), (3500, "test"))
"""Split of the scenes below each number, as the authors define it."""


class _Box(BaseModel):
    ID: int
    basis: tuple[tuple[float, float, float], ...]
    coeffs: tuple[float, float, float]
    centroid: tuple[float, float, float]


class _Junction(BaseModel):
    coordinate: tuple[float, float, float]


class _Plane(BaseModel):
    type: str


class _Semantic(BaseModel):
    ID: int
    type: str
    planeID: list[int]  # noqa: N815


class _Structure(BaseModel):
    junctions: list[_Junction]
    planes: list[_Plane]
    semantics: list[_Semantic]
    planeLineMatrix: list[list[int]]  # noqa: N815
    lineJunctionMatrix: list[list[int]]  # noqa: N815


@dataclass(frozen=True, kw_only=True)
class Structured3D(Reader):
    """Structured3D's perspective views."""

    name: ClassVar = "structured3d"

    def scenes(self) -> list[str]:
        return [
            path.name
            for path in list_folders(self.folder)
            if re.fullmatch(r"scene_\d{5}", path.name) and (path / "2D_rendering").is_dir()
        ]

    def official_split(self, scene: str) -> str | None:
        """The authors' split by the scene's number."""
        number = int(scene.removeprefix("scene_"))
        return next((split for end, split in _SPLITS if number < end), None)

    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """Rooms with perspective views of the furnished room."""
        found = {}
        for path in list_folders(self.folder / scene / "2D_rendering"):
            if views := _views(path):
                room_id = f"{scene}_{path.name}"
                found[room_id] = FoundRoom(mask_size(views[0] / "instance.png"))
        return found

    def read(self, task: RoomTask) -> FramedRoom:
        scene = self.folder / task.house
        room = scene / "2D_rendering" / task.room_id.removeprefix(f"{task.house}_")
        views = _views(room)
        cameras = [_read_camera(view / "camera_pose.txt") for view in views]
        poses = np.stack([pose for pose, _ in cameras])
        frames, notes = choose_frames(str(room), poses, range(len(views)), self.max_views)
        instances: list[np.ndarray] = []
        semantics: list[np.ndarray] = []
        intrinsics = []
        size = mask_size(views[0] / "instance.png")
        for k in frames:
            half = np.array(size[::-1]) / 2
            K = np.diag([*(half / np.tan(cameras[k][1])), 1.0])
            K[:2, 2] = half
            if odd := odd_field_of_view(float(K[0, 0]), size):
                raise InputError(f"{views[k] / 'camera_pose.txt'}: {odd}.")
            lines, K = sampled(size, self.max_side, K)
            intrinsics.append(K)
            for name, images in (("instance.png", instances), ("semantic.png", semantics)):
                image = read_mask(views[k] / name).astype(np.int32)
                if image.shape != size:
                    raise InputError(
                        f"{views[k] / name} has {image.shape[1]} x {image.shape[0]} pixels, but "
                        f"the room's first view {size[1]} x {size[0]}; download the scene again."
                    )
                images.append(image[lines])
        numbers = np.stack(instances)
        numbers[numbers == _NONE] = -1
        ids, classes, stuff = ids_and_classes(numbers, np.stack(semantics), str(room))
        floor_m, ceiling_y, floor_y = _read_floor(scene / "annotation_3d.json", room.name)
        boxes = _read_boxes(scene / "bbox_3d.json")
        return FramedRoom(
            **numbered(ids, classes, self.label_set, task.room_id, boxes, stuff, notes),
            camera_to_world=Y_UP @ poses[frames],
            intrinsics=np.stack(intrinsics),
            floor_y=floor_y,
            floor_m=floor_m,
            ceiling_y=ceiling_y,
        )


def _views(room: Path) -> list[Path]:
    """Folders of a room's perspective views, by number."""
    folders = list_folders(room / "perspective" / "full")
    return by_number([path for path in folders if (path / "instance.png").is_file()])


def _read_camera(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Camera to world, (4, 4), OpenCV axes, z up, metres; and the half angles along x and y."""
    try:
        values = np.array([float(word) for word in read_text(path).split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) not in (11, 12) or not np.isfinite(values).all():
        raise InputError(
            f"{path} does not hold 12 numbers: eye, direction, up, two half angles and 1; download "
            "the scene again."
        )
    eye, ahead, up, angles = values[:3], values[3:6], values[6:9], values[9:11]
    right = np.cross(ahead, up)
    if not (np.linalg.norm(right) > 1e-6 and (angles > 0).all() and (angles < np.pi / 2).all()):
        raise InputError(
            f"{path}: its direction and up vector, or its half angles {shown(angles.tolist())}, "
            "are those of no camera; download the scene again."
        )
    ahead, right = ahead / np.linalg.norm(ahead), right / np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return rigid(turn, eye * _METRES), angles


def _read_boxes(path: Path) -> dict[int, np.ndarray]:
    """Boxes by instance + 1, in metres with y up."""
    turn = Y_UP[:3, :3]
    found = {}
    for box in checked(RootModel[list[_Box]], read_json(path), str(path)).root:
        axes = np.array(box.basis)
        half = np.abs(np.array(box.coeffs)) * _METRES
        if axes.shape == (3, 3) and np.isfinite(axes).all() and (half > 0).all():
            center = turn @ np.array(box.centroid) * _METRES
            found[box.ID + 1] = corners_of(center, axes @ turn.T, half)
    return found


def _read_floor(path: Path, room: str) -> tuple[np.ndarray | None, float | None, float]:
    """Outline of a room's floor, (P, 2) x, z; height of its ceiling and of its floor: metres.

    The outline is None if the lines of the floor's plane do not close, as in rooms of the errata.
    """
    data = checked(_Structure, read_json(path), str(path))
    points = np.array([junction.coordinate for junction in data.junctions]).reshape(-1, 3)
    points = points @ Y_UP[:3, :3].T * _METRES
    try:
        lines_of = [set(np.flatnonzero(row)) for row in data.planeLineMatrix]
        ends_of = [np.flatnonzero(row).tolist() for row in data.lineJunctionMatrix]
        holes = [plane for item in data.semantics if item.type in ("door", "window")
                 for plane in item.planeID]  # fmt: skip
        in_holes = set().union(*(lines_of[plane] for plane in holes))
        planes = [
            plane for item in data.semantics if str(item.ID) == room for plane in item.planeID
        ]
        loops = {
            data.planes[plane].type: _loop([ends_of[k] for k in sorted(lines_of[plane] - in_holes)])
            for plane in planes
            if data.planes[plane].type in ("floor", "ceiling")
        }
        floor, ceiling = (points[loops.get(name, [])] for name in ("floor", "ceiling"))
    except IndexError:
        raise InputError(
            f"{path}: its planes, lines and junctions do not belong together; it is damaged, "
            "download the scene again."
        ) from None
    return (
        floor[:, [0, 2]] if len(floor) > 2 else None,
        float(ceiling[:, 1].mean()) if len(ceiling) else None,
        float(floor[:, 1].mean()) if len(floor) else 0.0,
    )


def _loop(lines: list[list[int]]) -> list[int]:
    """Junctions along a closed loop of lines, each a pair of junctions; [] if it does not close.

    >>> _loop([[0, 1], [2, 3], [1, 2], [3, 0]])
    [0, 1, 2, 3]
    """
    left = [line for line in lines if len(line) == 2]
    if not left:
        return []
    start, here = left.pop(0)
    loop = [start]
    while here != start:
        loop.append(here)
        after = next((line for line in left if here in line), None)
        if after is None:
            return []
        left.remove(after)
        here = after[1] if after[0] == here else after[0]
    return loop
