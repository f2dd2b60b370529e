"""A writer of small posed rooms: boxes, cameras, transforms.json, ids, a table of classes."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scan_files import BOX_FACES

from data_prep.engine.source import PreparedRoom, RoomTask
from data_prep.readers.posed.formats import read_formats
from data_prep.readers.posed.reader import Posed
from data_prep.readers.posed.recording import room_name
from sceneprior.render.offscreen.zbuffer import rasterize

SET = "void,bed,chair"
EYES = [(-2.0, -2, 1.6), (2.2, -2, 1.5), (2.4, 2.2, 1.7), (-2.2, 2, 1.5), (0.2, -2.6, 1.9)]


@dataclass
class Thing:
    """A box in a world with z up, metres; the floor is z = 0."""

    id: int
    name: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def corners(self) -> np.ndarray:
        bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
        return np.array([self.low, self.high], dtype=float)[bits, np.arange(3)]


def furniture(shift: float = 0.0) -> list[Thing]:
    """A bed, a chair and a thing of no class, far from each other's silhouettes in most views."""
    return [
        Thing(3, "bed", (-0.9 + shift, -0.8, 0.0), (0.5 + shift, 0.9, 0.5)),
        Thing(300, "Chair", (0.9, 0.4, 0.0), (1.3, 0.8, 0.9)),
        Thing(7, "backpack", (1.0, -0.9, 0.0), (1.3, -0.6, 0.4)),
    ]


@dataclass
class PosedRoom:
    """A room on disk; change the attributes below, then call `write`."""

    folder: Path
    things: list[Thing] = field(default_factory=furniture)
    size: tuple[int, int] = (96, 128)
    """(height, width)"""
    focal_px: float = 80.0
    poses: list[np.ndarray] = field(default_factory=list)
    """camera_to_world, OpenGL axes."""
    stem: Callable[[int], str] = "frame_{:05d}".format
    """Name of a view's picture."""

    def __post_init__(self) -> None:
        for eye in EYES:
            self.look(eye, (0.1, 0.1, 0.3))

    def look(self, eye: Sequence[float], target: Sequence[float]) -> None:
        """Add a camera."""
        back = np.subtract(eye, target).astype(float)
        back /= np.linalg.norm(back)
        right = np.cross((0.0, 0, 1), back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = eye
        self.poses.append(pose)

    def ids(self, view: int) -> np.ndarray:
        """(H, W) uint16: the thing that is nearest."""
        height, width = self.size
        index, _ = rasterize(
            np.concatenate([thing.corners for thing in self.things]),
            np.concatenate([BOX_FACES + 8 * k for k in range(len(self.things))]),
            np.linalg.inv(self.poses[view] @ np.diag([1.0, -1, -1, 1])),
            (self.focal_px, self.focal_px, width / 2, height / 2),
            self.size,
        )
        values = np.array([0, *(thing.id for thing in self.things)], dtype=np.uint16)
        return values[(index + len(BOX_FACES)) // len(BOX_FACES)]

    @property
    def data(self) -> dict[str, Any]:
        """transforms.json."""
        height, width = self.size
        return {
            "camera_model": "OPENCV", "fl_x": self.focal_px, "fl_y": self.focal_px,
            "cx": width / 2, "cy": height / 2, "w": width, "h": height, "k1": 0.0, "p1": 0,
            "aabb_scale": 16, "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
            "frames": [
                {"file_path": f"images/{self.stem(k)}.jpg", "transform_matrix": pose.tolist()}
                for k, pose in enumerate(self.poses)
            ],
        }  # fmt: skip

    def write(self, **changes: Any) -> "PosedRoom":
        """Write everything; `changes` are keys of transforms.json, None takes one away."""
        (self.folder / "instances").mkdir(parents=True, exist_ok=True)
        data = {**self.data, **changes}
        self.write_transforms({key: value for key, value in data.items() if value is not None})
        table = {str(thing.id): thing.name for thing in self.things}
        (self.folder / "classes.json").write_text(json.dumps(table))
        for view in range(len(self.poses)):
            Image.fromarray(self.ids(view)).save(self.png(view))
        return self

    def write_transforms(self, data: Any) -> None:
        (self.folder / "transforms.json").write_text(json.dumps(data))

    def png(self, view: int) -> Path:
        return self.folder / "instances" / f"{self.stem(view)}.png"

    def rename(self, stem: Callable[[int], str]) -> None:
        """Give the pictures other names."""
        old = [self.png(view) for view in range(len(self.poses))]
        self.stem = stem
        for view, path in enumerate(old):
            if path.is_file():
                path.rename(self.png(view))


def prepared(
    room: PosedRoom, label_set: str = SET, tools: Sequence[str] = (), **settings: Any
) -> PreparedRoom | None:
    """The room on disk as views; `tools` are values of `--from`."""
    reader = Posed(room.folder, classes=label_set, **read_formats(tools), **settings)
    name = room_name(room.folder)
    made = reader.prepare(RoomTask(name, name, "train"), None)
    return made if isinstance(made, PreparedRoom) else None
