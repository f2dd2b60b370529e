"""Sides of objects that no view shows, moved to the floor, the walls and the ceiling.

The smallest box that explains the masks ends where the last ray needs it: a wardrobe seen from its
front alone becomes a slab, and a bed floats above its hidden feet.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.lifting import HANGS_M
from sceneprior.lifted.lifting.hulls import EMPTY, Sightings, carve

ALONG_AXIS = 0.99
"""Smallest cosine of the angle between a wall's normal and an axis; boxes follow no other walls."""
SAME_M = 0.15
"""Distance from another wall's line within which a wall counts as the same."""
AT_WALL_M = 0.02
"""Distance from a wall at which sides are placed: the median of made and of ProcTHOR's rooms."""
CLOSE_M = 0.05
"""Distance from a wall's line, on both sides of it, within which a side is always moved."""
FAR_M = 1.0
"""Distance from a wall or the floor beyond which no hidden side is moved to it."""
LEAST_M = 0.02
"""Extent that an object in the line of a wall keeps when its side is moved, unless it has less."""
HIDDEN = 0.75
"""Share of the cells between a side and a plane that must be hidden behind the object."""
CELLS = 8
"""Cells along each axis of the space between a side and a plane."""


def planes_of(walls: Sequence[Wall], ceiling_m: float | None) -> Float[np.ndarray, "planes 4"]:
    """Floor, walls and, if its height is known, ceiling: normals into the room, then offsets. A
    wall near the plane of one before it adds none."""
    planes = [np.array([0.0, 1, 0, 0])]
    planes += [] if ceiling_m is None else [np.array([0.0, -1, 0, -ceiling_m])]
    for wall in walls:
        plane = np.array([wall.inward[0], 0, wall.inward[1], wall.inward @ wall.start_m])
        middle_m = np.insert((wall.start_m + wall.end_m) / 2, 1, 0.0)
        if not any(
            plane[:3] @ other[:3] > ALONG_AXIS and abs(middle_m @ other[:3] - other[3]) < SAME_M
            for other in planes
        ):
            planes.append(plane)
    return np.array(planes)


def moved_to_planes(
    seen: Sightings, sides_m: Float[np.ndarray, "2 3"], planes: Float[np.ndarray, "planes 4"]
) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner of an object's box, with hidden sides moved to planes (`planes_of`).

    A side `CLOSE_M` from a wall's line is moved to `AT_WALL_M` before it; a lower side within
    `HANGS_M` of the floor to it; and the upper side of an object that hangs free, as near to the
    ceiling, to that. A side up to `FAR_M` from a wall or the floor is moved if the space between is
    `HIDDEN`: the views that show the object do not see past it there.
    """
    sides_m, at_wall = sides_m.copy(), False
    for axis, end in ((1, 0), (0, 0), (0, 1), (2, 0), (2, 1), (1, 1)):
        outwards, ceiling = 2 * end - 1, (axis, end) == (1, 1)
        own = planes[outwards * planes[:, axis] < -ALONG_AXIS]
        middle_m, close_m = sides_m.mean(axis=0), HANGS_M if axis == 1 else CLOSE_M
        middle_m[axis] = sides_m[end, axis]
        gaps_m = own[:, :3] @ middle_m - own[:, 3]
        gap_m = gaps_m[gaps_m >= -close_m].min(initial=np.inf)
        stands = at_wall or sides_m[0, 1] <= HANGS_M
        if gap_m > (close_m if ceiling else FAR_M) or (ceiling and stands):
            continue
        if gap_m > close_m:
            space_m = sides_m.copy()
            space_m[1 - end, axis] = sides_m[end, axis]
            space_m[end, axis] += outwards * gap_m
            hull = carve(seen, space_m[0], space_m[1], CELLS, reach=0.0, most_empty=1.0)
            if (hull.emptiness <= EMPTY).mean() < HIDDEN:
                continue
        at_wall |= axis != 1
        spare_m = max(float(np.ptp(sides_m[:, axis])) - LEAST_M, 0.0)
        sides_m[end, axis] += outwards * max(gap_m - (AT_WALL_M if axis != 1 else 0), -spare_m)
    return sides_m
