"""Rooms against numbers computed by hand: frames, turns, floors, heights."""

import math

import numpy as np
import pytest
from front_files import bedroom, room, surface
from front_reading import extent, only_room, read, shared_front, signed_volume

from data_prep.front.geometry import floor_of
from data_prep.front.houses import read_house
from data_prep.front.models import ModelBank
from data_prep.front.recipe import load_recipe


def test_a_plain_room_by_hand(front):
    path = front.house("house", bedroom("Bedroom-7", bounds=(1.0, 2.0, 5.0, 8.0), floor_y=0.5))
    room = only_room(front, path)
    assert room.room_id == "house_Bedroom-7" and room.type == "Bedroom"
    assert room.floor.bounds == (-2.0, -3.0, 2.0, 3.0)
    assert room.height_m == pytest.approx(2.6)
    assert [piece.label for piece in room.furniture] == [
        "double_bed", "nightstand", "nightstand", "void",
    ]  # fmt: skip
    assert room.furniture[0].category == "king-size bed"
    # The floor's centre (3, 0.5, 5) is the origin; the bed stands at (0, 0, -1), below the floor.
    lower, upper = extent(room.furniture[0])
    np.testing.assert_allclose(lower, (-3.9, -0.5, -7.0), atol=1e-6)
    np.testing.assert_allclose(upper, (-2.1, 0.5, -5.0), atol=1e-6)
    # A nightstand of 0.5 x 0.4, turned by 90 degrees, is 0.4 wide and 0.5 deep, and faces +x.
    lower, upper = extent(room.furniture[2])
    np.testing.assert_allclose(upper - lower, (0.4, 0.6, 0.5), atol=1e-6)
    assert room.furniture[2].yaw_rad == pytest.approx(math.pi / 2)
    assert room.notes == ()


@pytest.mark.parametrize("degrees", [0, 17, 45 - 1e-3, 120, -75])
def test_walls_are_turned_along_the_axes(front, degrees):
    turned = bedroom("A", bounds=(-2.0, -3.0, 2.0, 3.0), yaw_rad=math.radians(degrees))
    room = only_room(front, front.house("house", turned))
    x1, z1, x2, z2 = room.floor.bounds
    sides = sorted((x2 - x1, z2 - z1))
    np.testing.assert_allclose(sides, (4, 6), atol=1e-9)
    np.testing.assert_allclose((x1 + x2, z1 + z2), 0, atol=1e-9)
    # The bed still stands 1 m from the centre, square to the walls.
    lower, upper = extent(room.furniture[0])
    np.testing.assert_allclose(sorted((upper - lower)[[0, 2]]), (1.8, 2.0), atol=1e-6)
    assert np.linalg.norm((lower + upper)[[0, 2]] / 2) == pytest.approx(1.0, abs=1e-6)


def test_quaternions_are_x_y_z_w(front):
    # 90 degrees about y is (0, s, 0, s): +z turns to +x.
    piece = {"jid": "bed", "pos": (0, 0, 0), "rot": [0, math.sqrt(0.5), 0, math.sqrt(0.5)]}
    room_ = only_room(front, front.house("house", room("A", [piece])))
    assert room_.furniture[0].yaw_rad == pytest.approx(math.pi / 2)
    # A quaternion that is not of unit length is still a turn, never a scale.
    long = {"jid": "bed", "pos": (0, 0, 0), "rot": [0, 3, 0, 3]}
    other = only_room(front, front.house("other", room("A", [long])))
    np.testing.assert_allclose(
        other.furniture[0].model_to_room, room_.furniture[0].model_to_room, atol=1e-12
    )


def test_a_turned_house_gives_the_same_room(front):
    """By 30 degrees: the walls lie along the axes again, and every piece where it was."""
    plain = only_room(front, front.house("plain", bedroom("A", bounds=(-2, -3, 2, 3))))
    turned = bedroom("A", bounds=(-2, -3, 2, 3), yaw_rad=math.radians(30))
    turned = only_room(front, front.house("turned", turned))
    np.testing.assert_allclose(turned.floor.bounds, plain.floor.bounds, atol=1e-9)
    for one, other in zip(plain.furniture, turned.furniture, strict=True):
        np.testing.assert_allclose(one.model_to_room, other.model_to_room, atol=1e-9)


def test_mirrored_pieces_keep_their_outside_out(front):
    plain = {"jid": "bed", "pos": (0, 0, 0)}
    mirrored = {"jid": "bed", "pos": (0, 0, 0), "scale": [-1, 1, 1]}
    one, other = (
        only_room(front, front.house(name, room("A", [piece]))).furniture[0]
        for name, piece in (("one", plain), ("other", mirrored))
    )
    assert signed_volume(one.mesh) == pytest.approx(signed_volume(other.mesh))
    assert abs(signed_volume(one.mesh)) == pytest.approx(1.8 * 1.0 * 2.0, rel=1e-6)
    np.testing.assert_allclose(other.mesh.vertices_m[:, 0], -one.mesh.vertices_m[:, 0], atol=1e-6)
    assert other.yaw_rad == pytest.approx(one.yaw_rad)


def test_several_floors_are_one(front):
    written = bedroom("A", bounds=(-2.0, -2.0, 0.0, 2.0))
    # The second piece of floor begins after a door sill of 3 cm.
    corners = [(0.03, 0, -2), (2, 0, -2), (2, 0, 2), (0.03, 0, 2)]
    written["_meshes"].append(surface("floor2", "Floor", corners))
    written["children"].append({"ref": "floor2"})
    floor = only_room(front, front.house("house", written)).floor
    assert floor.geom_type == "Polygon"
    np.testing.assert_allclose(floor.bounds, (-2, -2, 2, 2), atol=1e-9)
    assert floor.area == pytest.approx(16, abs=1e-6)


