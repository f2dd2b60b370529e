"""Evidence for and against each camera mistake, from one room's masks and cameras alone."""

from typing import NamedTuple

import numpy as np
from scipy.stats import rankdata

from data_prep.inspection.causes import GIVEN, Cause, Convention, corrected
from data_prep.inspection.triangulation import Middles, fit, middles
from data_prep.readers.posed.floor import find_floor
from sceneprior.core.cameras import camera_centers
from sceneprior.core.shards import RoomViews

_LEAST_VIEWS = 5
"""Minimum number of views for comparing the order of frames."""

_SAME_FLOOR_M = 0.1
_PIECES = 3
"""Minimum number of pieces that determine a room's floor: two lamps may hang at the same height."""


class Evidence(NamedTuple):
    """Evidence of one room."""

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
    measured: int
    """Number of objects whose lengths are known."""
    nearness: float | None
    """Negated rank correlation, over pairs of views, between the pixels on common objects and the
    angle between the cameras; about 0 if poses belong to other frames. None for few views."""
    tops: tuple[float, float, float]
    """Mean direction of the tops of the pictures in the room frame; y should be up."""
    eye_m: float
    """Median height of the cameras."""
    length_m: float | None
    """Median length of the objects; None without any."""
    floor_m: float | None
    """Height of the bottoms of the lowest objects (`find_floor`); None if few of them agree."""

    def share(self, cause: Cause) -> float:
        """Mean agreement in [0, 1] after a correction."""
        return self.sums.get(cause, 0.0) / max(self.middles, 1)


def room_evidence(views: RoomViews, convention: Convention, floor: bool = True) -> Evidence:
    """Compare the masks of one room, read with images, with its cameras as they are and corrected.

    `floor` also estimates the height of the floor, which takes longer than everything else.
    """
    found, cameras = middles(views), corrected(views, convention)
    agreement, depth = fit(found, *map(np.stack, zip(*cameras.values(), strict=True)))
    sums = dict(zip(cameras, agreement.sum(axis=1).tolist(), strict=True))
    poses, lenses = cameras[GIVEN]
    turns = poses[:, :3, :3]
    eyes = camera_centers(poses)
    level = find_floor(views, poses, lenses) if floor else None  # type: ignore[arg-type]
    shown = views.visible.sum(axis=0)
    x, y, z = (-turns[:, 1]).mean(axis=0).tolist()
    return Evidence(
        sums, 1, len(found.item), found.spare, len(views.visible), int((shown > 0).sum()),
        int(shown.sum()), int((shown == 1).sum()), len(np.unique(found.item)),
        _nearness(views), (x, y, z), float(np.median(eyes[:, 1])), _length(found, depth[0], lenses),
        None if level is None or level[1] < _PIECES else level[0],
    )  # fmt: skip


def total(rooms: list[Evidence]) -> Evidence:
    """Combine the evidence of several rooms: sums of counts, medians or means of other values."""
    causes = {cause: None for room in rooms for cause in room.sums}
    sums = {cause: sum(room.sums.get(cause, 0.0) for room in rooms) for cause in causes}
    names = ("rooms", "middles", "spare", "views", "ids", "masks", "once", "measured")
    counts = {name: sum(getattr(room, name) for room in rooms) for name in names}
    x, y, z = np.mean([room.tops for room in rooms], axis=0).tolist()
    nearness, length, floor = (
        [value for room in rooms if (value := getattr(room, name)) is not None]
        for name in ("nearness", "length_m", "floor_m")
    )
    return Evidence(
        sums,
        **counts,
        nearness=float(np.mean(nearness)) if nearness else None,
        tops=(x, y, z),
        eye_m=float(np.median([room.eye_m for room in rooms])),
        length_m=float(np.median(length)) if length else None,
        floor_m=_usual(floor, len(rooms)),
    )


def _usual(floors: list[float], rooms: int) -> float | None:
    """Median height of the estimated floors; None if there are few, or if they differ."""
    if not floors:
        return None
    middle = float(np.median(floors))
    same = sum(abs(floor - middle) < _SAME_FLOOR_M for floor in floors)
    return middle if same >= min(rooms, 2) and 3 * same >= 2 * len(floors) else None


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


def _length(found: Middles, depth: np.ndarray, lenses: np.ndarray) -> float | None:
    sizes_m = found.extent_px * depth / lenses[found.view, found.axis, found.axis]
    lengths = [sizes_m[found.item == k].max() for k in np.unique(found.item)]
    lengths = [length for length in lengths if length > 0]
    return float(np.median(lengths)) if lengths else None
