"""Sides that no view shows are moved to floor, walls and ceiling; sides that are seen are not."""

import numpy as np
import pytest

from sceneprior.core.cameras import Pinhole, look_at
from sceneprior.core.observations import observe
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.lifting.boxes import lift_boxes
from sceneprior.lifted.lifting.hidden_sides import moved_to_planes, planes_of
from sceneprior.lifted.lifting.hulls import Sightings
from sceneprior.render.appearance import box_mesh
from sceneprior.render.offscreen import SoftwareRenderer

SIZE = (120, 160)
WALL_Z, CEILING_M = -1.5, 2.6
WALL = Wall(np.array([-2.0, WALL_Z]), np.array([2.0, WALL_Z]), np.array([0.0, 1.0]), 0.0)
PLANES = planes_of([WALL], CEILING_M)
FRONT = [(x, y, z) for x in (-0.45, 0.0, 0.45) for y in (1.2, 1.7) for z in (0.5, 1.4, 2.5)]
"""Cameras that see a piece at the wall from its front alone."""


def views_of(low, high, eyes):
    """Views of a box from cameras that look at its middle."""
    low, high = np.array(low), np.array(high)
    middle, K = (low + high) / 2, np.array([[90, 0, 80], [0, 90, 60], [0, 0, 1.0]])
    poses = np.stack([look_at(np.array(eye, dtype=float), middle) for eye in eyes])
    cameras = [Pinhole(pose, K) for pose in poses]
    meshes = [box_mesh(tuple(middle), tuple(high - low))]
    ids = SoftwareRenderer().instance_ids_of_views(meshes, cameras, SIZE).astype(np.uint8)
    return observe(ids, [1]).room_views("room", poses, K)


def sides_of(low, high, eyes, planes):
    """Lower and upper corner of the lifted box of a box that cameras see."""
    found = lift_boxes(views_of(low, high, eyes), planes)
    half_m = found.sizes_m[0] / 2
    return np.array([found.centers_m[0] - half_m, found.centers_m[0] + half_m])


@pytest.mark.parametrize("seed", range(4))
def test_a_wardrobe_seen_from_its_front_alone_reaches_the_wall(seed):
    rng = np.random.default_rng(seed)
    width, height, depth = rng.uniform((1.0, 1.8, 0.45), (1.6, 2.2, 0.7))
    low, high = (-width / 2, 0, WALL_Z + 0.02), (width / 2, height, WALL_Z + 0.02 + depth)
    alone, found = (sides_of(low, high, FRONT, planes) for planes in (PLANES[:1], PLANES))
    assert alone[0, 2] > WALL_Z + 0.2, "without its wall, it is a slab"
    np.testing.assert_allclose(found, [low, high], atol=0.08)
    assert found[0, 1] == 0 and found[0, 2] == pytest.approx(WALL_Z + 0.02)
    np.testing.assert_allclose(found[1], alone[1], atol=1e-9)  # seen sides stay


def test_a_gap_that_some_views_show_stays():
    low, high = (-0.6, 0, WALL_Z + 0.5), (0.6, 1.0, WALL_Z + 0.9)
    beside = [(x, 1.5, WALL_Z + 0.3) for x in (-2.5, 2.5)]
    found = sides_of(low, high, FRONT + beside * 4, PLANES)
    np.testing.assert_allclose(found, [low, high], atol=0.06)


def test_lamps_reach_the_ceiling_and_pieces_high_on_a_wall_do_not():
    around = [(x, 1.5, z) for x in (-1.5, 0.1, 1.5) for z in (-1.4, 1.5, 2.4)]
    low, high = (-0.3, 2.1, 0.2), (0.3, CEILING_M - 0.1, 0.8)
    assert sides_of(low, high, around, PLANES)[1, 1] == CEILING_M
    low, high = (-0.5, 1.8, WALL_Z + 0.02), (0.5, CEILING_M - 0.2, WALL_Z + 0.4)
    found = sides_of(low, high, FRONT, PLANES)
    assert found[0, 1] == pytest.approx(1.8, abs=0.06), "it does not reach the floor either"
    assert found[1, 1] == pytest.approx(CEILING_M - 0.2, abs=0.06)


def test_a_thin_piece_in_the_line_of_a_wall_keeps_a_depth():
    """Its back would be moved by more than the piece is deep. A mat of 1 cm stays as it is."""
    sides_m = np.array([[-0.3, 0, WALL_Z - 0.045], [0.3, 0.5, WALL_Z - 0.005]])
    seen = Sightings.of(views_of(*sides_m, FRONT), 0)
    found = moved_to_planes(seen, sides_m, PLANES)
    np.testing.assert_allclose(found[:, 2], [WALL_Z - 0.025, WALL_Z - 0.005])
    np.testing.assert_array_equal(found[:, :2], sides_m[:, :2])
    mat_m = np.array([[-0.3, 0, 0.5], [0.3, 0.01, 1.0]])
    np.testing.assert_array_equal(moved_to_planes(seen, mat_m, PLANES), mat_m)
    deep = sides_m + np.array([[0, 0, 0], [0, 0, 0.1]])
    np.testing.assert_allclose(moved_to_planes(seen, deep, PLANES)[0, 2], WALL_Z + 0.02)


def test_walls_near_each_other_are_one_plane_and_oblique_ones_move_nothing():
    near = WALL._replace(start_m=WALL.start_m + 0.1, end_m=WALL.end_m + 0.1)
    other_way = WALL._replace(inward=-WALL.inward)
    assert len(planes_of([WALL, near, other_way], None)) == 3
    oblique = WALL._replace(inward=np.array([0.6, 0.8]))
    low, high = (-0.6, 0, WALL_Z + 0.02), (0.6, 2.0, WALL_Z + 0.6)
    one, other = (sides_of(low, high, FRONT, planes_of(w, None)) for w in ([], [oblique]))
    np.testing.assert_array_equal(one, other)
