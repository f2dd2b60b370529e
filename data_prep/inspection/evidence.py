"""Evidence for and against each camera mistake, from one room's masks and cameras alone.

The middle of a 2D box, in u or in v, is taken as the projection of one 3D point of its object, if
nothing cuts the box off along that axis. With the right cameras, these points exist and lie in
front of the cameras. Many hypotheses about the cameras are compared at once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import rankdata

from data_prep.inspection.agreement import NEAR_M, Room
from data_prep.inspection.causes import Cause, Convention, corrections
from data_prep.inspection.scale import LogSize, Scale, estimate_scale, floor_and_sizes
from data_prep.readers.upright import own_sides
from sceneprior.core.cameras import camera_centers
from sceneprior.core.observations import RoomViews

TOLERANCE, OF_BOX = 0.01, 0.15
"""Distance at which the agreement of a middle is one half: a share of the longer side of the image,
plus a share of the 2D box, whose middle is not exactly the projection of a fixed point."""
_MIDDLES_AT_MOST = 60
"""Maximum number of middles per object, thinned evenly; more only take longer."""
_MIDDLES_AT_LEAST = 5
"""Minimum number of middles per object; three determine a point."""
_ROUNDS = 6
_LEAST_VIEWS = 5
"""Minimum number of views for comparing the order of frames."""
_SAME_FLOOR_M = 0.1


class Evidence(NamedTuple):
    """Evidence of one room, or of several."""

    sums: dict[Cause, float]
    """Summed agreement (`fit`) of box middles with cameras, after the correction of each cause."""
    rooms: int
    middles: int
    spare: int
    """Number of box middles beyond those needed to determine the objects' points."""
    views: int
    ids: int
    masks: int
    once: int
    """Number of ids that occur in one view only."""
    nearness: float | None
    """Negated rank correlation, over pairs of views, between the pixels on common objects and the
    angle between the cameras; about 0 if poses belong to other frames. None for few views."""
    tops: tuple[float, float, float]
    """Mean direction of the tops of the pictures in the room frame; y should be up."""
    eye_m: float
    """Median height of the cameras."""
    floor_m: float | None
    """Height of the bottoms of the lowest objects (`find_floor`); None if few of them agree."""
    sizes: tuple[LogSize, ...] = ()
    """Sizes of objects of known classes."""

    @property
    def scale(self) -> Scale | None:
        """Scale by the sizes; None if few are known."""
        return estimate_scale(self.sizes)

    def share(self, cause: Cause) -> float:
        """Mean agreement in [0, 1] after a correction."""
        return self.sums.get(cause, 0.0) / max(self.middles, 1)

    @property
    def counts(self) -> str:
        """Text with the mean number of ids per image, and of images per id."""
        return (
            f"{self.masks / max(self.views, 1):.1f} ids per image, "
            f"{self.masks / max(self.ids, 1):.1f} images per id"
        )


def room_evidence(
    views: RoomViews, convention: Convention, names: Sequence[str] | None
) -> Evidence:
    """Compare the masks of one room with its cameras as they are and corrected.

    The height of the floor and the sizes of objects, whose classes are of the list `names`, are
    left out if it is None: they take longer than everything else.
    """
    found, rooms = middles(views), corrections(Room(views), convention)
    poses = np.stack([room.views.world_to_camera for room in rooms.values()])
    lenses = np.stack([room.views.intrinsics for room in rooms.values()])
    agreement = fit(found, poses, lenses)
    floor_m, sizes = (None, ()) if names is None else floor_and_sizes(views, names)
    shown = views.visible.sum(axis=0)
    x, y, z = (-poses[0, :, 1, :3]).mean(axis=0).tolist()
    return Evidence(
        dict(zip(rooms, agreement.sum(axis=1).tolist(), strict=True)),
        rooms=1,
        middles=len(found.item),
        spare=found.spare,
        views=len(views.visible),
        ids=int((shown > 0).sum()),
        masks=int(shown.sum()),
        once=int((shown == 1).sum()),
        nearness=_nearness(views),
        tops=(x, y, z),
        eye_m=float(np.median(camera_centers(poses[0])[:, 1])),
        floor_m=floor_m,
        sizes=sizes,
    )


def total(rooms: list[Evidence]) -> Evidence:
    """Combine the evidence of several rooms: sums of counts, medians or means of other values.

    The height of the floor is None if few rooms know it, or if they differ.
    """

    def known(name: str) -> list[float]:
        return [value for room in rooms if (value := getattr(room, name)) is not None]

    causes = {cause: None for room in rooms for cause in room.sums}
    counts = ("rooms", "middles", "spare", "views", "ids", "masks", "once")
    x, y, z = np.mean([room.tops for room in rooms], axis=0).tolist()
    nearness, floors = known("nearness"), known("floor_m")
    level = float(np.median(floors)) if floors else 0.0
    same = sum(abs(floor - level) < _SAME_FLOOR_M for floor in floors)
    agreed = same >= min(len(rooms), 2) and 3 * same >= 2 * len(floors)
    return Evidence(
        {cause: sum(room.sums.get(cause, 0.0) for room in rooms) for cause in causes},
        **{name: sum(getattr(room, name) for room in rooms) for name in counts},
        nearness=float(np.mean(nearness)) if nearness else None,
        tops=(x, y, z),
        eye_m=float(np.median(known("eye_m"))),
        floor_m=level if floors and agreed else None,
        sizes=tuple(size for room in rooms for size in room.sizes),
    )


