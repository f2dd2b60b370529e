"""Agreement between the projected 3D objects of a room and their 2D masks."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from data_prep.inspection.bodies import KINDS, Body
from data_prep.inspection.projection import box_iou_2d, boxes_around
from data_prep.readers.upright import own_sides
from sceneprior.core.shards import RoomViews

MARGIN = 0.02
"""Tolerance by which a mask may exceed its object's projection, relative to the image's longer
side. A pose error of 5 cm has this effect at a distance of 2.5 m, in views of 90 degrees."""
HELD_AT_LEAST = {"mesh": 0.95, "box": 0.8}
"""Minimum share of masks that lie within their projections. Occluders and the image border only
shrink masks, so with correct poses all masks should. Shuffled cameras reach 0.07 to 0.15."""
IOU_AT_LEAST = {"mesh": 0.85, "box": 0.5}
"""Minimum mean IoU of the 2D boxes of fully visible objects. A mesh and its mask agree to the
pixel, except for parts thinner than a pixel. The corners of a 3D box project beyond its object's
silhouette, and annotated boxes are fitted to incomplete scans."""
ROOM_SHARE = 0.7
"""Share of both minima that each room must reach, so that one wrong room does not go unnoticed
among many correct ones."""


class Tally(NamedTuple):
    """Sums over objects and views."""

    masks: int = 0
    held: int = 0
    """Number of masks within their projections."""
    whole: int = 0
    """Number of masks of fully visible objects."""
    iou: float = 0.0
    """IoU between the 2D boxes of mask and projection, summed over the fully visible objects."""

    @property
    def share(self) -> float:
        """Share of the masks that lie within their projections."""
        return self.held / max(self.masks, 1)

    @property
    def mean_iou(self) -> float:
        """Mean IoU over the fully visible objects; NaN if there are none."""
        return self.iou / self.whole if self.whole else float("nan")


@dataclass(frozen=True)
class Agreement:
    """Sums of comparisons, by type of 3D representation."""

    tallies: dict[str, Tally] = field(default_factory=dict)
    """Tally by key of `KINDS`, for those that occur."""

    def __add__(self, other: "Agreement") -> "Agreement":
        kinds = [kind for kind in KINDS if kind in self.tallies or kind in other.tallies]
        pairs = {kind: zip(self.of(kind), other.of(kind), strict=True) for kind in kinds}
        return Agreement({kind: Tally._make(map(sum, pair)) for kind, pair in pairs.items()})

    def of(self, kind: str) -> Tally:
        """Tally of one kind; empty if it does not occur."""
        return self.tallies.get(kind, Tally())

    def failing(self, share: float = 1.0, least: int = 1) -> list[str]:
        """Kinds that do not pass."""
        return [kind for kind in self.tallies if not self.passes(kind, share, least)]

    def passes(self, kind: str, share: float = 1.0, least: int = 1) -> bool:
        """Test whether both measures of a kind reach this share of the minima.

        A measure counts only if it is taken over at least `least` masks.
        """
        tally = self.of(kind)
        if tally.masks >= least and tally.share < share * HELD_AT_LEAST[kind]:
            return False
        return tally.whole < least or tally.mean_iou >= share * IOU_AT_LEAST[kind]


class Comparison(NamedTuple):
    """Comparison of projection and mask for each object in each view."""

    kinds: tuple[str, ...]
    """(n,) keys of `KINDS`; "" for an object without a 3D representation."""
    judged: np.ndarray
    """(T, n) bool: the view has a mask of the object, which has a 3D representation."""
    held: np.ndarray
    """(T, n) bool: the mask lies within the projection; False where that is undefined."""
    whole: np.ndarray
    """(T, n) bool: the object is fully visible, that is, cut off neither by the image border nor by
    another object nor (if the ground truth is known) by anything else in the room."""
    iou: np.ndarray
    """(T, n) IoU of the 2D boxes of mask and projection; 0 where that is undefined."""

    @property
    def agreement(self) -> Agreement:
        """The comparison summed over objects and views, for each kind of 3D representation."""
        tallies = {}
        for kind in KINDS:
            of = np.array([name == kind for name in self.kinds], dtype=bool)
            if (judged := self.judged & of).any():
                whole = judged & self.whole
                tallies[kind] = Tally(
                    int(judged.sum()),
                    int((self.held & judged).sum()),
                    int(whole.sum()),
                    float(self.iou[whole].sum()),
                )
        return Agreement(tallies)


def projections(bodies: Sequence[Body | None], views: RoomViews) -> np.ndarray:
    """Project each body to a 2D box in each view: (T, n, 4) pixels, NaN behind the camera."""
    boxes = np.full((len(views.visible), len(bodies), 4), np.nan)
    for k, body in enumerate(bodies):
        if body is not None:
            boxes[:, k] = boxes_around(body.hull, views.world_to_camera, views.intrinsics)
    return boxes


def compare(bodies: Sequence[Body | None], views: RoomViews) -> Comparison:
    """Compare the projections of objects with their masks in all views."""
    return compare_boxes(bodies, projections(bodies, views), views)


def compare_boxes(
    bodies: Sequence[Body | None], boxes_px: np.ndarray, views: RoomViews
) -> Comparison:
    """Compare given projections, (..., T, n, 4), with the masks."""
    height, width = views.image_size
    masks = views.boxes * np.array([width, height, width, height], dtype=np.float64)
    margin = MARGIN * max(height, width)
    # Comparisons with NaN (behind the camera) are false: undefined projections disagree.
    begins = (boxes_px[..., :2] <= masks[..., :2] + margin).all(axis=-1)
    held = np.logical_and(begins, (boxes_px[..., 2:] >= masks[..., 2:] - margin).all(axis=-1))
    whole = np.asarray(own_sides(views, views.image_size).all(axis=-1))
    for k, body in enumerate(bodies):
        if body is not None and body.unoccluded is not None:
            whole[:, k] &= body.unoccluded
    there = np.array([body is not None for body in bodies], dtype=bool)
    return Comparison(
        tuple(body.kind if body else "" for body in bodies),
        views.visible & there,
        held,
        whole,
        np.nan_to_num(box_iou_2d(boxes_px, masks)),
    )
