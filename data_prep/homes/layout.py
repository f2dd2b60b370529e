"""Layout of a room: empty rooms, their pieces, and the tests that a piece fits and one can walk.

Floor coordinates are x and z in metres; the room's outer rectangle starts at (0, 0). A positive
yaw rotates a piece's front from +z towards +x. The axis-aligned bounding boxes of two pieces may
not overlap: stricter than necessary, but it keeps the 3D ground truth free of overlaps.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import shapely

from sceneprior.core.shell import Wall, walls_of
from sceneprior.furniture.catalog import Model
from sceneprior.furniture.solids import Vector

Rect = tuple[float, float, float, float]
"""Rectangle on the floor: x0, z0, x1, z1."""

SEATS = ("double_bed", "single_bed", "kids_bed", "sofa", "desk", "dressing_table")
"""Classes in front of which chairs, benches and coffee tables stand."""

CEILING_GAP_M = 0.03
"""Minimum gap between a tall piece and the ceiling."""

DOOR_M = 0.9
"""Width of a door, and depth of the clear floor in front of it."""

FREE_SHARE = 0.45
"""Minimum share of the floor without furniture."""

WINDOW_CLEAR_M = 0.3
"""Depth of the floor in front of a window without higher furniture."""

SHOULDERS_M = 0.2
"""Half of the minimum width of a passage."""


@dataclass(frozen=True)
class Piece:
    """A placed model: centre of its bottom, yaw, and a scale per axis."""

    model: Model
    scale: Vector
    x: float = 0.0
    z: float = 0.0
    yaw_rad: float = 0.0
    y: float = 0.0

    def at(self, x: float, z: float, yaw_rad: float, y: float = 0.0) -> "Piece":
        """Copy of the piece at another place."""
        return replace(self, x=float(x), z=float(z), yaw_rad=float(yaw_rad), y=float(y))

    @property
    def size_m(self) -> Vector:
        """Width, height and depth after scaling, along the piece's own axes."""
        (w, h, d), (kx, ky, kz) = self.model.size_m, self.scale
        return w * kx, h * ky, d * kz

    @property
    def rect(self) -> Rect:
        """Axis-aligned bounding rectangle on the floor."""
        half_x, half_z = self.half_extent(self.yaw_rad)
        return self.x - half_x, self.z - half_z, self.x + half_x, self.z + half_z

    @property
    def top(self) -> float:
        """Height of the highest point."""
        return self.y + self.size_m[1]

    def half_extent(self, yaw_rad: float) -> tuple[float, float]:
        """Half extents along x and z of the piece's box, rotated by this yaw."""
        sin, cos = abs(np.sin(yaw_rad)), abs(np.cos(yaw_rad))
        width, _, depth = self.size_m
        return (width * cos + depth * sin) / 2, (width * sin + depth * cos) / 2

    def ahead(self, forward: float, sideways: float = 0.0) -> tuple[float, float]:
        """Point on the floor `forward` metres in front of the centre, `sideways` along its +x."""
        sin, cos = np.sin(self.yaw_rad), np.cos(self.yaw_rad)
        return self.x + forward * sin + sideways * cos, self.z + forward * cos - sideways * sin

    def clearance(self, reach: float) -> Rect:
        """Floor in front of an axis-aligned piece, as wide as the piece and `reach` deep."""
        half_width, half_depth = self.size_m[0] / 2, self.size_m[2] / 2
        xa, za = self.ahead(half_depth, -half_width)
        xb, zb = self.ahead(half_depth + reach, half_width)
        return min(xa, xb), min(za, zb), max(xa, xb), max(za, zb)


def point_by(wall: Wall, along_m: float, off_m: float) -> tuple[float, float]:
    """Point on the floor `along_m` metres from the wall's start, `off_m` metres from the wall."""
    x, z = wall.start_m + along_m * wall.direction + off_m * wall.inward
    return float(x), float(z)


def yaw_at(wall: Wall) -> float:
    """Yaw of a piece whose back is to the wall."""
    x, z = wall.inward + 0.0  # turns -0.0 into 0.0, whose angle has the other sign
    return float(np.arctan2(x, z))


