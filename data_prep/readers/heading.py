"""Finds the direction of a room's walls and furniture from images of ids, to align it with the
axes.

Most edges of walls and furniture are vertical, or run along one of two horizontal directions at
right angles. A mask's edge and the camera's centre span a plane, which contains only one horizontal
direction. So each pixel of an outline votes for that direction, modulo 90 degrees, and the most
frequent direction is the room's. Depths, the floor and 3D boxes are not needed.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Integer
from scipy import ndimage

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.cameras import rigid
from sceneprior.core.observations import RoomViews, stuff_step, thinned, thinned_intrinsics

ALIGNED_DEG = 1.0
"""Maximum angle between a room's direction and an axis at which the room is not turned."""
SECOND = 0.7
"""Maximum votes of a second direction, as a share of the first direction's votes."""
AGREE_DEG = 2.0
"""Maximum difference between the direction found in all views and in either half of the views."""
_SIDE_PX = 480
"""Approximate longer side of the images whose outlines are used."""
_VIEWS = 60
"""Maximum number of views that are used, spread evenly."""
_SMOOTH_PX = 4.0
"""Standard deviation of the Gaussian that smooths a mask before edge directions are computed."""
_LEAST_SLOPE = 0.1
"""Minimum vertical component of the unit normal of an edge's plane; below it, the edge may be
vertical."""
_MOST_CHANGE = 4.0
"""Maximum derivative of the voted direction with respect to the edge's direction in the image. It
is large for edges near the camera's height, from which no direction can be determined."""
_BINS, _WIDTH_DEG, _NEAR_DEG, _APART_DEG = 360, 0.75, 2.0, 5.0
"""Number of bins in a quarter turn; standard deviation by which votes are spread; maximum distance
of votes that are averaged; minimum distance of a second direction."""
_QUARTER = np.pi / 2


class _Votes(NamedTuple):
    """Directions, as yaws about +y, for which the pixels of outlines vote."""

    yaw_rad: Float[np.ndarray, " votes"]
    weight: Float[np.ndarray, " votes"]
    view: Int[np.ndarray, " votes"]


def find_turn(views: RoomViews) -> float | None:
    """Find the angle in degrees by which a room must turn about +y, so that most of its edges run
    along x and z: from -45 to 45, 0 for a room that is aligned to `ALIGNED_DEG`.

    Outlines of objects (void included) and stuff vote, in evenly spread views. `views` must include
    the images of ids; y points up. None if the direction is uncertain: too few edges, two
    directions, or different directions in different views. The angle is rounded to 0.01 degrees, so
    that it does not depend on the last bits of sums.
    """
    assert views.instance_ids is not None, "read with images"
    count = len(views.world_to_camera)
    rows = np.unique(np.linspace(0, count - 1, min(count, _VIEWS)).round().astype(int))
    step = max(1, round(max(views.image_size) / _SIDE_PX))
    layers = [(views.instance_ids[(..., *thinned(step))], step)]
    if views.stuff is not None:
        layers.append((views.stuff, stuff_step(views.image_size)))
    found = [
        _votes_of_image(images[row], views.world_to_camera[row], K[row], place)
        for images, step in layers
        for K in [thinned_intrinsics(views.intrinsics, step)]
        for place, row in enumerate(rows)
    ]
    votes = _Votes(*(np.concatenate(part) for part in zip(*found, strict=True)))
    halves = [_Votes(*(part[votes.view % 2 == half] for part in votes)) for half in (0, 1)]
    whole, *others = (_most_voted(part) for part in (votes, *halves))
    if whole is None or whole[1] > SECOND:
        return None
    for half in others:
        if half is None or abs(_folded(half[0] - whole[0])) > np.radians(AGREE_DEG):
            return None
    degrees = round(float(-np.degrees(_folded(whole[0]))), 2)
    return degrees if abs(degrees) > ALIGNED_DEG else 0.0


def turn_matrix(degrees: float) -> Float[np.ndarray, "4 4"]:
    """Rigid transform that turns a world about +y."""
    return rigid(yaw_rotation(np.radians(degrees)))


