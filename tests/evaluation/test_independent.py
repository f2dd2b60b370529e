"""Rooms without any bond between their objects keep every marginal and lose the rest."""

import numpy as np
import pytest

from sceneprior.errors import InputError
from sceneprior.evaluation.independent import independent_rooms
from sceneprior.evaluation.metrics.contents import class_frequencies, object_counts
from sceneprior.scene import Mesh, Scene, SceneObject

MESH = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))


def bedroom(name: str, others: int) -> Scene:
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (2.0, 0.6, 2.0), MESH)
    stand = SceneObject("nightstand", (1.3, 0.2, float(others)), (0.4, 0.4, 0.4))
    return Scene(name, "front3d_bedroom", (bed,) + (stand,) * others)


REAL = [bedroom("a", 1), bedroom("b", 3)]


def test_marginals_stay_and_bonds_go():
    rooms = independent_rooms(REAL, 4000, 0)
    assert set(object_counts(rooms)) == {2, 4}
    assert object_counts(rooms).mean() == pytest.approx(3, abs=0.05)
    assert class_frequencies(rooms) == pytest.approx(class_frequencies(REAL), abs=0.01)
    # Every real room has one bed; of two draws at a third each, 4 in 9 rooms have none.
    pairs = [room for room in rooms if len(room.objects) == 2]
    without = np.mean([all(o.label != "double_bed" for o in room.objects) for room in pairs])
    assert without == pytest.approx(4 / 9, abs=0.04)


def test_objects_are_real_ones_with_meshes_where_asked():
    pool = {id(item) for scene in REAL for item in scene.objects}
    kept = independent_rooms(REAL, 20, 1, with_meshes=True)
    assert all(id(item) in pool for room in kept for item in room.objects)
    plain = independent_rooms(REAL, 20, 1)
    assert [r.without_meshes() for r in kept] == plain == independent_rooms(REAL, 20, 1)
    assert plain != independent_rooms(REAL, 20, 2)


def test_empty_rooms_take_part_but_are_not_all():
    rooms = independent_rooms([*REAL, Scene("empty", "front3d_bedroom")], 60, 0)
    assert set(object_counts(rooms)) == {0, 2, 4}
    with pytest.raises(InputError, match="none of the 1 rooms given"):
        independent_rooms([Scene("empty", "front3d_bedroom")], 5, 0)
