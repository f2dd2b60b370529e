"""Empty rooms with a known floor, and what views of them show of floor, walls and doors."""

from dataclasses import replace

import numpy as np

from sceneprior.core.cameras import Pinhole
from sceneprior.core.classes import STUFF
from sceneprior.core.observations import (
    RoomViews,
    observe,
    stuff_size,
    stuff_step,
    thinned_intrinsics,
)
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen import SoftwareRenderer

SIZE, HEIGHT_M = (180, 240), 2.5
L_SHAPE = [(-2.0, -1.5), (2.0, -1.5), (2.0, 0.3), (0.5, 0.3), (0.5, 1.5), (-2.0, 1.5)]
DOOR = ((-1.5, -1.495), (-0.6, -1.495))
"""Ends of a door 5 mm before the first wall."""


def shell_room(
    outline: list[tuple[float, float]],
    eyes: list[tuple[float, float]],
    block: tuple[float, float, float, float] | None = None,
    roll: int = 0,
    size: tuple[int, int] = SIZE,
) -> RoomViews:
    """Views around every eye (x, z), at a height of 1.5 m, of an empty room; `L_SHAPE` has a door.

    `block` is the footprint (x, z, x, z) of a box of 0.5 m, whose pixels are an object's. The
    cameras are rolled by `roll` quarter turns.
    """
    corners = np.array(outline)
    walls = [
        _quad(a, b, HEIGHT_M) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    x1, z1 = corners.min(axis=0)
    x2, z2 = corners.max(axis=0)
    ground = np.array([[x1, 0, z1], [x2, 0, z1], [x2, 0, z2], [x1, 0, z2]])
    parts = {
        "floor": [ground],
        "wall": walls,
        "door": [_quad(*DOOR, 2.0)] if outline == L_SHAPE else [],
        "ceiling": [ground + np.array([0, HEIGHT_M, 0])],
    }
    meshes = [_mesh(parts.get(name, [])) for name in STUFF[1:]]
    poses = np.stack([_pose(eye, yaw, roll) for eye in eyes for yaw in np.arange(8) * np.pi / 4])
    focal = size[1] / 2
    K = np.array([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]])
    small = thinned_intrinsics(K, stuff_step(size))
    renderer = SoftwareRenderer()

    def draw(what: list[Mesh], lens: np.ndarray, its_size: tuple[int, int]) -> np.ndarray:
        cameras = [Pinhole(pose, lens) for pose in poses]
        return renderer.instance_ids_of_views(what, cameras, its_size).astype(np.uint8)

    body = [] if block is None else [_box(*block)]
    stuff = draw(meshes, small, stuff_size(size)) * (draw(body, small, stuff_size(size)) == 0)
    seen = observe(draw(body, K, size), [1] * len(body))
    return replace(seen.room_views("shell", poses, K), stuff=stuff)


def _quad(a, b, height: float) -> np.ndarray:
    (x1, z1), (x2, z2) = a, b
    return np.array([[x1, 0, z1], [x2, 0, z2], [x2, height, z2], [x1, height, z1]])


def _box(x1: float, z1: float, x2: float, z2: float) -> Mesh:
    corners = [(x1, z1), (x2, z1), (x2, z2), (x1, z2)]
    sides = [_quad(a, b, 0.5) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    top = np.array([[x, 0.5, z] for x, z in corners])
    return _mesh([*sides, top])


def _mesh(quads: list[np.ndarray]) -> Mesh:
    first = 4 * np.arange(len(quads))[:, None, None]
    faces = (np.array([[0, 1, 2], [0, 2, 3]]) + first).reshape(-1, 3)
    return Mesh(np.concatenate([np.zeros((0, 3)), *quads]), faces.astype(np.int32))


def _pose(eye: tuple[float, float], yaw: float, roll: int) -> np.ndarray:
    """A camera that looks 20 degrees down."""
    pitch = np.radians(20)
    ahead = np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.cross(ahead, [0.0, 1, 0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead])
    cos, sin = np.rint([np.cos(roll * np.pi / 2), np.sin(roll * np.pi / 2)])
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ turn
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ (eye[0], 1.5, eye[1])
    return pose
