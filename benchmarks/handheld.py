"""The path of a handheld camera that scans a room."""

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.spatial.transform import Rotation

from data_prep.front.furnished import Room
from data_prep.front.views import camera_pose

EYE_M, WALL_M, AROUND_M = 1.5, 0.3, 0.2
"""Height of the camera, and its least distances from walls and from furniture."""
CLOSE_M = 1.2
"""Distance from an object that the camera keeps where the room allows it."""
VISITS, PAN = 2, 4
"""Pans to each object, and frames of a pan."""
HAND = 3.0, 0.03
"""Sway of the hand in degrees and metres."""
LASTING = 0.9
"""Correlation of the sway of one frame with that of the next."""


def walk(room: Room, rng: np.random.Generator) -> list[np.ndarray]:
    """Poses (4, 4), camera to room, of a camera that walks over the free floor and pans to every
    object `VISITS` times."""
    ends = [(m.min(axis=0), m.max(axis=0)) for m in (f.mesh.vertices_m for f in room.furniture)]
    in_the_way = [
        shapely.box(low[0], low[2], high[0], high[2]).buffer(AROUND_M)
        for low, high in ends
        if low[1] < EYE_M + AROUND_M
    ]
    free = room.floor.buffer(-WALL_M) - shapely.union_all(in_the_way)
    free = max(getattr(free, "geoms", [free]), key=lambda part: part.area)
    here, yaw, pitch = np.array(free.representative_point().coords[0]), rng.uniform(-3, 3), 0.3
    poses = []
    for k in np.concatenate([rng.permutation(len(ends)) for _ in range(VISITS)]):
        target = (ends[k][0] + ends[k][1]) / 2
        there = _next_place(free, here, target[[0, 2]], rng)
        x, z = target[[0, 2]] - there
        turn = (np.arctan2(x, z) - yaw + np.pi) % (2 * np.pi) - np.pi
        tilt = np.arctan2(EYE_M - target[1], np.hypot(x, z)).clip(-0.4, 0.8) - pitch
        for share in np.arange(1, PAN + 1) / PAN:
            x, z = here + share * (there - here)
            pose = camera_pose(np.array([x, EYE_M, z]), yaw + share * turn, pitch + share * tilt)
            poses.append(np.linalg.inv(pose))
        here, yaw, pitch = there, yaw + turn, pitch + tilt
    return swayed(poses, *HAND, rng)


def _next_place(
    free: shapely.Polygon, here: np.ndarray, target: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """A place in a straight line from here, over free floor; more than `CLOSE_M` from the target if
    one is found, else as far as possible."""
    x0, z0, x1, z1 = free.bounds
    places = [
        place
        for place in rng.uniform((x0, z0), (x1, z1), (100, 2))
        if free.covers(shapely.LineString([here, place]))
    ]
    far = [place for place in places if np.hypot(*(place - target)) > CLOSE_M]
    return far[0] if far else max([here, *places], key=lambda p: float(np.hypot(*(p - target))))


def swayed(
    poses: Sequence[np.ndarray], degrees: float, metres: float, rng: np.random.Generator
) -> list[np.ndarray]:
    """Turn and move cameras by random changes that last a few frames, of this root mean square."""
    change = rng.normal(size=(len(poses), 6))
    for k in range(1, len(poses)):
        change[k] = LASTING * change[k - 1] + np.sqrt(1 - LASTING**2) * change[k]
    change /= np.sqrt(3)
    moved = np.tile(np.eye(4), (len(poses), 1, 1))
    moved[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * change[:, :3]).as_matrix()
    moved[:, :3, 3] = metres * change[:, 3:]
    return [pose @ each for pose, each in zip(poses, moved, strict=True)]