def note_of_turn(degrees: float | None) -> list[str]:
    """Note for the report on the result of `find_turn`; empty for a room that is aligned."""
    if degrees is None:
        return ["no direction of walls or furniture is found, so the room is not turned"]
    return [f"turned by {degrees:.2f} degrees, along its walls and furniture"] if degrees else []


def _folded(yaw_rad: Any) -> Any:
    """Reduce an angle to -45 to 45 degrees by adding whole quarter turns."""
    return (yaw_rad + _QUARTER / 2) % _QUARTER - _QUARTER / 2


def _votes_of_image(
    image: Integer[np.ndarray, "height width"],
    world_to_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    view: int,
) -> _Votes:
    """Votes of the outlines in one image of ids.

    An edge through (u, v) with the normal (g, h) in the image lies in the plane through the camera
    whose normal is N = R^T K^T (g, h, -g u - h v). The horizontal directions within this plane,
    cross(N, y), and across it, (N_x, 0, N_z), are at right angles, so that the yaw of the second
    can be voted for.
    """
    height, width = image.shape
    margin = int(3 * _SMOOTH_PX)
    to_world = intrinsics.astype(np.float64) @ world_to_camera[:3, :3].astype(np.float64)
    parts = [np.zeros((2, 0))]
    for label, place in enumerate(ndimage.find_objects(image), start=1):
        if place is None:
            continue
        rows, columns = (slice(max(0, side.start - margin), side.stop + margin) for side in place)
        mask = image[rows, columns] == label
        y, x = np.nonzero(mask & ~ndimage.binary_erosion(mask, border_value=1))
        soft = mask.astype(np.float32)
        g, h = (
            ndimage.gaussian_filter(soft, _SMOOTH_PX, order, mode="nearest", truncate=3)[y, x]
            for order in ((0, 1), (1, 0))
        )
        u, v = x + columns.start + 0.5, y + rows.start + 0.5
        # The image border is not an edge, and the two sides of a narrow mask blur into one.
        inner = (np.minimum(u, width - u) > margin) & (np.minimum(v, height - v) > margin)
        inner &= np.hypot(g, h) > 0.5 / (_SMOOTH_PX * np.sqrt(2 * np.pi))
        g, h, u, v = (values[inner].astype(np.float64) for values in (g, h, u, v))
        normal = np.stack([g, h, -g * u - h * v], axis=1) @ to_world
        # Derivative of the normal as the edge rotates about its pixel.
        change = np.stack([-h, g, h * u - g * v], axis=1) @ to_world
        level = np.maximum(normal[:, 0] ** 2 + normal[:, 2] ** 2, 1e-12)
        speed = np.abs(change[:, 0] * normal[:, 2] - change[:, 2] * normal[:, 0]) / level
        sloping = np.abs(normal[:, 1]) > _LEAST_SLOPE * np.linalg.norm(normal, axis=1)
        used = sloping & (speed < _MOST_CHANGE)
        yaw_rad = np.arctan2(normal[used, 0], normal[used, 2])
        parts.append(np.stack([yaw_rad, 1 / (1 + speed[used] ** 2)]))
    yaw_rad, weight = np.concatenate(parts, axis=1)
    return _Votes(yaw_rad, weight, np.full(len(weight), view))


def _most_voted(votes: _Votes) -> tuple[float, float] | None:
    """The most frequent direction, averaged over the votes near it, as a yaw in radians; and the
    votes of the second as a share of the first's. None without votes."""
    if not len(votes.weight):
        return None
    bins = np.floor(votes.yaw_rad % _QUARTER * (_BINS / _QUARTER)).astype(np.int64) % _BINS
    counts = np.bincount(bins, votes.weight, _BINS)
    smooth = ndimage.gaussian_filter1d(counts, _WIDTH_DEG * _BINS / 90, mode="wrap")
    top = int(smooth.argmax())
    yaw_rad = (top + 0.5) * _QUARTER / _BINS
    apart = np.abs(_folded((np.arange(_BINS) - top) * (_QUARTER / _BINS))) > np.radians(_APART_DEG)
    for _ in range(5):
        off = _folded(votes.yaw_rad - yaw_rad)
        near = np.abs(off) < np.radians(_NEAR_DEG)
        yaw_rad += float(np.average(off[near], weights=votes.weight[near]))
    return yaw_rad, float(smooth[apart].max() / smooth[top])
