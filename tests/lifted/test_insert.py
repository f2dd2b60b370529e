"""Putting given objects into rooms: they stay as they came, the room's own make way by a rule."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprior.core.classes import label_set
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.lifted.insert import BADLY, insert


def thing(label: str, x: float, z: float = 0.0, size=(1.0, 1.0, 1.0), mesh=None) -> SceneObject:
    return SceneObject(label, (float(x), size[1] / 2, z), size, mesh)


def scene(*objects: SceneObject, **more) -> Scene:
    return Scene("room", "front3d_bedroom", objects, **more)


def test_given_objects_stay_and_take_the_place_of_their_like():
    given = scene(thing("desk", 0.4), floor_m=np.eye(2))
    own = scene(thing("double_bed", -3), thing("desk", 0.0), thing("wardrobe", 3))
    made = insert(own, given, seed=5)
    assert made.objects == (given.objects[0], own.objects[0], own.objects[2])
    off = 0.4 / 6  # in x alone, of centre and sides
    assert made.extra.pop("replaced_off_m") == pytest.approx(off, abs=1e-5)
    assert made.extra == {"given": [0], "replaced": 1, "removed": 0, "seed": 5}
    assert made.floor_m is given.floor_m and made.name == "room"


def test_of_several_alike_the_nearest_goes():
    own = scene(thing("nightstand", -2), thing("nightstand", 2.2))
    made = insert(own, scene(thing("nightstand", 2)))
    assert [item.center_m[0] for item in made.objects] == [2, -2]
    made = insert(own, scene(thing("nightstand", 2), thing("nightstand", -2.1), thing("desk", 9)))
    assert len(made.objects) == 3 and made.extra["replaced"] == 2


def test_what_overlaps_badly_goes_and_what_overlaps_a_little_stays():
    given = scene(thing("double_bed", 0))
    for apart, kept in ((1 - BADLY + 0.01, True), (1 - BADLY - 0.01, False)):
        made = insert(scene(thing("wardrobe", apart)), given)
        assert (len(made.objects) == 2) is kept
        assert made.extra["removed"] == (not kept)
    # By the smaller of the two volumes: a stool inside a bed is all inside it.
    assert len(insert(scene(thing("stool", 0, size=(0.2, 0.2, 0.2))), given).objects) == 1


def test_classes_that_may_meet_stay_where_they_overlap():
    """A chair stays under a given table, a wardrobe does not."""
    given = scene(thing("table", 0))
    own = scene(thing("chair", 0.2), thing("wardrobe", 0.3))
    names = label_set("front3d_bedroom")
    may_meet = np.zeros((len(names), len(names)), dtype=bool)
    may_meet[names.index("chair"), names.index("table")] = True
    made = insert(own, given, may_meet)
    assert made.objects == (given.objects[0], own.objects[0]) and made.extra["removed"] == 1
    assert len(insert(own, given).objects) == 1


def test_meshes_are_kept_or_lent():
    own_mesh, lent = (Mesh(np.eye(3) * k, np.array([[0, 1, 2]])) for k in (1.0, 2.0))
    other = thing("desk", 1.0, size=(1.0, 2.0, 1.0), mesh=lent)
    kept = insert(scene(other), scene(thing("desk", 0, mesh=own_mesh))).objects[0]
    assert kept.mesh is own_mesh
    item = thing("desk", 5.0, size=(2.0, 1.0, 3.0))
    made = insert(scene(other), scene(item)).objects[0]
    assert replace(made, mesh=None) == item
    # A point at the lender's corner is at the borrower's corner.
    assert made.mesh.vertices_m[0] == pytest.approx([5 + (2 - 1) * 2, 0.5 + (0 - 1) * 0.5, 0.0])


def test_empty_sides():
    bed = thing("double_bed", 0)
    assert insert(scene(bed), scene()).objects == (bed,)
    assert insert(scene(), scene(bed)).objects == (bed,)
    assert insert(scene(), scene()).objects == ()
    assert insert(scene(), scene(bed)).extra["replaced_off_m"] is None
    assert insert(scene(thing("desk", 0)), scene(bed)).objects == (bed,)
