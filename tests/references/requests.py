"""Test of a room's JSON against a request, one object at a time; see docs/requests.md."""

import math
from typing import Any

import shapely


def meets(room: dict[str, Any], counts: list[tuple], relations: list[tuple], parts: dict) -> bool:
    """True if a room's JSON has numbers (label, least, most), relations (subject, relation, target,
    count), and the floor, openings and ceiling of `parts`."""
    items = [*room["objects"], *map(_opening, room.get("openings", []))]
    named = [item["class"] for item in items]
    good = all(least <= named.count(label) <= most for label, least, most in counts)
    for subject, relation, target, count in relations:
        found = 0
        for one in (o for o in items if o["class"] == subject):
            others = [o for o in items if o["class"] == target and o is not one]
            to_room = target is None and _to_room(relation, one, room["floor_m"])
            found += to_room or any(_related(relation, one, other) for other in others)
        if relation == "beside" and (subject, target, count) == ("nightstand", "double_bed", 2):
            found = max((_pairs(items, bed) for bed in items if bed["class"] == target), default=0)
        good &= found >= count
    added = [o for o in room["objects"] if tuple(o["center_m"]) not in parts.get("given", [])]
    if (size := parts.get("size")) is not None:
        x, z = zip(*room["floor_m"], strict=True)
        good &= (max(x) - min(x), max(z) - min(z)) == size
        floor = shapely.Polygon(room["floor_m"]).buffer(0.015, join_style="mitre")
        good &= all(floor.covers(_plan(o)) for o in added)
    if (ceiling_m := parts.get("ceiling_m")) is not None:
        tops = [o["center_m"][1] + o["size_m"][1] / 2 for o in added]
        good &= room["ceiling_m"] == ceiling_m and max(tops, default=0) <= ceiling_m + 1e-4
    if (side := parts.get("south")) is not None:
        here = [o for o in room.get("openings", []) if o["kind"] == side]
        low = max(z for _, z in room["floor_m"])
        good &= any(o["start_m"][1] == o["end_m"][1] == low for o in here)
    return good


def _opening(entry: dict[str, Any]) -> dict[str, Any]:
    """A door or window as a flat box."""
    (a, b), (c, d), low, high = (
        entry["start_m"], entry["end_m"], entry["bottom_m"], entry["top_m"]
    )  # fmt: skip
    return {
        "class": entry["kind"], "center_m": [(a + c) / 2, (low + high) / 2, (b + d) / 2],
        "size_m": [abs(a - c), high - low, abs(b - d)],
    }  # fmt: skip


def _plan(item: dict[str, Any]) -> shapely.Polygon:
    (x, _, z), (width, _, depth) = item["center_m"], item["size_m"]
    return shapely.box(x - width / 2, z - depth / 2, x + width / 2, z + depth / 2)


def _to_room(relation: str, item: dict[str, Any], floor_m: list[list[float]]) -> bool:
    outline = shapely.Polygon(floor_m).exterior
    if relation == "at a wall":
        return _plan(item).distance(outline) <= 0.2
    return min(_plan(item).distance(shapely.Point(corner)) for corner in floor_m) <= 0.4


def _related(relation: str, one: dict[str, Any], other: dict[str, Any]) -> bool:
    (x, _, z), (to_x, _, to_z) = one["center_m"], other["center_m"]
    apart_m = math.hypot(x - to_x, z - to_z)
    if relation == "near":
        return _plan(one).distance(_plan(other)) < 1
    if relation == "far from":
        return apart_m > 3
    if relation == "facing":
        return _before(one["yaw_rad"], to_x - x, to_z - z)
    if relation == "in front of":
        return _before(other["yaw_rad"], x - to_x, z - to_z) and apart_m <= 3
    assert relation == "beside"
    if other["class"] == "double_bed":
        return any(_beside_bed(one, other).values())
    along_x = abs(math.sin(other["yaw_rad"])) > 0.5
    gaps = [
        abs(one["center_m"][a] - other["center_m"][a]) - (one["size_m"][a] + other["size_m"][a]) / 2
        for a in (0, 2)
    ]
    along, across = gaps if along_x else gaps[::-1]
    return along < 0 and -0.05 <= across <= 0.5


def _beside_bed(one: dict[str, Any], bed: dict[str, Any]) -> dict[tuple[int, int], bool]:
    """Whether an object is beside a bed, at each end that may be its head (-1: the back), and on
    each side."""
    sine, cosine = round(math.sin(bed["yaw_rad"])), round(math.cos(bed["yaw_rad"]))
    wide, _, deep = bed["size_m"] if cosine else bed["size_m"][::-1]
    (x, _, z), (to_x, _, to_z) = one["center_m"], bed["center_m"]
    ahead, across = (x - to_x) * sine + (z - to_z) * cosine, (x - to_x) * cosine - (z - to_z) * sine
    own_wide, _, own_deep = one["size_m"] if cosine else one["size_m"][::-1]
    ends = (-1,)
    if deep <= wide:
        ends, (ahead, across) = (-1, 1), (across, ahead)
        (wide, deep), (own_wide, own_deep) = (deep, wide), (own_deep, own_wide)
    # From the long side, which is a line, to the object.
    to_line = max(abs(abs(across) - wide / 2) - own_wide / 2, 0)
    beyond = max(abs(ahead) - deep / 2 - own_deep / 2, 0)
    return {
        (end, side): ahead * end > 0
        and across * side > 0
        and abs(abs(ahead) - deep / 2) <= 0.5
        and math.hypot(to_line, beyond) <= 0.3
        for end in ends
        for side in (-1, 1)
    }


def _pairs(items: list[dict[str, Any]], bed: dict[str, Any]) -> int:
    """2 if two nightstands flank the head of a bed, and 1 if one is beside it."""
    beside = [_beside_bed(one, bed) for one in items if one["class"] == "nightstand"]
    keys = [{key for key, holds in each.items() if holds} for each in beside]
    return max(
        (sum(any((end, side) in own for own in keys) for side in (-1, 1)) for end in (-1, 1)),
        default=0,
    )


def _before(yaw_rad: float, x: float, z: float) -> bool:
    angle = math.atan2(x, z) - yaw_rad
    return math.cos(angle) >= math.cos(math.pi / 4) - 1e-6
