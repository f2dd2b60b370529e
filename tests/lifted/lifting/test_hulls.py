"""Carving against a loop that asks every view about every cell."""

import numpy as np
import pytest

from sceneprior.core.observations import RoomViews
from sceneprior.core.shards import Shard, list_shards
from sceneprior.lifted.lifting.hulls import MOST_EMPTY, NEVER, carve, cells_along, sightings_of


@pytest.fixture(scope="module")
def room(toy_shards) -> RoomViews:
    with Shard(list_shards(toy_shards, "train")[0]) as shard:
        return shard.read_room(shard.room_ids[0], images=True)


def emptiness_cell_by_cell(room: RoomViews, rows, item: int, low, high, cells: int, reach: float):
    """The definition, in float64."""
    height, width = room.image_size
    size = (high - low) / cells
    found = np.empty((cells,) * 3)
    for cell in np.ndindex(*found.shape):
        point = low + (np.array(cell) + 0.5) * size
        own = past = 0
        for pose, lens, ids in zip(
            room.world_to_camera[rows].astype(float), room.intrinsics[rows].astype(float),
            room.instance_ids[rows], strict=True,
        ):  # fmt: skip
            x, y, depth = lens @ (pose[:3, :3] @ point + pose[:3, 3])
            if depth < 0.1:
                continue
            u, v = int(np.floor(x / depth)), int(np.floor(y / depth))
            if not (0 <= u < width and 0 <= v < height):
                continue
            around = int(reach * size.max() * lens[0, 0] / depth + 0.5)
            window = ids[max(v - around, 0) : v + around + 1, max(u - around, 0) : u + around + 1]
            if (window == item + 1).any():
                own += 1
            elif ids[v, u] == 0:
                past += 1
        too_empty = past > MOST_EMPTY * len(rows) + 0.5
        share = max(past - 0.5, 0) / max(own + past, 1)
        found[cell] = NEVER if own < 2 or too_empty else share
    return found


@pytest.mark.parametrize("item", [0, 1])
@pytest.mark.parametrize("reach", [0.0, 0.5])
def test_carving_is_the_definition(room, item, reach):
    rows = np.flatnonzero(room.visible[:, item])
    seen = sightings_of(room, rows, item)
    low, high = np.array([-2.3, -0.1, -2.0]), np.array([2.1, 2.4, 1.9])
    hull = carve(seen, low, high, 9, reach)
    by_hand = emptiness_cell_by_cell(room, rows, item, low, high, 9, reach)
    np.testing.assert_allclose(hull.emptiness, by_hand, rtol=0, atol=1e-6)  # float32 shares
    assert 0 < (hull.emptiness < NEVER).sum() < hull.emptiness.size


def test_rays_pass_the_cells_they_pass():
    """Along x through the middle of a 4 x 4 x 4 grid, and one that misses it."""
    from sceneprior.lifted.lifting.hulls import Hull

    emptiness = np.arange(64, dtype=np.float32).reshape(4, 4, 4) / 64
    hull = Hull(np.zeros(3), np.full(3, 4.0), emptiness)
    origins = np.array([[-1.0, 1.5, 2.5], [-1.0, 9.0, 2.5]])
    where, found = cells_along(hull, origins, np.array([[1.0, 0, 0], [1.0, 0, 0]]), 4)
    assert where[0].tolist() == [[x, 1, 2] for x in range(4)]
    np.testing.assert_array_equal(found[0], emptiness[:, 1, 2])
    assert (found[1] == NEVER).all()
