"""Tests the ids of masks against objects that are found without ids."""

from typing import NamedTuple

import numpy as np

from data_prep.inspection.triangulation import fit, middles
from data_prep.tracks.associate import UNKNOWN, FrameMasks, associate
from sceneprior.core.classes import VOID
from sceneprior.core.instances.observations import observe
from sceneprior.core.shards import RoomViews

_GAIN = 1.3
"""Minimum ratio of the agreement of objects found without ids to that of the given ids."""
_FIT = 0.6
"""Minimum mean agreement of the objects found without ids."""


class Trial(NamedTuple):
    """Summed agreement and number of box middles, with the given ids and with objects found."""

    given: float
    given_middles: int
    found: float
    found_middles: int

    @property
    def repairs(self) -> bool:
        """True if the objects found fit the cameras, and explain more than the given ids."""
        fits = self.found > _FIT * self.found_middles
        # With right poses and wrong ids, most masks join others; with wrong poses, hardly any do.
        return fits and self.found > _GAIN * self.given and 2 * self.found > self.given_middles


def try_tracks(views: RoomViews) -> Trial:
    """Find a room's objects without ids and classes, and compare; `views` must include images."""
    assert views.instance_ids is not None
    void = len(views.object_class) + 1
    ids = np.where(views.instance_ids == void, UNKNOWN, 0).astype(np.int32)
    count = 0
    for view, image in enumerate(views.instance_ids):
        for k in np.unique(image[(image > 0) & (image < void)]).tolist():
            count += 1
            ids[view][image == k] = count
    # All masks get one class, because the classes of wrong ids would be wrong.
    masks = FrameMasks(ids, np.ones(count, dtype=np.int64))
    tracks = associate(masks, views.world_to_camera, views.intrinsics)
    objects = len(tracks.object_class)
    images = np.where(tracks.ids < 0, objects + 1, tracks.ids).astype(np.uint32)
    seen = observe(images, [*tracks.object_class.tolist(), VOID])
    found = seen.room_views(views.room_id, views.world_to_camera, views.intrinsics)
    return Trial(*_fit(views), *_fit(found))


def add(trials: list[Trial]) -> Trial:
    """Sum over rooms."""
    return Trial(*map(sum, zip(*trials, strict=True)))


def _fit(views: RoomViews) -> tuple[float, int]:
    found = middles(views)
    agreement, _ = fit(
        found,
        views.world_to_camera[None].astype(np.float64),
        views.intrinsics[None].astype(np.float64),
    )
    return float(agreement.sum()), len(found.item)
