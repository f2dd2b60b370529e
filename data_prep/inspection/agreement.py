"""How well what is known of a room in 3D, projected, agrees with the masks in 2D."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from data_prep.inspection.bodies import KINDS, Body
from data_prep.inspection.projection import box_iou_2d, boxes_around
from data_prep.upright import own_sides
from sceneprior.shards import RoomViews

MARGIN = 0.02
"""Of the image's longer side: how far a mask may stick out of its object's projection. Poses that
are 5 cm off do that 2.5 m away in views of 90 degrees."""
HELD_AT_LEAST = {"mesh": 0.95, "box": 0.8, "found": 0.5}
"""Share of the masks that lie within their projections. Occluders and the image's border only
make masks smaller, so every mask of right poses does, but for those of found boxes: these
fall short of pieces that are never seen whole. Cameras dealt out at random reach 0.07 to 0.15."""
IOU_AT_LEAST = {"mesh": 0.85, "box": 0.5, "found": 0.7}
"""Mean over what is seen whole. A mesh and its own mask agree to the pixel but for parts thinner
than one. The corners of a 3D box reach beyond the silhouette of what is in it, and annotated boxes
are those of a partial scan."""
ROOM_SHARE = 0.7
"""Of both, what one room has to reach: so one wrong room does not hide among many right ones."""


class Tally(NamedTuple):
    """Sums over objects and views."""

    masks: int = 0
    held: int = 0
    """Masks within their projections."""
    whole: int = 0
    """Masks of which nothing is cut off."""
    iou: float = 0.0
    """Sum over these of the IoU of mask and projection, as 2D boxes."""

    @property
    def share(self) -> float:
        """Of the masks, those that are held."""
        return self.held / max(self.masks, 1)

    @property
    def mean_iou(self) -> float:
        """NaN where nothing is seen whole."""
        return self.iou / self.whole if self.whole else float("nan")


@dataclass(frozen=True)
class Agreement:
    """By what stands for the objects, a key of `KINDS`."""

    tallies: dict[str, Tally] = field(default_factory=dict)

    def __add__(self, other: "Agreement") -> "Agreement":
        kinds = [kind for kind in KINDS if kind in self.tallies or kind in other.tallies]
        return Agreement({kind: _sum(self.of(kind), other.of(kind)) for kind in kinds})

    def of(self, kind: str) -> Tally:
        """Empty where nothing of the kind is there."""
        return self.tallies.get(kind, Tally())

    def failing(self, share: float = 1.0, least: int = 1) -> list[str]:
        """The kinds that reach less than this share of what is expected, measured where there are
        at least so many masks of it."""
        return [kind for kind in self.tallies if not passes(kind, self.of(kind), share, least)]


def passes(kind: str, tally: Tally, share: float = 1.0, least: int = 1) -> bool:
    """Whether both measures reach this share of what is expected; see `Agreement.failing`."""
    if tally.masks >= least and tally.share < share * HELD_AT_LEAST[kind]:
        return False
    return tally.whole < least or tally.mean_iou >= share * IOU_AT_LEAST[kind]


def _sum(a: Tally, b: Tally) -> Tally:
    return Tally(a.masks + b.masks, a.held + b.held, a.whole + b.whole, a.iou + b.iou)


class Comparison(NamedTuple):
    """Each object in each view."""

    kinds: tuple[str, ...]
    """(n,) "" where nothing stands for the object."""
    judged: np.ndarray
    """(T, n) bool: the view has a mask, and something stands for the object."""
    held: np.ndarray
    """(T, n) bool: the mask lies within the projection; False where that is undefined."""
    whole: np.ndarray
    """(T, n) bool: nothing is cut off the mask, so its box is the object's own."""
    iou: np.ndarray
    """(T, n) of the mask's box and the projection's; 0 where that is undefined."""

    @property
    def agreement(self) -> Agreement:
        """Summed up."""
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
    """(T, n, 4) pixels: the 2D box round each body in each view; NaN where it is behind."""
    boxes = np.full((len(views.visible), len(bodies), 4), np.nan)
    for k, body in enumerate(bodies):
        if body is not None:
            boxes[:, k] = boxes_around(body.hull, views.world_to_camera, views.intrinsics)
    return boxes


def compare(bodies: Sequence[Body | None], views: RoomViews) -> Comparison:
    """Hold the projections of objects against their masks, in every view that has one."""
    return compare_boxes(bodies, projections(bodies, views), views)


def compare_boxes(
    bodies: Sequence[Body | None], boxes_px: np.ndarray, views: RoomViews
) -> Comparison:
    """The same of given projections, (..., T, n, 4)."""
    height, width = views.image_size
    masks = views.boxes * np.array([width, height, width, height], dtype=np.float64)
    margin = MARGIN * max(height, width)
    # Comparisons with NaN, behind the camera, are false: what is undefined disagrees.
    begins = (boxes_px[..., :2] <= masks[..., :2] + margin).all(axis=-1)
    held = np.logical_and(begins, (boxes_px[..., 2:] >= masks[..., 2:] - margin).all(axis=-1))
    whole = np.asarray(own_sides(views, views.image_size).all(axis=-1))
    there = np.array([body is not None for body in bodies], dtype=bool)
    return Comparison(
        tuple(body.kind if body else "" for body in bodies),
        views.visible & there,
        held,
        whole,
        np.nan_to_num(box_iou_2d(boxes_px, masks)),
    )
