"""The direction of a room's edges: votes against their definition, and rooms that have none."""

from dataclasses import replace

import numpy as np
import pytest
from posed_files import PosedRoom, prepared

from data_prep.readers.heading import _votes_of_image, find_turn, note_of_turn, turn_matrix

K = np.array([[80.0, 0, 64], [0, 80.0, 48], [0, 0, 1]])
SIZE = (96, 128)
DOWN = turn_matrix(25.0)[:3, :3] @ np.diag([1.0, -1, -1])
DOWN = DOWN @ np.array([[1, 0, 0], [0, np.cos(0.5), -np.sin(0.5)], [0, np.sin(0.5), np.cos(0.5)]])
"""Camera to world of a camera that looks down by half a radian."""


def folded(degrees):
    return (np.asarray(degrees) + 45) % 90 - 45


def voted_by_two_rays(u, v, along):
    """Yaw, in degrees, of the horizontal direction in the plane of two rays along an edge."""
    rays = [
        DOWN @ np.linalg.inv(K) @ (u + t * along[0], v + t * along[1], 1.0) for t in (-9.0, 9.0)
    ]
    direction = np.cross(np.cross(*rays), (0.0, 1, 0))
    return np.degrees(np.arctan2(direction[0], direction[2]))


@pytest.mark.parametrize("angle", [10, 37, 64, 120, 155])
def test_votes_are_the_horizontal_directions_in_the_planes_of_edges(angle):
    """A straight edge at this angle in the image: each pixel of it votes as two rays say."""
    along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    image = ((u - 64) * along[1] - (v - 48) * along[0] > 0).astype(np.uint8)
    pose = np.eye(4)
    pose[:3, :3] = DOWN.T
    votes = _votes_of_image(image, pose, K, 3)
    assert len(votes.weight) > 40 and (votes.view == 3).all() and (votes.weight > 0).all()
    # The centres of the outermost pixels lie 0.45 pixels inside of the edge, on average.
    inside = 0.45 * np.array([along[1], -along[0]])
    wanted = voted_by_two_rays(64.0 + inside[0], 48.0 + inside[1], along)
    off = folded(np.degrees(votes.yaw_rad) - wanted)
    # The steps of pixels turn the smoothed edge by up to a degree.
    assert abs(np.median(off)) < 0.5 and np.abs(off).max() < 3


def views_of(tmp_path, things=None):
    room = PosedRoom(tmp_path / "room", size=(192, 256), focal_px=160.0)
    room.things = things or room.things
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7), (-2, 2.3, 1)]:
        room.look(eye, (0.1, 0.1, 0.3))
    return prepared(room.write(floor_m=0.0)).views


def test_rooms_are_turned_back_if_they_have_a_direction(tmp_path):
    views = views_of(tmp_path)
    for degrees, wanted in ((0.6, 0.0), (12.0, -12.0), (-33.0, 33.0)):
        world_to_camera = views.world_to_camera @ np.linalg.inv(turn_matrix(degrees))
        assert abs(find_turn(replace(views, world_to_camera=world_to_camera)) - wanted) < 0.5
    rng = np.random.default_rng(0)
    mixed = [
        pose @ np.linalg.inv(turn_matrix(angle))
        for pose, angle in zip(views.world_to_camera, rng.uniform(0, 90, 10), strict=True)
    ]
    assert find_turn(replace(views, world_to_camera=np.stack(mixed))) is None
    # Each half of the views agrees within itself, and not with the other half.
    halves = [pose @ np.linalg.inv(turn_matrix(30.0 * (k % 2))) for k, pose in enumerate(mixed)]
    assert find_turn(replace(views, world_to_camera=np.stack(halves))) is None
    empty = replace(views, instance_ids=np.zeros_like(views.instance_ids))
    assert find_turn(empty) is None
    assert note_of_turn(None) == [
        "no direction of walls or furniture is found, so the room is not turned"
    ]
    assert note_of_turn(-32.5) == ["turned by -32.50 degrees, along its walls and furniture"]
