"""Metrics of use on rooms made by hand, whose values are known."""

import itertools

import numpy as np
import pytest
import trimesh

from sceneprior.core.scene import Mesh, Opening, Scene, SceneObject, Turned
from sceneprior.evaluation.metrics.collisions import colliding, containing
from sceneprior.evaluation.metrics.floor import out_of_bounds
from sceneprior.evaluation.metrics.navigation import clearances, navigability, reach
from sceneprior.evaluation.metrics.support import supported
from sceneprior.evaluation.metrics.voxel_loss import voxel_loss
from sceneprior.evaluation.use import UseOptions, measure_room, measure_use

FLOOR = np.array([[-2.0, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
DOOR = Opening("door", (-0.5, -1.5), (0.5, -1.5), 0.0, 2.0)
WINDOW = Opening("window", (-0.5, 1.5), (0.5, 1.5), 0.9, 2.1)


def box(x=0.0, z=0.0, width=1.0, depth=1.0, height=1.0, bottom=0.0, label="desk", yaw=None):
    size = (float(width), float(height), float(depth))
    turned = None
    if yaw is not None:
        turned = Turned(yaw, size)
        side = width * abs(np.cos(yaw)) + depth * abs(np.sin(yaw))
        size = (side, float(height), width * abs(np.sin(yaw)) + depth * abs(np.cos(yaw)))
    return SceneObject(label, (float(x), bottom + height / 2, float(z)), size, turned=turned)


def ball(x=0.0, z=0.0, radius=0.5, bottom=0.0):
    made = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices = np.asarray(made.vertices) + np.array([x, bottom + radius, z])
    mesh = Mesh(vertices, np.asarray(made.faces))
    return SceneObject("desk", (x, bottom + radius, z), (2 * radius,) * 3, mesh)


def room(*objects, floor=FLOOR, **more) -> Scene:
    return Scene("a", "front3d_bedroom", objects, floor, **more)


# -- Collisions ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overlap, collide", [(0.2, True), (0.02, True), (0.004, False), (0, False)]
)
def test_two_boxes_that_interpenetrate_collide_unless_5_mm_part_them(overlap, collide):
    apart = box(x=-1.5, z=1.0, width=0.3, depth=0.3)
    pair = box(), box(x=1 - overlap, z=0.1, height=0.8)
    assert colliding(room(*pair, apart)).tolist() == [collide, collide, False]
    assert colliding(room(*pair[::-1], apart)).tolist() == [collide, collide, False]


def test_meshes_collide_where_their_boxes_overlap_only_if_they_meet():
    # Balls of radius 0.5 whose boxes overlap, at 0.98 and 1.02 m.
    for distance, collide in ((0.98, True), (1.02, False)):
        away = distance / 2**0.5
        assert colliding(room(ball(), ball(away, away))).tolist() == [collide] * 2


def test_what_lies_wholly_inside_is_found_by_vertices_and_not_by_surfaces():
    nested = room(box(), box(width=0.5, depth=0.5, height=0.5, bottom=0.2))
    assert colliding(nested).tolist() == [False, False]
    assert containing(nested).tolist() == [True, True]
    # Only vertices of the later object are tested.
    assert containing(room(*nested.objects[::-1])).tolist() == [False, False]


def test_a_corner_in_another_box_is_found_and_a_cross_is_not():
    corner = box(x=0.7, z=0.7, height=0.8, bottom=0.1)
    assert containing(room(box(), corner, box(x=-1.6, width=0.2))).tolist() == [True, True, False]
    cross = room(box(width=2, depth=0.5), box(width=0.5, depth=2, height=0.9, bottom=0.05))
    assert containing(cross).tolist() == [False, False]
    assert colliding(cross).tolist() == [True, True]


# -- Bounds ----------------------------------------------------------------------------------------


def test_a_chair_outside_is_out_of_bounds():
    chair = box(x=3, width=0.5, depth=0.5, label="chair")
    flush = box(x=1.5, z=1.0)  # at two walls
    # A cube of 1 m that reaches 3 mm out: 1 / 6 of its surface, the face there, is outside.
    poking = box(x=1.503)
    assert out_of_bounds(room(chair, flush, poking)).tolist() == [True, False, True]
    assert out_of_bounds(room(chair, floor=None)) is None
    almost = box(x=1.5008)  # floors are given to the millimetre
    assert out_of_bounds(room(almost)).tolist() == [False] and voxel_loss(room(almost)).oob_m3 == 0


# -- Support ---------------------------------------------------------------------------------------


def test_floating_and_overhanging_objects_are_not_supported():
    table = box(width=1.2, height=0.7)
    on_table = box(width=0.3, depth=0.3, height=0.3, bottom=0.7, label="tv_stand")
    overhanging = box(x=0.7, width=0.8, depth=0.3, height=0.3, bottom=0.7, label="tv_stand")
    floating = box(x=1.5, width=0.5, depth=0.5, bottom=0.03, label="nightstand")
    just = box(x=-1.5, width=0.5, depth=0.5, bottom=0.004, label="nightstand")
    assert supported(room(table, on_table)).tolist() == [1, 1]
    assert supported(room(table, overhanging, floating, just)).tolist() == [1, 0, 0, 1]


def test_lamps_hang_from_a_ceiling_that_is_known():
    lamp = box(width=0.4, depth=0.4, height=0.4, bottom=2.2, label="ceiling_lamp")
    assert supported(room(lamp, ceiling_m=2.6)).tolist() == [1]
    assert supported(room(lamp, ceiling_m=2.7)).tolist() == [0]  # a floating lamp
    assert np.isnan(supported(room(lamp))).all()
    found = measure_room(room(lamp, box(x=1)), UseOptions("none"))
    assert found["sceneeval_supported"] == (1, 1)


def test_shelves_hang_on_walls():
    def shelf(z, yaw=None):
        return box(z=z, width=1.0, depth=0.3, height=0.4, bottom=1.2, label="shelf", yaw=yaw)

    assert supported(room(shelf(-1.35))).tolist() == [1]
    assert supported(room(shelf(-1.3))).tolist() == [0]
    # Its back at -z is at the wall, or, turned, in the room.
    assert supported(room(shelf(-1.35, yaw=0.0))).tolist() == [1]
    assert supported(room(shelf(-1.35, yaw=np.pi))).tolist() == [0]
    assert np.isnan(supported(room(shelf(-1.35), floor=None))).all()


# -- Floor -----------------------------------------------------------------------------------------


def test_furniture_across_the_room_parts_the_floor():
    """A bar from wall to wall: areas of 2.5 x 3 and 1 x 3 m, less the robot's half width."""
    bar = room(box(x=0.75, width=0.5, depth=3))
    for share, half in ((navigability(bar), 0.1), (reach(bar).walkable, 0.15)):
        sides = 2.5 - 2 * half, 1.0 - 2 * half
        assert share == pytest.approx(sides[0] / sum(sides), abs=0.02)  # of 1.7 cm a pixel
    assert navigability(room(box(x=0.75, width=0.5, depth=2.5, z=-0.25))) == 1
    assert navigability(room(box(width=4, depth=3))) == 0
    assert navigability(room(box(), floor=None)) is None and reach(room(box(), floor=None)) is None


def test_an_unreachable_corner():
    """A corner of 1 x 1 m behind two boxes, with a stool in it."""
    walls = box(x=1, z=-0.75, width=0.1, depth=1.5), box(x=1.5, z=0, width=1.0, depth=0.1)
    stool = box(x=1.6, z=-1.1, width=0.3, depth=0.3, label="stool")
    near = box(x=-1.5, z=1, width=0.5, depth=0.5)
    found = reach(room(*walls, stool, near))
    assert found.outside == 0 and 0.8 < found.walkable < 1
    # Both walls are reached from either side; stool and near box from one side each, so that
    # 2 + share + (1 - share) of 4 are reached. Slivers of a few pixels are areas, too.
    assert found.reached == pytest.approx(3 / 4, abs=1e-3)
    assert reach(room(near)).reached == 1


# -- Doors -----------------------------------------------------------------------------------------


def test_a_blocked_door():
    crate = box(z=-1.0, width=0.5, depth=0.5, height=1.0)  # before the middle of the door
    (door,) = clearances(room(crate, openings=(DOOR,)))
    # 0.5 of 1 m, and 1 of 2 m.
    assert door.blocked and door.covered == pytest.approx(0.25, abs=0.01)
    beyond = box(z=-0.2, width=0.5, depth=0.5)  # 1.05 m from the door
    beside = box(x=1.2, z=-1.0)
    assert clearances(room(beyond, beside, openings=(DOOR,))) == [(False, 0.0)]
    reversed_door = Opening("door", DOOR.end_m, DOOR.start_m, 0.0, 2.0)
    assert clearances(room(crate, openings=(reversed_door,)))[0].blocked


def test_windows_are_blocked_above_the_sill_only():
    low, high = box(z=1.2, depth=0.5, height=0.8), box(z=1.2, depth=0.5, height=1.5)
    assert clearances(room(low, openings=(WINDOW,))) == [(False, 0.0)]
    (window,) = clearances(room(high, openings=(WINDOW,)))
    assert window.blocked and window.covered == pytest.approx(0.5, abs=0.01)
    assert clearances(room(high)) == [] and clearances(room(floor=None)) == []


# -- Volumes ---------------------------------------------------------------------------------------


def test_shared_and_outer_volumes():
    # Boxes on the grid fill a voxel more than their size: 21 cells for 1 m.
    shared = voxel_loss(room(box(), box(x=0.5)))
    assert shared.mbl_m3 == pytest.approx(11 * 21 * 21 * 0.05**3) and shared.oob_m3 == 0
    outside = voxel_loss(room(box(x=2.0)))
    assert outside.oob_m3 == pytest.approx(10 * 21 * 21 * 0.05**3) and outside.mbl_m3 == 0
    assert outside.pbl_m3 == outside.oob_m3 > 0.1
    assert voxel_loss(room(box(), box(x=1.0), box(x=-1.5, z=1))).pbl_m3 == 0  # they touch
    assert voxel_loss(room(box(), floor=None)) is None
    assert voxel_loss(room(box(bottom=1.8), ceiling_m=2.4)).oob_m3 > 0.1
    # Sunk by 2 mm it loses nothing, by 10 cm two layers.
    assert voxel_loss(room(box(bottom=-0.002))).oob_m3 == 0
    assert voxel_loss(room(box(bottom=-0.1))).oob_m3 == pytest.approx(2 * 21 * 21 * 0.05**3)


# -- All of them -----------------------------------------------------------------------------------


def test_rooms_without_floor_or_doors_say_what_is_missing():
    bare = room(box(), floor=None)
    found = measure_use({"generated": [bare], "test": [room(box())]}, 0, 0, UseOptions("none"))
    assert found.left_out["sceneeval_oob_objects"] == "a floor (floor_m) in the scenes"
    assert found.left_out["sceneeval_clear_openings"] == "doors or windows (openings) in the scenes"
    for column in found.columns.values():
        assert set(column) == {
            "sceneeval_col_objects", "sceneeval_col_scenes", "physcene_col_objects",
            "physcene_col_scenes", "sceneeval_supported",
        }  # fmt: skip
    empty = measure_use({"generated": [room(floor=None)]}, 0, 0, UseOptions("none"))
    assert empty.left_out["sceneeval_supported"] == "objects in the scenes"


def test_symmetries_change_nothing():
    """Rooms turned by quarters, and with their objects in another order, score the same."""
    made = [box(x=-1, z=-0.9, height=0.7), box(x=-0.6, z=-0.5), box(x=1.8, z=1.2, bottom=0.2)]
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])

    def turned(item):
        x, z = turn @ np.array([item.center_m[0], item.center_m[2]])
        width, height, depth = item.size_m
        return SceneObject(
            item.label, (float(x), item.center_m[1], float(z)), (depth, height, width)
        )

    plain = measure_room(room(*made), UseOptions("none"))
    other = measure_room(room(*map(turned, made), floor=FLOOR @ turn.T), UseOptions("none"))
    exact = ("col_objects", "col_scenes", "oob_objects", "supported", "out")
    for key in plain:
        near = 0 if key.endswith(exact) else 0.03  # pixels and voxels
        assert other[key] == pytest.approx(plain[key], rel=near, abs=near), key
    for order in itertools.permutations(made):
        assert measure_room(room(*order), UseOptions("none"))["sceneeval_col_objects"] == (2, 3)
