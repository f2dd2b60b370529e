"""A made scan as the release has them: one mesh of a walled room, seen from inside of it.

The mesh is the surface of voxels, welded: triangles at the border of two objects have corners of
both. Walls, a half-open door and a pillar that nobody annotated stand before the furniture.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scan_files import TABLE, Box, ScanFolder, alignment

VOXEL_M = 0.04
ROOM_TABLE = [
    *TABLE,
    ("28", "door", "door", "2038", "8", "door"),
    ("4", "table", "table", "1170", "7", "table"),
]
NOTHING, UNLABELLED = -1, 10_000
_SHIFT = -0.4
"""Offset of the first voxel's corner in metres."""


@dataclass
class RoomScan(ScanFolder):
    """`boxes` are the annotated objects, `unlabelled` the others."""

    unlabelled: list[Box] = field(default_factory=list)

    @cached_property
    def labelled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices in the aligned frame, faces, and the box of each vertex."""
        every = [*enumerate(self.boxes), *((UNLABELLED, box) for box in self.unlabelled)]
        far = np.max([box.high for _, box in every], axis=0)
        shape = np.ceil((far - _SHIFT) / VOXEL_M).astype(int) + 2
        owner = np.full(shape, NOTHING)
        for k, box in every:
            low, high = (
                np.round((np.array(end) - _SHIFT) / VOXEL_M).astype(int)
                for end in (box.low, box.high)
            )
            owner[tuple(slice(a, max(b, a + 1)) for a, b in zip(low, high, strict=True))] = k
        return _surface(owner)

    @property
    def mesh(self):
        vertices, faces, owner = self.labelled
        inverse = np.linalg.inv(self.alignment)
        segments = np.where(owner == UNLABELLED, UNLABELLED, 10 * owner + 3 * (vertices[:, 0] > 1))
        return vertices @ inverse[:3, :3].T + inverse[:3, 3], faces, segments

    def mask(self, frame, size=None):
        """A triangle is of the object that has most of its corners."""
        owner = self.labelled[2][self.labelled[1]]
        most = np.where(owner[:, 1] == owner[:, 2], owner[:, 1], owner[:, 0])
        index, _ = self.nearest(self.poses[frame], size or self.size)
        values = np.zeros(UNLABELLED + 2, dtype=np.uint8)
        values[[k + 1 for k in range(len(self.boxes))]] = [k + 1 for k in self.ids]
        return np.where(index < 0, 0, values[most[index] + 1]).astype(np.uint8)


def _surface(owner):
    """The faces of voxels between something and nothing: vertices, triangles, owners."""
    corners, owners = [], []
    for axis in range(3):
        for outwards in (0, 1):
            beside = np.roll(owner, -1 if outwards else 1, axis=axis)
            cells = np.argwhere((owner != NOTHING) & (beside == NOTHING))
            first, second = [k for k in range(3) if k != axis]
            quad = np.zeros((4, 3), dtype=int)
            quad[:, axis] = outwards
            quad[:, first], quad[:, second] = [0, 1, 1, 0], [0, 0, 1, 1]
            corners.append(cells[:, None] + quad)
            owners.append(owner[tuple(cells.T)])
    quads, owners = np.concatenate(corners), np.concatenate(owners)
    points, number = np.unique(quads.reshape(-1, 3), axis=0, return_inverse=True)
    number = number.reshape(-1, 4)
    of_point = np.full(len(points), UNLABELLED)
    # A corner that several share is of the first, so of walls and floors before furniture.
    np.minimum.at(of_point, number.ravel(), np.repeat(owners, 4))
    faces = np.concatenate([number[:, [0, 1, 2]], number[:, [0, 2, 3]]])
    # Borders are ragged: one in ten of the corners there is of the other object, and then again.
    rng = np.random.default_rng(0)
    for _ in range(2):
        at_border = faces[of_point[faces].min(axis=1) != of_point[faces].max(axis=1)]
        ragged = at_border[rng.random(len(at_border)) < 0.1]
        other = ragged[np.arange(len(ragged)), of_point[ragged].argmin(axis=1)]
        of_point[other] = of_point[ragged].max(axis=1)
    return points * VOXEL_M + _SHIFT, faces, of_point


def make_room_scan(folder: Path) -> RoomScan:
    """A room of 5.2 x 4 m, furnished, with 49 frames from its free space."""
    scan = RoomScan(
        folder,
        [
            Box("wall", (-0.16, -0.16, 0), (5.36, 0, 2.4)),
            Box("wall", (-0.16, 4.0, 0), (5.36, 4.16, 2.4)),
            Box("wall", (-0.16, 0, 0), (0, 4.0, 2.4)),
            Box("wall", (5.2, 0, 0), (5.36, 4.0, 2.4)),
            Box("wall", (2.4, 0.0, 0), (2.56, 1.44, 2.4)),  # juts out into the room
            Box("door", (3.92, 3.12, 0), (4.0, 4.0, 2.0)),
            Box("floor", (0, 0, -0.08), (5.2, 4.0, 0.0)),
            Box("bed", (0.08, 0.08, 0.0), (1.6, 1.92, 0.56)),
            Box("nightstand", (1.76, 0.08, 0.0), (2.16, 0.48, 0.56)),
            Box("couch", (0.08, 3.2, 0.0), (1.92, 3.92, 0.72)),
            Box("chair", (3.04, 0.48, 0.0), (3.52, 0.96, 0.88)),
            Box("table", (4.16, 0.16, 0.0), (5.04, 1.44, 0.72)),
            Box("chair", (4.4, 3.28, 0.0), (4.88, 3.76, 0.88)),
            Box("chair", (4.56, 2.08, 0.0), (5.04, 2.56, 0.88)),
            Box("backpack", (2.72, 3.52, 0.0), (3.04, 3.84, 0.48)),
        ],
        alignment(),
        unlabelled=[Box("", (2.56, 2.4, 0.0), (2.8, 2.64, 2.4))],
    )
    targets = [(0.8, 1.0), (2.0, 0.3), (1.0, 3.5), (3.3, 0.7), (4.6, 0.8), (4.6, 3.5), (4.8, 2.3)]
    eyes = [(1.2, 2.6), (2.0, 2.4), (3.4, 3.4), (3.6, 1.9), (2.2, 3.1), (4.0, 2.0), (0.5, 2.4)]
    for number, (x, y) in enumerate(eyes):
        for k in range(7):
            target = targets[(number + k) % len(targets)]
            scan.look((x, y, 1.4 + 0.05 * number), (*target, 0.45))
    return scan
