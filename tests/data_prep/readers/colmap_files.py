"""A writer of COLMAP's models, of the rooms of `posed_files`."""

import struct
from collections.abc import Iterator

import numpy as np
from posed_files import PosedRoom
from scipy.spatial.transform import Rotation

SCALE = 2.5
TURN = Rotation.from_euler("xyz", [110, -25, 40], degrees=True).as_matrix()
"""COLMAP's worlds lie as they come, in units of their own."""
PARAMETERS = {
    "SIMPLE_PINHOLE": (0, "{f} {cx} {cy}"),
    "PINHOLE": (1, "{f} {f} {cx} {cy}"),
    "SIMPLE_RADIAL": (2, "{f} {cx} {cy} -0.2"),
    "OPENCV": (4, "{f} {f} {cx} {cy} -0.2 0.05 0.001 -0.002"),
    "OPENCV_FISHEYE": (5, "{f} {f} {cx} {cy} 0.05 -0.01 0.002 0"),
    "FULL_OPENCV": (6, "{f} {f} {cx} {cy} 0 0 0 0 0 0 0 0"),
}


def colmap_poses(room: PosedRoom) -> Iterator[list[float]]:
    """(quaternion w, x, y, z and translation) from COLMAP's world to the camera, of each view."""
    for pose in room.poses:
        turn = (TURN @ pose[:3, :3] @ np.diag([1.0, -1, -1])).T
        eye = SCALE * TURN @ pose[:3, 3]
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        yield [float(value) for value in (w, x, y, z, *(-turn @ eye))]


def write_colmap(
    room: PosedRoom, model: str, binary: bool, folder: str = "sparse/0", most: int = 99
) -> None:
    """cameras and images of a model as COLMAP's documentation has them, in an odd order; `most` of
    the views are in it."""
    room.write()
    (room.folder / "transforms.json").unlink()
    place = room.folder / folder
    place.mkdir(parents=True)
    height, width = room.size
    number, form = PARAMETERS[model]
    text = form.format(f=room.focal_px, cx=width / 2, cy=height / 2)
    views = list(enumerate(colmap_poses(room)))[most::-1]
    names = [f"images/{room.stem(k)}.jpg" for k in range(len(room.poses))]
    if not binary:
        (place / "cameras.txt").write_text(f"# Camera list\n7 {model} {width} {height} {text}\n")
        lines = ["# Image list with two lines of data per image:"]
        for k, pose in views:
            lines.append(f"{k + 1} {' '.join(map(repr, pose))} 7 {names[k]}")
            lines.append("" if k % 2 else "1.5 2.5 -1 3.5 4.5 12")
        (place / "images.txt").write_text("\n".join(lines) + "\n")
        return
    values = [float(word) for word in text.split()]
    cameras = struct.pack("<QiiQQ", 1, 7, number, width, height)
    (place / "cameras.bin").write_bytes(cameras + struct.pack(f"<{len(values)}d", *values))
    images = struct.pack("<Q", len(views))
    for k, pose in views:
        images += struct.pack("<i7di", k + 1, *pose, 7) + names[k].encode() + b"\0"
        images += struct.pack("<Q", k) + k * struct.pack("<ddq", 1.5, 2.5, -1)
    (place / "images.bin").write_bytes(images)
