"""A made house in the format of Structured3D's annotation_3d.json: an L-shaped bedroom and a
corridor, with a door between them, a window, and a column in the corridor."""

from typing import Any

import numpy as np

BEDROOM_MM = [(0, 0), (4000, 0), (4000, 3000), (2000, 3000), (2000, 5000), (0, 5000)]
CORRIDOR_MM = [(4120, 0), (5500, 0), (5500, 3000), (4120, 3000)]
COLUMN_MM = [(4900, 1400), (5100, 1400), (5100, 1600), (4900, 1600)]
OUTWALL_MM = [(-240, -240), (5740, -240), (5740, 5240), (-240, 5240)]
HEIGHT_MM = 2800


class House:
    """Junctions, lines and planes by their coordinates, so that shared ones are stored once."""

    def __init__(self) -> None:
        self.junctions: dict[tuple[float, ...], int] = {}
        self.lines: dict[frozenset[int], int] = {}
        self.planes: list[tuple[str, list[int], np.ndarray]] = []
        self.semantics: list[dict[str, Any]] = []

    def plane(self, kind: str, *loops: Any, inside: Any = (0.0, 0.0, 0.0)) -> int:
        """A plane bounded by loops of corners in millimetres; its normal points to `inside`."""
        own = []
        for loop in loops:
            rows = [self.junctions.setdefault(tuple(c), len(self.junctions)) for c in loop]
            for first, last in zip(rows, rows[1:] + rows[:1], strict=True):
                own.append(self.lines.setdefault(frozenset((first, last)), len(self.lines)))
        a, b, c = (np.array(corner, dtype=float) for corner in loops[0][:3])
        normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        self.planes.append((kind, own, normal if (inside - a) @ normal >= 0 else -normal))
        return len(self.planes) - 1

    def room(self, kind: str, outline: Any, holes: Any = (), column: Any = ()) -> None:
        """A room with floor, ceiling and walls; `holes` are cut out of the walls they lie in."""
        low, high = ([(*corner, z) for corner in outline] for z in (0, HEIGHT_MM))
        middle = (*np.mean(outline, axis=0), HEIGHT_MM / 2)
        columns = [[(*corner, 0) for corner in column]] if len(column) else []
        planes = [self.plane("floor", low, *columns, inside=middle)]
        planes.append(self.plane("ceiling", high, inside=middle))
        for a, b in zip(low, low[1:] + low[:1], strict=True):
            upright = [a, b, (b[0], b[1], HEIGHT_MM), (a[0], a[1], HEIGHT_MM)]
            cut = [hole for hole in holes if _in_wall(hole, a, b)]
            planes.append(self.plane("wall", upright, *cut, inside=middle))
        self.semantics.append({"ID": len(self.semantics), "type": kind, "planeID": planes})

    def hole(self, kind: str, near: Any, far: Any) -> None:
        """The four faces between the outlines of a hole in the two surfaces of a wall."""
        planes = []
        for row, what in enumerate(("floor", "wall", "ceiling", "wall")):
            after = (row + 1) % 4
            planes.append(self.plane(what, [near[row], near[after], far[after], far[row]]))
        self.semantics.append({"ID": len(self.semantics), "type": kind, "planeID": planes})

    def json(self) -> dict[str, Any]:
        """The content of the file."""
        points = [np.array(point, dtype=float) for point in self.junctions]
        ends = [sorted(pair) for pair in self.lines]
        plane_lines = np.zeros((len(self.planes), len(ends)), dtype=int)
        line_junctions = np.zeros((len(ends), len(points)), dtype=int)
        for row, (_, own, _) in enumerate(self.planes):
            plane_lines[row, own] = 1
        for row, pair in enumerate(ends):
            line_junctions[row, pair] = 1
        return {
            "junctions": [{"ID": k, "coordinate": p.tolist()} for k, p in enumerate(points)],
            "lines": [
                {"ID": k, "point": points[a].tolist(), "direction": _unit(points[b] - points[a])}
                for k, (a, b) in enumerate(ends)
            ],
            "planes": [
                {
                    "ID": k, "type": kind, "normal": normal.tolist(),
                    "offset": float(-normal @ points[ends[own[0]][0]]),
                }
                for k, (kind, own, normal) in enumerate(self.planes)
            ],
            "semantics": self.semantics,
            "planeLineMatrix": plane_lines.tolist(),
            "lineJunctionMatrix": line_junctions.tolist(),
            "cuboids": [],
            "manhattan": [],
        }  # fmt: skip


def made_house() -> dict[str, Any]:
    """The house; its rooms have the IDs 0 and 1, then come the door, the window and the outwall."""
    house = House()
    door = {x: [(x, 500, 0), (x, 1400, 0), (x, 1400, 2100), (x, 500, 2100)] for x in (4000, 4120)}
    window = {
        y: [(600, y, 900), (1500, y, 900), (1500, y, 2300), (600, y, 2300)] for y in (5000, 5240)
    }
    house.room("bedroom", BEDROOM_MM, [door[4000], window[5000]])
    house.room("corridor", CORRIDOR_MM, [door[4120]], COLUMN_MM)
    house.hole("door", door[4000], door[4120])
    house.hole("window", window[5000], window[5240])
    house.room("outwall", OUTWALL_MM, [window[5240]])
    outwall = house.semantics[-1]
    outwall["planeID"] = [p for p in outwall["planeID"] if house.planes[p][0] == "wall"]
    return house.json()


def _in_wall(hole: Any, a: Any, b: Any) -> bool:
    along = np.array(b[:2], dtype=float) - a[:2]
    offset = np.array(hole)[:, :2] - a[:2]
    return bool(np.allclose(offset @ [-along[1], along[0]], 0))


def _unit(vector: np.ndarray) -> list[float]:
    return (vector / np.linalg.norm(vector)).tolist()