def test_storeys_of_a_house(front):
    """Each room stands on its own floor, whatever the storey."""
    below, above = bedroom("Down"), bedroom("Up", floor_y=3.0)
    for child in above["children"]:
        if "pos" in child:
            child["pos"][1] += 3.0
    result = read(front, front.house("house", below, above))
    for room_ in result.rooms:
        assert room_.height_m == pytest.approx(2.6)
        np.testing.assert_allclose(extent(room_.furniture[0])[0][1], 0.0, atol=1e-9)


def test_a_crack_is_closed_without_a_spike_at_a_sliver():
    """A sliver's tip was drawn out where cracks are closed, and moved the room's origin."""

    def flat(*outline):
        corners = np.array([(x, 0.0, z) for x, z in outline])
        faces = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
        return corners[np.array(faces)]

    rooms = [
        flat((0, 0), (4, 0), (4, 3), (0, 3)),
        flat((0, 3.02), (4, 3.02), (4, 5), (0, 5)),  # 2 cm from the other
    ]
    slivers = [
        flat((3.88346, 2.41731), (3.89420, 2.42116), (4.01034, 2.06384)),
        flat((4.02717, 4.79289), (4.02589, 4.79217), (3.90711, 5.00579)),
    ]
    for pieces in (rooms, [*rooms, slivers[0]], [*rooms, slivers[1]]):
        floor, _ = floor_of(pieces)
        points = np.concatenate(pieces)[..., [0, 2]].reshape(-1, 2)
        np.testing.assert_allclose(
            floor.bounds, [*points.min(axis=0), *points.max(axis=0)], rtol=0, atol=1e-4
        )  # what simplifying the outline may move
        assert floor.geom_type == "Polygon" and not floor.interiors
        assert abs(floor.area - 20) < 0.02


def test_a_platform_is_floor_but_not_its_height(front):
    written = bedroom("A", bounds=(-2.0, -2.0, 1.0, 2.0))
    platform = [(1, 0.2, -2), (2, 0.2, -2), (2, 0.2, 2), (1, 0.2, 2)]
    written["_meshes"].append(surface("platform", "Floor", platform))
    written["children"].append({"ref": "platform"})
    room_ = only_room(front, front.house("house", written))
    assert room_.floor.area == pytest.approx(16, abs=1e-6)  # 12 and 4
    assert extent(room_.furniture[0])[0][1] == pytest.approx(0)


def test_floor_that_is_no_place_is_told(front):
    written = bedroom("A")
    corners = [(9, 0, 9), (float("nan"), 0, 9), (12, 0, 12), (1e300, 0, 9)]
    written["_meshes"] += [
        surface("broken", "Floor", corners),
        {"uid": "words", "type": "Floor", "xyz": ["a"], "faces": [0, 1, 2]},
    ]
    written["children"] += [{"ref": "broken"}, {"ref": "words"}]
    room_ = only_room(front, front.house("house", written))
    assert room_.floor.area == pytest.approx(16)
    assert room_.notes == (
        "a Floor mesh has 2 triangles without valid corners",
        "a Floor mesh is left out: a list of numbers holds something else",
    )


def test_walls_may_be_missing(front):
    written = bedroom("A")
    written["children"] = [c for c in written["children"] if c["ref"] != "wall-A"]
    assert only_room(front, front.house("bare", dict(written))).height_m == 2.8  # the usual height
    written = bedroom("A")
    written["_meshes"][1] = surface(
        "wall-A", "Ceiling", [(0, 3.1, 0), (1, 3.1, 0), (1, 3.1, 1), (0, 3.1, 1)]
    )
    assert only_room(front, front.house("ceiling", written)).height_m == pytest.approx(3.1)


def test_meshes_without_faces_or_type(front):
    written = bedroom("A")
    written["_meshes"] += [
        {"uid": "hollow", "type": "Floor", "xyz": [0, 0, 0], "faces": []},
        {"uid": "typeless", "type": "", "xyz": [0, 0, 0], "faces": [0, 0, 0]},
        {"uid": "wild", "type": "WallInner", "xyz": [0, 9, 0], "faces": [0, 0, 7]},
    ]
    written["children"] += [{"ref": "hollow"}, {"ref": "typeless"}, {"ref": "wild"}]
    room_ = only_room(front, front.house("house", written))
    assert room_.floor.area == pytest.approx(16) and room_.height_m == pytest.approx(2.6)


def test_houses_made_by_others():
    folder = shared_front()
    models = ModelBank(folder / "3D-FUTURE-model")
    house = folder / "3D-FRONT" / "0022c821-c1f2-516e-8552-8f01efccfc26.json"
    result = read_house(house, models, load_recipe("bedroom"), lambda _, kind: "Bedroom" in kind)
    assert not result.failures and len(result.rooms) == 1
    room_ = result.rooms[0]
    np.testing.assert_allclose(room_.floor.bounds, (-2.4145, -2.4145, 2.4145, 2.4145), atol=1e-9)
    assert room_.height_m == pytest.approx(2.7)
    assert room_.floor_outline_m.shape == (6, 2)  # an L
    assert sorted(piece.label for piece in room_.furniture) == [
        "armchair", "cabinet", "ceiling_lamp", "double_bed", "void",
    ]  # fmt: skip
    bed = next(piece for piece in room_.furniture if piece.label == "double_bed")
    # As in the picture that came with the data: head at the wall on the left, front to +x.
    assert bed.yaw_rad == pytest.approx(math.pi / 2, abs=1e-3)
    lower, upper = extent(bed)
    np.testing.assert_allclose((lower[0], upper[0], lower[1]), (-2.39, -0.15, 0), atol=0.03)