def _nearness(views: RoomViews) -> float | None:
    """See `Evidence.nearness` (the statistic of Mantel, Cancer Research 1967, on ranks)."""
    if len(views.visible) < _LEAST_VIEWS:
        return None
    turns = views.world_to_camera[:, :3, :3].astype(np.float64)
    cosines = np.einsum("aij,bij->ab", turns, turns)  # 2 cos(angle between views) + 1
    pixels = views.mask_pixels * views.visible
    parts = pixels / np.maximum(pixels.sum(axis=1, keepdims=True), 1)
    shared = np.minimum(parts[:, None], parts[None]).sum(axis=-1)
    pairs = np.triu_indices(len(turns), 1)
    ranks = np.stack([rankdata(cosines[pairs].round(6)), rankdata(shared[pairs].round(6))])
    if (np.ptp(ranks, axis=1) == 0).any():
        return None
    return float(np.corrcoef(ranks)[0, 1])


class Middles(NamedTuple):
    """The m middles of a room's 2D boxes, sorted by object."""

    view: np.ndarray
    """(m,)"""
    item: np.ndarray
    """(m,) number of the object, from 0 without gaps; not its index in the room."""
    axis: np.ndarray
    """(m,) 0 for u, 1 for v."""
    place_px: np.ndarray
    """(m,)"""
    slack_px: np.ndarray
    """(m,) distance at which the agreement is one half."""

    @property
    def spare(self) -> int:
        """Number of middles beyond the three that determine each object's point."""
        return len(self.item) - 3 * len(np.unique(self.item))


def middles(views: RoomViews) -> Middles:
    """Find the middles of 2D boxes that nothing cuts off, for objects with enough middles."""
    own = own_sides(views, views.image_size)
    whole = np.moveaxis(own[..., :2] & own[..., 2:], 1, 0)  # of each object, view and axis
    rows = []
    for k, of_object in enumerate(whole):
        places = np.argwhere(of_object)
        if len(places) >= _MIDDLES_AT_LEAST:
            even = np.linspace(0, len(places) - 1, min(len(places), _MIDDLES_AT_MOST)).round()
            rows += [(view, k, axis) for view, axis in places[even.astype(int)]]
    view, item, axis = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    boxes = views.boxes.astype(np.float64) * np.tile(Room(views).size_px, 2)
    low, high = boxes[view, item, axis], boxes[view, item, axis + 2]
    slack = TOLERANCE * max(views.image_size) + OF_BOX * (high - low)
    number = np.unique(item, return_inverse=True)[1]
    return Middles(view, number, axis, (low + high) / 2, slack)


def fit(found: Middles, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Agreement of each middle with each of h hypotheses about the cameras, (h, m) in [0, 1].

    The agreement is 1 / (1 + (r / slack)^2) for the distance r in pixels from the middle to the
    object's projected point, which is a robust least-squares solution. r is divided by one minus
    the middle's leverage, and so approximates the distance to the point that the other middles
    determine. Points behind the camera score 0.

    Args:
        world_to_camera: (h, T, 4, 4), OpenCV axes; the world frame and its unit are arbitrary.
        intrinsics: (h, T, 3, 3)
    """
    if not len(found.item):
        return np.zeros((len(world_to_camera), 0))
    rows = np.arange(len(found.item))
    starts = np.flatnonzero(np.diff(found.item, prepend=-1))
    # Poses are moved and scaled: cameras then stand about 2 m from the origin, their middle.
    eyes = camera_centers(world_to_camera)
    middle = eyes.mean(axis=1, keepdims=True)
    unit = np.sqrt(((eyes - middle) ** 2).sum(axis=-1).mean(axis=1)) / 2
    unit = np.maximum(unit, 1e-9)
    scaled = world_to_camera.copy()
    scaled[..., :3, 3] += (world_to_camera[..., :3, :3] @ middle[..., None])[..., 0]
    scaled[..., :3, 3] /= unit[:, None, None]
    poses = scaled[:, found.view, :3]
    focal = intrinsics[:, found.view, found.axis, found.axis]
    center = intrinsics[:, found.view, found.axis, 2]
    # A middle and the camera's axis span a plane, `planes @ (x, y, z, 1) = 0`, that contains the
    # point.
    planes = focal[..., None] * poses[:, rows, found.axis]
    planes = planes + (center - found.place_px)[..., None] * poses[:, :, 2]
    weight = 1 / np.abs(focal)
    for _ in range(_ROUNDS):
        weighted = planes * weight[..., None]
        products = weighted[..., :3, None] * weighted[..., None, :]
        sums = np.add.reduceat(products, starts, axis=1)
        square = sums[..., :3]
        loose = 1e-9 * np.trace(square, axis1=-2, axis2=-1) + 1e-12
        square = square + loose[..., None, None] * np.eye(3)
        points = np.linalg.solve(square, -sums[..., 3:])[..., 0][:, found.item]
        depth = (poses[:, :, 2, :3] * points).sum(axis=-1) + poses[:, :, 2, 3]
        far = np.maximum(np.abs(depth), NEAR_M)
        off = ((planes[..., :3] * points).sum(axis=-1) + planes[..., 3]) / far
        weight = 1 / (far * found.slack_px * np.sqrt(1 + (off / found.slack_px) ** 2))
    inverse, weighted = np.linalg.inv(square)[:, found.item], weighted[..., :3]
    leverage = np.einsum("hmi,hmij,hmj->hm", weighted, inverse, weighted)
    off = off / np.maximum(1 - leverage, 1e-3)
    return np.where(depth > NEAR_M, 1 / (1 + (off / found.slack_px) ** 2), 0.0)
