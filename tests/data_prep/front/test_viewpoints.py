"""Cameras: where they stand, what they see, and what is drawn again."""

import numpy as np
import pytest
import shapely

from data_prep.front.furnished import Room
from data_prep.front.recipe import ViewRules
from data_prep.front.views import Viewpoints, intrinsics, view_counts
from sceneprior.core.cameras import camera_centers

RULES = ViewRules()
L_SHAPE = [(-2, -3), (2, -3), (2, 0), (0, 0), (0, 3), (-2, 3)]


def empty_room(outline):
    return Room("house_A", "Bedroom", shapely.Polygon(outline), 2.7, ())


def boxes(*items):
    """Lower and upper corners from centre and size."""
    items = np.array(items, dtype=float).reshape(-1, 2, 3)
    return np.stack([items[:, 0] - items[:, 1] / 2, items[:, 0] + items[:, 1] / 2], axis=1)


def draw(count, outline=L_SHAPE, furniture=None, rules=RULES, seed=0):
    furniture = boxes([(-1, 0.5, -2), (1, 1, 1)]) if furniture is None else furniture
    spots = Viewpoints(
        empty_room(outline), furniture, furniture.mean(axis=1), rules, np.random.default_rng(seed)
    )
    cameras = [spots.draw() for _ in range(count)]
    turns = np.stack([camera.world_to_camera for camera in cameras])
    return cameras, turns, camera_centers(turns)


def test_cameras_stand_inside_at_eye_height_away_from_walls_and_tall_furniture():
    wardrobe = boxes([(0, 1.1, -2), (2, 2.2, 1)], [(-1, 0.3, 2), (1, 0.6, 1)])
    _, turns, eyes = draw(300, furniture=wardrobe)
    inner = shapely.Polygon(L_SHAPE).buffer(-RULES.wall_margin_m + 1e-9)
    assert shapely.contains_xy(inner, eyes[:, 0], eyes[:, 2]).all()
    assert 1.4 <= eyes[:, 1].min() < eyes[:, 1].max() - 0.3 <= 1.5
    pitch = np.degrees(np.arcsin(-turns[:, 2, 1]))
    assert pitch.min() >= 5 - 1e-9 and pitch.max() <= 25 + 1e-9
    for share in np.linspace(0, 1, 8):
        ahead = eyes + share * 0.35 * turns[:, 2, :3]
        near = RULES.furniture_margin_m * (share == 0)
        inside = (ahead > wardrobe[0, 0] - near) & (ahead < wardrobe[0, 1] + near)
        assert not inside.all(axis=1).any()
    # Over the low table a camera may stand: its top is far below the eye.
    over = ((eyes > wardrobe[1, 0]) & (eyes < wardrobe[1, 1]))[:, [0, 2]].all(axis=1)
    assert over.any()


def test_targets_take_turns_and_are_in_view():
    pieces = boxes([(-1.5, 0.4, -2.5), (1, 0.8, 1)], [(-1.5, 0.4, 2.5), (1, 0.8, 1)])
    _, turns, _ = draw(100, furniture=pieces, rules=ViewRules(min_objects=1))
    centers = np.concatenate([pieces.mean(axis=1), np.ones((2, 1))], axis=1)
    points = np.einsum("nij,kj->nki", turns, centers)
    seen = (np.abs(points[..., :2]) < [1.0, 0.75] * points[..., 2:3]).all(axis=2)
    assert seen.any(axis=1).all()
    assert (seen.mean(axis=0) > 0.4).all()


def test_a_lamp_on_the_ceiling_is_kept_in_view():
    lamp = boxes([(0, 2.5, 0), (0.4, 0.3, 0.4)])
    _, turns, _ = draw(100, [(-3, -3), (3, -3), (3, 3), (-3, 3)], lamp)
    points = np.einsum("nij,j->ni", turns, [0, 2.5, 0, 1])
    assert (np.abs(points[:, 1]) < 0.75 * points[:, 2]).mean() > 0.95


def test_narrow_and_crowded_rooms_still_get_cameras():
    corridor = [(-0.25, -2), (0.25, -2), (0.25, 2), (-0.25, 2)]
    _, _, eyes = draw(20, corridor)
    assert (np.abs(eyes[:, 0]) < 0.25).all()
    full = boxes([(0, 1.5, 0), (9, 3, 9)])  # nowhere is clear
    assert len(draw(3, furniture=full)[0]) == 3
    nothing = Viewpoints(
        empty_room(L_SHAPE), np.zeros((0, 2, 3)), np.zeros((0, 3)), RULES, np.random.default_rng(0)
    )
    assert nothing.draw().world_to_camera.shape == (4, 4)


@pytest.mark.parametrize(
    ("areas", "rules", "views"),
    [
        ([12.0, 20.0], RULES, [24, 40]),
        ([1.0], RULES, [8]),  # at least
        ([60.0], RULES, [100]),  # a house at most
        ([50.0, 100.0], RULES, [33, 67]),  # shared by area
        ([], RULES, []),
        ([10.0], ViewRules(per_m2=0.5, at_least=3), [5]),
        ([1.0, 100.0], RULES, [8, 92]),  # 8 at least, and the large room pays
        ([20.0] * 3 + [1.0] * 2, RULES, [28, 28, 28, 8, 8]),
        ([5.0] * 20, RULES, [5] * 20),  # where 8 each would be 160
        ([5.0] * 120, RULES, [1] * 120),  # no room gets none
    ],
)
def test_views_follow_the_floor_area(areas, rules, views):
    assert view_counts(areas, rules) == views
    # The paper's lens: 90 degrees across 480 pixels, so the focal length is half the width.
    np.testing.assert_allclose(intrinsics(RULES), [[240, 0, 240], [0, 240, 180], [0, 0, 1]])


def test_slivers_of_floor_far_apart_take_no_time():
    """Random darts would never hit them."""
    floor = shapely.MultiPolygon([shapely.box(x, x, x + 1e-3, x + 900) for x in (0, 9e4)])
    room = Room("house_A", "Bedroom", floor, 2.7, ())
    spots = Viewpoints(room, np.zeros((0, 2, 3)), np.zeros((0, 3)), RULES, np.random.default_rng(0))
    turns = np.stack([spots.draw().world_to_camera for _ in range(5)])
    eyes = camera_centers(turns)
    assert shapely.distance(floor, shapely.points(eyes[:, [0, 2]])).max() < 2e-3
