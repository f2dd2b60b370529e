"""A room's nodes, of which only what changed is sent, and the map's board."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from sceneprior.apps.viewer.latent_map import make_map
from sceneprior.apps.viewer.scene_nodes import Board, Display, RoomNodes
from sceneprior.core.scene import Mesh, Opening, Scene, SceneObject
from sceneprior.core.shell import shell_of
from sceneprior.paper.prior import LatentCube

BED = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.0))
LAMP = SceneObject("pendant_lamp", (1.0, 2.0, 0.0), (0.4, 0.6, 0.4))
PLAIN = Display("none")


def scene(*objects: SceneObject) -> Scene:
    return Scene("room", "front3d_bedroom", objects)


class FakeScene:
    """Takes what is added, and keeps the names in order, and the newest handle of each."""

    def __init__(self):
        self.added, self.nodes = [], {}

    def __getattr__(self, kind: str):
        def add(name: str, *values, **settings):
            self.added.append(name)
            self.nodes[name] = MagicMock(values=values, **settings)
            self.nodes[name].remove.side_effect = lambda: self.nodes.pop(name)
            return self.nodes[name]

        return add


@pytest.fixture
def fake():
    return FakeScene()


@pytest.fixture
def room(fake):
    return RoomNodes(SimpleNamespace(scene=fake), "/room", 0.0, 6.0, lambda item: None)


def test_only_another_shape_or_class_is_sent_again(room, fake):
    room.show(scene(BED, LAMP), PLAIN)
    fake.added.clear()
    room.show(scene(BED.in_box((0.3, 0.5, 0.1), (1.8, 1.1, 2.1)), LAMP), PLAIN)
    bed = fake.nodes["/room/object_0"]
    assert fake.added == [] and bed.scale == (1.8, 1.1, 2.1)
    np.testing.assert_array_equal(bed.position, [0.3, 0.5, 0.1])
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    shaped = SceneObject("double_bed", BED.center_m, BED.size_m, mesh)
    room.show(scene(shaped, LAMP), PLAIN)
    assert fake.added == ["/room/object_0"]
    unit, faces = fake.nodes["/room/object_0"].values
    np.testing.assert_allclose(unit * BED.size_m + BED.center_m, vertices)
    assert len(faces) == 2
    room.show(scene(shaped, SceneObject("wardrobe", LAMP.center_m, LAMP.size_m)), PLAIN)
    assert fake.added[1:] == ["/room/object_1"]


def test_fewer_objects_leave_no_node_behind(room, fake):
    room.show(scene(BED, LAMP), Display("none", names=True, boxes=True))
    names = {"/room/name_0", "/room/name_1", "/room/boxes"}
    assert names | {"/room/object_0", "/room/object_1"} < set(fake.nodes)
    assert len(fake.nodes["/room/boxes"].values[0]) == 24
    room.show(scene(BED, LAMP), PLAIN, kept={1})  # which get a name and a box
    assert fake.nodes["/room/name_0"].values == ("pendant lamp 0.40 x 0.60 x 0.40 m",)
    assert len(fake.nodes["/room/boxes"].values[0]) == 12
    room.show(scene(), Display("none", names=True, boxes=True))
    assert set(fake.nodes) == {"/room", "/room/grid"}


def test_of_walls_only_what_faces_the_room_is_drawn(room, fake):
    outline = np.array([[-2.0, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
    door = Opening("door", (-0.5, -1.5), (0.4, -1.5), 0.0, 2.0)
    walled = replace(scene(BED), floor_m=outline, openings=(door,))
    room.show(walled, Display("walls"))
    walls = [fake.nodes[f"/room/wall_{row}"] for row in range(4)]
    assert all(node.side == "front" for node in walls) and not fake.nodes["/room/grid"].visible
    for node, wall in zip(walls, shell_of(walled).walls, strict=True):
        # All faces lie in the plane of the inner face: no reveal of the door stays by itself.
        vertices, faces = node.values
        beyond = (vertices[faces][..., [0, 2]] - wall.start_m) @ wall.outward
        assert len(faces) and np.abs(beyond).max() < 1e-6
    assert (fake.nodes["/room/ceiling"].values[0][:, 1] >= 2.6).all()
    fake.added.clear()
    room.show(walled, Display("floor"))
    assert fake.added == ["/room/floor"]
    assert not {f"/room/wall_{row}" for row in range(4)} & set(fake.nodes)
    room.show(walled, PLAIN)
    assert "/room/floor" not in fake.nodes and fake.nodes["/room/grid"].visible


def test_a_ray_hits_the_board_where_a_dot_is(fake, torch_rng, rng):
    cube = LatentCube(5)
    latent_map = make_map(cube, cube(torch.randn(9, 5, generator=torch_rng)))
    center_m = np.array([-4.0, 1.5, -0.5])
    board = Board(SimpleNamespace(scene=fake), latent_map, tuple(center_m), 3.0, lambda *_: None)
    dots_m = board.on_board(latent_map.rooms)
    w, x, y, z = fake.nodes["/map"].wxyz  # by which viser turns the board
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(board.in_scene(dots_m), dots_m @ turn.T + center_m, atol=1e-12)
    for dot, place in zip(board.in_scene(dots_m), latent_map.rooms.tolist(), strict=True):
        eye = rng.uniform([-3, 3, 3], [3, 6, 8])
        np.testing.assert_allclose(board.hit(eye, 0.3 * (dot - eye)), place, atol=1e-6)  # float32
    # Beside the board, its edge is hit; away from it, nothing.
    beside = board.in_scene(np.array([[40.0, 0.0, 0.0]]))[0]
    at_x, _ = board.hit(eye, beside - eye)
    assert at_x == pytest.approx(latent_map.middle[0] + latent_map.side / 2)
    assert board.hit(eye, eye - center_m) is None and board.hit(eye, [1.0, 0.0, 0.0]) is None
