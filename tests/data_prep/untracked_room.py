"""A furnished room whose masks have ids of single frames."""

import numpy as np
from posed_files import PosedRoom, Thing

from data_prep.readers.frames import room_cameras
from data_prep.tracks.associate import FrameMasks


def furnished(folder) -> PosedRoom:
    """Seven boxes, two of them side by side and alike, seen from twelve places."""
    things = [
        Thing(1, "bed", (-0.9, -0.8, 0.0), (0.5, 1.0, 0.5)),
        Thing(2, "chair", (0.9, 0.4, 0.0), (1.3, 0.8, 0.9)),
        Thing(3, "chair", (0.9, -0.3, 0.0), (1.3, 0.1, 0.9)),
        Thing(4, "cabinet", (-1.9, -0.5, 0.0), (-1.4, 0.3, 1.8)),
        Thing(5, "nightstand", (-0.9, 1.1, 0.0), (-0.5, 1.5, 0.5)),
        Thing(6, "nightstand", (0.1, 1.1, 0.0), (0.5, 1.5, 0.5)),
        Thing(7, "lamp", (-0.2, -0.1, 2.2), (0.2, 0.3, 2.5)),
    ]
    room = PosedRoom(folder, things, size=(120, 160), focal_px=80.0, poses=[])
    room.poses.clear()
    for k in range(12):
        angle = 2 * np.pi * k / 12
        target = (0.3 * np.cos(3 * angle), 0.3, 0.6 + 0.5 * (k % 3))
        room.look((2.6 * np.cos(angle), 2.6 * np.sin(angle), 1.5), target)
    return room


def frames(room: PosedRoom, seed: int = 0):
    """Masks with an id of their own, the true object of each, poses and intrinsics."""
    rng = np.random.default_rng(seed)
    names = sorted({thing.name for thing in room.things})
    ids, true, classes = [], [0], []
    for view in range(len(room.poses)):
        image = room.ids(view)
        own = np.zeros(image.shape, dtype=np.int32)
        for k in rng.permutation(np.unique(image[image > 0])).tolist():
            own[image == k] = len(true)
            true.append(k)
            classes.append(names.index(room.things[k - 1].name) + 1)
        ids.append(own)
    height, width = room.size
    lens = np.array([[room.focal_px, 0, width / 2], [0, room.focal_px, height / 2], [0, 0, 1]])
    poses = room_cameras(np.stack(room.poses) @ np.diag([1.0, -1, -1, 1]))
    masks = FrameMasks(np.stack(ids), np.array(classes))
    return masks, np.array(true), poses, np.broadcast_to(lens, (len(ids), 3, 3))