def rect_at(wall: Wall, middle: float, width: float, depth: float) -> Rect:
    """Rectangle of floor in front of a part of a wall."""
    (xa, za), (xb, zb) = (
        point_by(wall, middle + side * width / 2, off) for side, off in ((-1, 0.0), (1, depth))
    )
    return min(xa, xb), min(za, zb), max(xa, xb), max(za, zb)


class Window(NamedTuple):
    """A window: its wall, its middle along the wall, its width, and its heights above the floor."""

    wall: Wall
    middle: float
    width: float
    sill: float
    top: float


def overlaps(a: Rect, b: Rect, gap: float = 0.0) -> bool:
    """Test whether two rectangles are closer than `gap`."""
    in_x = a[0] < b[2] + gap and b[0] < a[2] + gap
    return in_x and a[1] < b[3] + gap and b[1] < a[3] + gap


def grown(rect: Rect, margin: float) -> Rect:
    """The rectangle with all sides moved outwards."""
    x0, z0, x1, z1 = rect
    return x0 - margin, z0 - margin, x1 + margin, z1 + margin


@dataclass
class Layout:
    """A room being furnished."""

    width: float
    depth: float
    height: float
    notch: Rect | None
    """Corner rectangle cut out of an L-shaped room."""
    pieces: list[Piece] = field(default_factory=list)
    kept_clear: list[Rect] = field(default_factory=list)
    """Floor that stays empty: first at the door, then in front of storage."""
    kept_for_seats: list[Rect] = field(default_factory=list)
    """Floor in front of `SEATS`, for pieces that belong to them."""
    door: tuple[Wall, float] = field(init=False)
    """Wall of the door, and the middle of the door along it."""
    windows: list[Window] = field(default_factory=list)
    """Windows; nothing higher than their sills stands before them."""

    @property
    def area(self) -> float:
        """Floor area in square metres."""
        x0, z0, x1, z1 = self.notch or (0.0, 0.0, 0.0, 0.0)
        return self.width * self.depth - (x1 - x0) * (z1 - z0)

    @property
    def beside_notch(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Ranges of x and of z beside the notch; without a notch, those of the whole room."""
        if self.notch is None:
            return (0.0, self.width), (0.0, self.depth)
        x0, z0, x1, z1 = self.notch
        range_x = (x1, self.width) if x0 == 0 else (0.0, x0)
        return range_x, (z1, self.depth) if z0 == 0 else (0.0, z0)

    @property
    def outline(self) -> list[tuple[float, float]]:
        """Corners of the floor, counter-clockwise seen in the (x, z) plane."""
        w, d = self.width, self.depth
        corners = [(0.0, 0.0), (w, 0.0), (w, d), (0.0, d)]
        if not self.notch:
            return corners
        x0, z0, x1, z1 = self.notch
        notch = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
        hit = next(k for k, corner in enumerate(corners) if corner in notch)
        # The notch replaces this corner by three; the middle one is the corner opposite to it.
        inner = [notch[(hit + step) % 4] for step in (-1, 2, 1)]
        return [*corners[:hit], *inner, *corners[hit + 1 :]]

    @property
    def walls(self) -> list[Wall]:
        """Walls, one per side of the outline."""
        return walls_of(np.array(self.outline))

    def fits(self, piece: Piece, crowding: bool = False) -> bool:
        """Test whether the piece fits; with `crowding`, it may stand on floor kept for seats."""
        rect = piece.rect
        hangs = piece.y > 0
        if not self.holds(rect, 0.004) or piece.top > self.height - (0 if hangs else CEILING_GAP_M):
            return False
        for other in self.pieces:
            apart = piece.y >= other.top or other.y >= piece.top
            if not apart and overlaps(rect, other.rect, 0.008):
                return False
        closed = self.kept_clear if crowding else self.kept_clear + self.kept_for_seats
        seen = [
            rect_at(*each[:3], WINDOW_CLEAR_M) for each in self.windows if piece.top > each.sill
        ]
        return hangs or not any(overlaps(rect, clear) for clear in [*closed, *seen])

    def add(self, piece: Piece, clearance: float = 0.0, crowding: bool = False) -> bool:
        """Add the piece if it fits, and keep `clearance` metres in front of it clear."""
        if not self.fits(piece, crowding):
            return False
        if clearance:
            clear = piece.clearance(clearance)
            standing = [other.rect for other in self.pieces if other.y == 0]
            if not self.holds(clear) or any(overlaps(clear, other) for other in standing):
                return False
            seat = piece.model.name in SEATS
            (self.kept_for_seats if seat else self.kept_clear).append(clear)
        self.pieces.append(piece)
        return True

    def holds(self, rect: Rect, gap: float = 0.0) -> bool:
        """Test whether the rectangle lies inside the room, at least `gap` from its walls."""
        x0, z0, x1, z1 = rect
        if x0 < gap or z0 < gap or x1 > self.width - gap or z1 > self.depth - gap:
            return False
        return self.notch is None or not overlaps(rect, self.notch, gap)


def empty_room(
    rng: np.random.Generator, area_m2: float, sides_m: tuple[float, float], l_shaped_chance: float
) -> Layout:
    """Sample a rectangular or L-shaped room of about this area, with a door.

    The sides of its bounding rectangle lie within `sides_m`.
    """
    aspect = rng.uniform(1.0, 1.55)
    long = float(np.clip(np.sqrt(area_m2 * aspect), *sides_m))
    short = float(np.clip(area_m2 / long, *sides_m))
    width, depth = (long, short) if rng.random() < 0.5 else (short, long)
    width, depth = round(width, 2), round(depth, 2)
    notch = None
    if rng.random() < l_shaped_chance and short > sides_m[0] + 0.4:
        notch_x = round(width * rng.uniform(0.15, 0.35), 2)
        notch_z = round(depth * rng.uniform(0.15, 0.35), 2)
        x0 = 0.0 if rng.random() < 0.5 else round(width - notch_x, 2)
        z0 = 0.0 if rng.random() < 0.5 else round(depth - notch_z, 2)
        notch = (x0, z0, round(x0 + notch_x, 2), round(z0 + notch_z, 2))
    layout = Layout(width, depth, round(float(rng.uniform(2.6, 3.0)), 2), notch)
    # The door is near one end of a wall, and the floor in front of it stays clear.
    walls = [wall for wall in layout.walls if wall.length_m > 1.8]
    wall = walls[rng.integers(len(walls))]
    middle = 0.1 + DOOR_M / 2
    if rng.random() < 0.5:
        middle = wall.length_m - middle
    layout.door = wall, middle
    layout.kept_clear.append(rect_at(wall, middle, DOOR_M, DOOR_M))
    others = [other for other in walls if other is not wall]
    for other in rng.permutation(len(others))[: rng.choice([1, 2], p=[0.7, 0.3])]:
        layout.windows.append(_window(rng, others[other]))
    return layout


def _window(rng: np.random.Generator, wall: Wall) -> Window:
    """Sample a window near the middle of a wall."""
    width = round(rng.uniform(0.9, min(2.1, wall.length_m - 0.8)), 2)
    middle = wall.length_m / 2 + rng.uniform(-0.2, 0.2) * (wall.length_m - width)
    sill = float(rng.choice([0.8, 0.9, 1.0]))
    return Window(wall, round(middle, 2), width, sill, float(rng.choice([2.1, 2.2, 2.3])))


def is_liveable(layout: Layout, reach: tuple[str, ...]) -> bool:
    """Test whether enough floor is free and each class in `reach` is reachable from the door."""
    standing = [piece for piece in layout.pieces if piece.y == 0]
    covered = sum(piece.size_m[0] * piece.size_m[2] for piece in standing)
    if covered > (1 - FREE_SHARE) * layout.area:
        return False
    floor = shapely.Polygon(layout.outline).buffer(-SHOULDERS_M, join_style="mitre")
    shapes = [shapely.box(*piece.rect) for piece in standing]
    walkable = floor - shapely.union_all(shapes).buffer(SHOULDERS_M, join_style="mitre")
    door = layout.kept_clear[0]
    entrance = shapely.Point((door[0] + door[2]) / 2, (door[1] + door[3]) / 2)
    areas = list(getattr(walkable, "geoms", [walkable]))
    here = next((area for area in areas if area.contains(entrance)), None)
    if here is None:
        return False
    at_hand = here.buffer(2.5 * SHOULDERS_M)
    return all(
        at_hand.intersects(shape)
        for piece, shape in zip(standing, shapes, strict=True)
        if piece.model.name in reach
    )
