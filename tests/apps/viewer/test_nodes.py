"""A room's nodes: only what changed is sent."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from sceneprior.apps.viewer.nodes import RoomNodes
from sceneprior.core.scene import Mesh, Opening, Scene, SceneObject
from sceneprior.core.shell import shell_of

BED = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.0))
LAMP = SceneObject("pendant_lamp", (1.0, 2.0, 0.0), (0.4, 0.6, 0.4))


def scene(*objects: SceneObject) -> Scene:
    return Scene("room", "front3d_bedroom", objects)


class FakeScene:
    """Takes what is added, and keeps how often, and the newest handle of each name."""

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


def test_what_moves_or_grows_is_not_sent_again(room, fake):
    room.show(scene(BED, LAMP))
    fake.added.clear()
    room.show(scene(BED.in_box((0.3, 0.5, 0.1), (1.8, 1.1, 2.1)), LAMP))
    assert fake.added == []
    bed = fake.nodes["/room/object_0"]
    assert bed.scale == (1.8, 1.1, 2.1)
    np.testing.assert_array_equal(bed.position, [0.3, 0.5, 0.1])


def test_what_has_another_shape_or_class_is(room, fake):
    room.show(scene(BED, LAMP))
    fake.added.clear()
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    shaped = SceneObject(
        "double_bed", BED.center_m, BED.size_m, Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    )
    room.show(scene(shaped, LAMP))
    assert fake.added == ["/room/object_0"]
    unit, faces = fake.nodes["/room/object_0"].values
    np.testing.assert_allclose(unit * BED.size_m + BED.center_m, vertices)
    assert len(faces) == 2
    room.show(scene(shaped, SceneObject("wardrobe", LAMP.center_m, LAMP.size_m)))
    assert fake.added[1:] == ["/room/object_1"]


def test_fewer_objects_leave_no_node_behind(room, fake):
    room.show(scene(BED, LAMP), names=True, boxes=True)
    names = {"/room/name_0", "/room/name_1", "/room/boxes"}
    assert names | {"/room/object_0", "/room/object_1"} < set(fake.nodes)
    assert len(fake.nodes["/room/boxes"].values[0]) == 24
    room.show(scene(LAMP), names=True)
    assert fake.nodes["/room/name_0"].text == "pendant lamp 0.40 x 0.60 x 0.40 m"
    room.show(scene())
    assert set(fake.nodes) == {"/room", "/room/grid"}


def test_of_walls_only_what_faces_the_room_is_drawn(room, fake):
    outline = np.array([[-2.0, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
    door = Opening("door", (-0.5, -1.5), (0.4, -1.5), 0.0, 2.0)
    walled = replace(scene(BED), floor_m=outline, openings=(door,))
    room.show(walled, shell="walls")
    walls = [fake.nodes[f"/room/wall_{row}"] for row in range(4)]
    assert all(node.side == "front" for node in walls) and not fake.nodes["/room/grid"].visible
    for (vertices, faces), wall in zip(
        (node.values for node in walls), shell_of(walled).walls, strict=True
    ):
        # All faces lie in the plane of the inner face: no reveal of the door stays by itself.
        beyond = (vertices[faces][..., [0, 2]] - wall.start_m) @ wall.outward
        assert len(faces) and np.abs(beyond).max() < 1e-6
    assert (fake.nodes["/room/ceiling"].values[0][:, 1] >= 2.6).all()
    fake.added.clear()
    room.show(walled, shell="floor")
    assert fake.added == ["/room/floor"]
    assert not {f"/room/wall_{row}" for row in range(4)} & set(fake.nodes)
    room.show(walled, shell="none")
    assert "/room/floor" not in fake.nodes and fake.nodes["/room/grid"].visible
