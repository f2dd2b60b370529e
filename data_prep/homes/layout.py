"""Where a piece may stand: a room and what is in it.

Floor coordinates are x and z in metres, the room's outer rectangle from (0, 0). A yaw of a
radians turns a piece's front from +z towards +x. No two boxes may overlap, seen along the
room's own axes: stricter than a shopper's eye, and it keeps 3D ground truth free of overlap.
"""

from dataclasses import dataclass, field

import numpy as np

from data_prep.homes.catalog import Model

Vector = tuple[float, float, float]

Rect = tuple[float, float, float, float]
"""x0, z0, x1, z1 on the floor."""

CEILING_GAP_M = 0.03
"""Room left between a tall piece and the ceiling."""


@dataclass(frozen=True)
class Piece:
    """A model at its place: middle of its bottom, yaw, and a scale for each of its axes."""

    model: Model
    x: float
    z: float
    yaw_rad: float
    scale: Vector
    y: float = 0.0

    @property
    def size_m(self) -> Vector:
        """Width, height, depth after scaling, along the piece's own axes."""
        return scaled(self.model, self.scale)

    @property
    def extent(self) -> tuple[float, float]:
        """Half extents of its box along the room's x and z."""
        return half_extent(self.size_m, self.yaw_rad)

    @property
    def rect(self) -> Rect:
        """Its box on the floor, along the room's axes."""
        half_x, half_z = self.extent
        return self.x - half_x, self.z - half_z, self.x + half_x, self.z + half_z

    @property
    def top(self) -> float:
        """Height of its highest point."""
        return self.y + self.size_m[1]

    def ahead(self, forward: float, sideways: float = 0.0) -> tuple[float, float]:
        """The floor point `forward` before its middle and `sideways` to its own +x."""
        sin, cos = np.sin(self.yaw_rad), np.cos(self.yaw_rad)
        return self.x + forward * sin + sideways * cos, self.z + forward * cos - sideways * sin


def scaled(model: Model, scale: Vector) -> Vector:
    """Width, height and depth of a model after scaling."""
    (w, h, d), (kx, ky, kz) = model.size_m, scale
    return w * kx, h * ky, d * kz


def half_extent(size_m: Vector, yaw_rad: float) -> tuple[float, float]:
    """Half extents along x and z of a box turned by a yaw."""
    sin, cos = abs(np.sin(yaw_rad)), abs(np.cos(yaw_rad))
    width, _, depth = size_m
    return (width * cos + depth * sin) / 2, (width * sin + depth * cos) / 2


@dataclass(frozen=True)
class Wall:
    """A straight wall: where it starts, which way it runs, how far, and the way it faces."""

    x: float
    z: float
    along: tuple[int, int]
    length: float
    yaw_rad: float
    """The yaw of a piece whose back is to this wall."""


def apron_of(piece: Piece, reach: float) -> Rect:
    """The floor before a piece that stands square to the room, as wide as it, `reach` deep."""
    half_width, half_depth = piece.size_m[0] / 2, piece.size_m[2] / 2
    (xa, za), (xb, zb) = (
        piece.ahead(half_depth, -half_width),
        piece.ahead(half_depth + reach, half_width),
    )
    return min(xa, xb), min(za, zb), max(xa, xb), max(za, zb)


def overlaps(a: Rect, b: Rect, gap: float = 0.0) -> bool:
    """Whether two rectangles come closer than `gap`."""
    in_x = a[0] < b[2] + gap and b[0] < a[2] + gap
    return in_x and a[1] < b[3] + gap and b[1] < a[3] + gap


@dataclass
class Plan:
    """A room being furnished."""

    width: float
    depth: float
    height: float
    notch: Rect | None
    """The corner that an L-shaped room lacks."""
    pieces: list[Piece] = field(default_factory=list)
    kept_clear: list[Rect] = field(default_factory=list)
    """Floor where nothing may stand: first before the door, then before wardrobe doors."""

    @property
    def area(self) -> float:
        """Floor area in square metres."""
        lost = 0.0
        if self.notch:
            x0, z0, x1, z1 = self.notch
            lost = (x1 - x0) * (z1 - z0)
        return self.width * self.depth - lost

    @property
    def outline(self) -> list[tuple[float, float]]:
        """Corners of the floor, counter-clockwise seen in the (x, z) plane."""
        w, d = self.width, self.depth
        corners = [(0.0, 0.0), (w, 0.0), (w, d), (0.0, d)]
        if not self.notch:
            return corners
        x0, z0, x1, z1 = self.notch
        bite = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
        hit = next(k for k, corner in enumerate(corners) if corner in bite)
        # Walk into the notch: the corner gives way to three, of which the middle is its far one.
        far = bite[(hit + 2) % 4]
        before, after = bite[(hit - 1) % 4], bite[(hit + 1) % 4]
        return [*corners[:hit], before, far, after, *corners[hit + 1 :]]

    @property
    def walls(self) -> list[Wall]:
        """One wall for each side of the outline."""
        corners = self.outline
        walls = []
        for (x0, z0), (x1, z1) in zip(corners, corners[1:] + corners[:1], strict=True):
            length = abs(x1 - x0) + abs(z1 - z0)
            along = (int(np.sign(x1 - x0)), int(np.sign(z1 - z0)))
            # Inside lies to the left of the walk: the normal is (-along_z, along_x).
            walls.append(Wall(x0, z0, along, length, float(np.arctan2(-along[1], along[0]))))
        return walls

    def fits(self, piece: Piece, crowding: bool = False) -> bool:
        """Whether the piece stands free inside; `crowding` lets it block all but the door."""
        rect = piece.rect
        if rect[0] < 0.004 or rect[1] < 0.004:
            return False
        if rect[2] > self.width - 0.004 or rect[3] > self.depth - 0.004:
            return False
        hangs = piece.y > 0
        if piece.top > self.height - (0.0 if hangs else CEILING_GAP_M):
            return False
        if self.notch and overlaps(rect, self.notch, 0.004):
            return False
        for other in self.pieces:
            apart = piece.y >= other.top or other.y >= piece.top
            if not apart and overlaps(rect, other.rect, 0.008):
                return False
        if hangs:
            return True
        closed = self.kept_clear[:1] if crowding else self.kept_clear
        return not any(overlaps(rect, clear) for clear in closed)

    def add(self, piece: Piece, apron: float = 0.0, crowding: bool = False) -> Piece | None:
        """Stand the piece there if it fits, and keep `apron` metres before it clear."""
        if not self.fits(piece, crowding):
            return None
        clear = apron_of(piece, apron) if apron else None
        if clear and not self._is_free_floor(clear):
            return None
        self.pieces.append(piece)
        if clear:
            self.kept_clear.append(clear)
        return piece

    def _is_free_floor(self, rect: Rect) -> bool:
        if rect[0] < 0 or rect[1] < 0 or rect[2] > self.width or rect[3] > self.depth:
            return False
        if self.notch and overlaps(rect, self.notch):
            return False
        return not any(piece.y == 0 and overlaps(rect, piece.rect) for piece in self.pieces)
