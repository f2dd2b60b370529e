"""A writer of small scans in ScanNet's format: .sens, zips, JSONs and a binary PLY."""

import io
import json
import struct
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TABLE = [
    ("id", "raw_category", "category", "count", "nyu40id", "nyu40class"),
    ("1", "wall", "wall", "8277", "1", "wall"),
    ("3", "floor", "floor", "1553", "2", "floor"),
    ("2", "chair", "chair", "4646", "5", "chair"),
    ("11", "bed", "bed", "370", "4", "bed"),
    ("19", "couch", "couch", "502", "6", "sofa"),
    ("62", "nightstand", "night stand", "224", "32", "night stand"),
    ("96", "backpack", "backpack", "479", "40", "otherprop"),
]

SCANNET_K = np.array([[1170.0, 0, 647.75, 0], [0, 1170, 483.75, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def write_table(path: Path, rows: Iterable[Sequence[str]] = TABLE) -> Path:
    path.write_text("".join("\t".join(row) + "\n" for row in rows))
    return path


def sens_bytes(
    poses: Sequence[np.ndarray],
    colors: Sequence[bytes],
    size: tuple[int, int] = (968, 1296),
    kind: int = 2,
    K: np.ndarray = SCANNET_K,
    name: bytes = b"StructureSensor",
    version: int = 4,
    depth: bytes = b"depth",
    imu: int = 0,
) -> bytes:
    """A recording; `size` is (height, width) of the colour pictures."""
    file = io.BytesIO()
    file.write(sens_header(len(poses), size, kind, K, name, version))
    for frame, (pose, color) in enumerate(zip(poses, colors, strict=True)):
        file.write(frame_header(pose, frame, len(color), len(depth)) + color + depth)
    file.write(struct.pack("<Q", imu) + bytes(128 * imu))
    return file.getvalue()


def sens_header(
    frames: int,
    size: tuple[int, int] = (968, 1296),
    kind: int = 2,
    K: np.ndarray = SCANNET_K,
    name: bytes = b"StructureSensor",
    version: int = 4,
) -> bytes:
    matrices = [K, np.eye(4), np.diag([570.0, 570, 1, 1]), np.eye(4)]
    return (
        struct.pack("<IQ", version, len(name))
        + name
        + np.array(matrices, dtype="<f4").tobytes()
        + struct.pack("<ii", kind, 1)
        + struct.pack("<4I", size[1], size[0], 640, 480)
        + struct.pack("<fQ", 1000.0, frames)
    )


def frame_header(pose: np.ndarray, frame: int, color: int, depth: int) -> bytes:
    times = 33_333 * frame, 33_333 * frame + 5
    return np.asarray(pose, dtype="<f4").tobytes() + struct.pack("<4Q", *times, color, depth)


def png(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    return file.getvalue()


def write_zip(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """Write a mesh as mLib does: coloured vertices, triangles as lists."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment MLIB generated\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = np.zeros(len(vertices), dtype=[("xyz", "<f4", 3), ("rgba", "u1", 4)])
    points["xyz"], points["rgba"] = vertices, 255
    lists = np.zeros(len(faces), dtype=[("n", "u1"), ("corners", "<i4", 3)])
    lists["n"], lists["corners"] = 3, faces
    path.write_bytes(header.encode() + points.tobytes() + lists.tobytes())
    return path


BOX_FACES = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5),
     (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
)  # fmt: skip


@dataclass
class Box:
    """An object of a made scan, in the aligned frame (z up, metres)."""

    category: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    object_id: int = -1
    """-1: the next."""

    @property
    def corners(self) -> np.ndarray:
        ends = np.array([self.low, self.high], dtype=float)
        bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
        return ends[bits, np.arange(3)]


@dataclass
class ScanFolder:
    """A scan on disk; `alignment` maps the scan's own frame to the aligned one."""

    folder: Path
    boxes: list[Box]
    alignment: np.ndarray
    poses: list[np.ndarray] = field(default_factory=list)
    """camera_to_world in the scan's own frame, OpenCV axes."""
    K: np.ndarray = field(default_factory=lambda: SCANNET_K.copy())
    size: tuple[int, int] = (968, 1296)

    def path(self, ending: str) -> Path:
        return self.folder / f"{self.folder.name}{ending}"

    @property
    def ids(self) -> list[int]:
        return [k if box.object_id < 0 else box.object_id for k, box in enumerate(self.boxes)]

    def look(self, eye: Sequence[float], target: Sequence[float]) -> None:
        """Add a frame whose camera stands and looks so, in the aligned frame."""
        forward = np.subtract(target, eye).astype(float)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0, 1))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = eye
        self.poses.append(np.linalg.inv(self.alignment) @ pose)

    def lose(self) -> None:
        """Add a frame whose pose was lost, as the release marks it."""
        self.poses.append(np.full((4, 4), -np.inf))

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices in the scan's own frame, faces, and the segment of each vertex."""
        vertices = np.concatenate([box.corners for box in self.boxes])
        inverse = np.linalg.inv(self.alignment)
        faces = np.concatenate([BOX_FACES + 8 * k for k in range(len(self.boxes))])
        # Two segments an object, with gaps in the numbers, as in the release.
        segments = np.repeat(np.arange(len(self.boxes)), 8) * 10 + np.tile(
            [0, 0, 3, 3], 2 * len(self.boxes)
        )
        return vertices @ inverse[:3, :3].T + inverse[:3, 3], faces, segments

    def mask(self, frame: int, size: tuple[int, int] | None = None) -> np.ndarray:
        """(H, W) uint8, objectId + 1 of what is nearest in each pixel."""
        if not np.isfinite(self.poses[frame]).all():
            return np.zeros(size or self.size, dtype=np.uint8)
        index, _ = self.nearest(self.poses[frame], size or self.size)
        values = np.array([0, *[k + 1 for k in self.ids]], dtype=np.uint8)
        return values[(index + len(BOX_FACES)) // len(BOX_FACES)]

    def nearest(self, pose: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Nearest triangle of the mesh (-1 = none), and its depth, in each pixel."""
        from sceneprior.render.offscreen.zbuffer import rasterize

        down, across = size[0] / self.size[0], size[1] / self.size[1]
        vertices, faces, _ = self.mesh
        # ScanNet counts pixel centres in whole numbers, the rasteriser puts them at one half.
        lens = (
            self.K[0, 0] * across, self.K[1, 1] * down,
            (self.K[0, 2] + 0.5) * across, (self.K[1, 2] + 0.5) * down,
        )  # fmt: skip
        return rasterize(vertices, faces, np.linalg.inv(pose), lens, size)

    def write(self, mask_size: tuple[int, int] | None = None, **changes: Any) -> "ScanFolder":
        """Write every file but those whose ending is given as None: `sens=None`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        vertices, faces, segments = self.mesh
        numbers = " ".join(f"{value:.9f}" for value in self.alignment.ravel())
        groups = [
            {
                "id": k, "objectId": number, "label": box.category,
                "segments": [10 * k, 10 * k + 3],
            }
            for k, (box, number) in enumerate(zip(self.boxes, self.ids, strict=True))
        ]  # fmt: skip
        self.path(".sens").write_bytes(
            sens_bytes(self.poses, [b"jpeg"] * len(self.poses), self.size, K=self.K)
        )
        self.path(".txt").write_text(
            f"axisAlignment = {numbers} \ncolorHeight = {self.size[0]}\n"
            "numColorFrames = 7\nsceneType = Bedroom / Hotel\n"
        )
        self.path(".aggregation.json").write_text(
            json.dumps({"sceneId": f"scannet.{self.folder.name}", "segGroups": groups})
        )
        self.path("_vh_clean_2.0.010000.segs.json").write_text(
            json.dumps({"params": {"kThresh": "0.0001"}, "segIndices": segments.tolist()})
        )
        write_ply(self.path("_vh_clean_2.ply"), vertices, faces)
        write_zip(
            self.path("_2d-instance-filt.zip"),
            {
                f"instance-filt/{frame}.png": png(self.mask(frame, mask_size))
                for frame in range(len(self.poses))
            },
        )
        return self


def alignment() -> np.ndarray:
    """A turn by 0.6 rad about z, and a move: what axisAlignment is in the release."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]]
    matrix[:3, 3] = -1.5, 2.0, -0.07
    return matrix


def make_scan(folder: Path) -> ScanFolder:
    """A bed, a chair and a backpack on a floor, seen by six cameras; the third has no pose."""
    scan = ScanFolder(
        folder,
        [
            Box("floor", (-0.5, -0.5, 0.0), (4.5, 3.5, 0.04)),
            Box("bed", (0.0, 0.0, 0.05), (2.0, 1.5, 0.65)),
            Box("chair", (3.0, 2.0, 0.05), (3.5, 2.5, 0.95)),
            Box("backpack", (3.0, 0.3, 0.05), (3.4, 0.6, 0.6)),
        ],
        alignment(),
    )
    for k, eye in enumerate(
        [(-2.5, -2, 2.5), (5, -2.5, 1.8), None, (6, 4, 2.2), (0.5, 5.5, 2.0), (-2, 4, 1.6)]
    ):
        if eye is None:
            scan.lose()
        else:
            scan.look(eye, (1.9, 1.2 + 0.05 * k, 0.5))
    return scan
