"""Objects are set down, get feet, and go apart; nothing else changes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from rooms_of_solids import solid_box

from sceneprior.core.colliders import (
    colliders,
    convex_parts,
    mass_kg,
    mesh_of,
    volume_and_centroid,
)
from sceneprior.core.contact_resolution import (
    add_supports,
    body_boxes,
    is_stable,
    make_stable,
)
from sceneprior.core.parts import convex_surface
from sceneprior.core.scene import Mesh, Scene, SceneObject, Solid, Turned

KINDS = ("box", "cylinder", "ellipsoid", "dome", "bowl")


def standing(*objects, floor=None) -> tuple[Scene, dict[str, int]]:
    scene, told, _ = make_stable(Scene("room", "front3d_bedroom", objects, floor))
    return scene, {key: value for key, value in told.items() if value}


@pytest.mark.parametrize(
    "length_m, expected",
    [
        (2.65, {"moved": 1}),  # the bed, since the wardrobe stands at a wall
        (2.58, {"shrunk": 2}),
        (2.54, {"left out": 1}),
    ],
)
def test_an_object_without_a_place_moves_others_then_shrinks_then_is_named(length_m, expected):
    """A bed that reaches into a wardrobe, between two walls: both need 2.6 m."""
    near = min(0.585, length_m - 2.0)
    bed = solid_box("double_bed", (0.0, 0.3, near + 1.0), (1.8, 0.6, 2.0))
    wardrobe = solid_box("wardrobe", (0.0, 1.0, 0.3), (1.8, 2.0, 0.6))
    floor = np.array([[-0.9, 0], [0.9, 0], [0.9, length_m], [-0.9, length_m]])
    given = Scene("room", "front3d_bedroom", (bed, wardrobe), floor)
    scene, changes, left_out = make_stable(given)
    assert {key: value for key, value in changes.items() if value} == expected
    if "left out" in expected:
        assert left_out == [
            "room: 1_wardrobe is left out: it overlaps 0_double_bed by 6.0 cm, and no place within "
            "2 m is free."
        ]
        return
    assert left_out == []
    assert (scene.sizes_m >= 0.98 * given.sizes_m - 1e-9).all()
    bed, wardrobe = scene.objects
    gap = bed.center_m[2] - bed.size_m[2] / 2 - wardrobe.center_m[2] - wardrobe.size_m[2] / 2
    assert gap > 0


def test_a_table_on_one_side_gets_feet_and_keeps_its_solids():
    board = Solid("box", (-0.5, 0.7, -0.5), (0.5, 0.75, 0.5))
    leg = Solid("cylinder", (-0.5, 0.0, -0.1), (-0.3, 0.7, 0.1))
    table = SceneObject("table", (0.0, 0.375, 0.0), (1.0, 0.75, 1.0), solids=(board, leg))
    table = replace(table, mesh=mesh_of(board))
    assert not is_stable(table)
    better = add_supports(table)
    assert is_stable(better)
    assert better.solids[:2] == (board, leg) and len(better.solids) == 6
    lowest = {foot.low_m[1] for foot in better.solids[2:]}
    assert lowest == {0.0}
    assert len(better.mesh.faces) == len(table.mesh.faces) + 4 * 12
    assert add_supports(better) is better


@pytest.mark.parametrize("ends", [[(0, 0)], [(-0.5, 0), (0.5, 0)], [(0, -0.5), (0, 0.5)]], ids=str)
def test_nothing_is_stable_on_a_tip_or_an_edge(ends):
    """A pyramid upside down, and wedges along x and z."""
    upper = [(x, 1.0, z) for x in (-0.5, 0.5) for z in (-0.5, 0.5)]
    mesh = Mesh(*convex_surface(np.array(upper + [(x, 0.0, z) for x, z in ends])))
    assert not is_stable(SceneObject("stool", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0), mesh))


@pytest.fixture(params=range(3))
def pane(request) -> trimesh.Trimesh:
    """A box that is flat along an axis."""
    box = trimesh.creation.box((0.4, 0.4, 0.4))
    box.vertices[:, request.param] = 0.0
    return box


def test_the_parts_of_a_flat_mesh_have_a_volume(pane):
    (part,) = convex_parts(Mesh(pane.vertices, pane.faces))
    assert volume_and_centroid(part)[0] == pytest.approx(0.4**2 * 0.001, rel=0.01)
    np.testing.assert_allclose(np.ptp(part.vertices_m, axis=0), pane.extents + 0.001)


def test_a_flat_body_has_a_flat_box(pane):
    bodies = (Mesh(pane.vertices, pane.faces),)
    boxes = body_boxes(SceneObject("shelf", (0.0, 0.0, 0.0), tuple(pane.extents), solids=bodies))
    bounds = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    np.testing.assert_allclose(bounds, pane.bounds, atol=1e-12)


@pytest.mark.parametrize("side_m", [0.0, 0.01])
def test_no_object_is_without_mass(side_m):
    assert mass_kg(SceneObject("stool", (0.0, 0.0, 0.0), (side_m,) * 3)) == 0.001


def test_a_lamp_comes_down_with_its_table():
    table = solid_box("table", (0.0, 0.6, 0.0), (1.0, 0.7, 1.0))
    lamp = solid_box("lamp", (0.2, 1.15, 0.2), (0.3, 0.4, 0.3))
    scene, told = standing(table, lamp)
    assert told == {"set down": 2}
    bottoms_m = scene.centers_m[:, 1] - scene.sizes_m[:, 1] / 2
    np.testing.assert_allclose(bottoms_m, [0.0, 0.7], atol=1e-9)


def test_turned_boxes_are_bodies_at_their_angle():
    """A narrow box at 45 degrees: another one may stand in the corner of its bounding box."""
    turned = Turned(np.pi / 4, (1.4, 1.0, 0.2))
    side = (1.4 + 0.2) / np.sqrt(2)
    screen = SceneObject("shelf", (0.0, 0.5, 0.0), (side, 1.0, side), turned=turned)
    (body,) = colliders(screen)
    assert volume_and_centroid(body)[0] == pytest.approx(1.4 * 1.0 * 0.2)
    corner = solid_box("stool", (0.4, 0.2, 0.4), (0.3, 0.4, 0.3))
    assert standing(screen, corner)[1] == {}
    assert standing(screen, solid_box("stool", (0.4, 0.2, -0.4), (0.3, 0.4, 0.3)))[1] == {
        "moved": 1
    }


@pytest.mark.parametrize("kind", KINDS)
def test_volumes_and_centroids_are_those_of_meshes(kind):
    solid = Solid(kind, (1.0, 2.0, 3.0), (1.5, 3.0, 3.8))
    volume, center = volume_and_centroid(solid)
    mesh = trimesh.Trimesh(*(np.asarray(part) for part in vars(mesh_of(solid)).values()))
    assert mesh.is_volume
    # A circle of 16 corners has 0.974 of the area.
    assert mesh.volume == pytest.approx(volume, rel=0.07 if kind != "box" else 1e-9)
    np.testing.assert_allclose(mesh.center_mass, center, atol=0.02)
    found = volume_and_centroid(mesh_of(solid))
    assert found[0] == pytest.approx(mesh.volume)
    np.testing.assert_allclose(found[1], mesh.center_mass)


def test_coacd_cuts_a_mesh_into_convex_parts():
    pytest.importorskip("coacd", reason="no coacd here: pip install -e '.[sim]'")
    blocks = [
        trimesh.creation.box(bounds=bounds)
        for bounds in ([[0, 0, 0], [1, 0.2, 1]], [[0, 0, 0], [0.2, 1, 1]])
    ]
    corner = trimesh.boolean.union(blocks)
    parts = convex_parts(Mesh(corner.vertices, corner.faces))
    assert len(parts) == 2
    total = sum(volume_and_centroid(part)[0] for part in parts)
    assert total == pytest.approx(corner.volume, rel=0.02)


def test_closed_components_are_bodies_of_their_own(monkeypatch):
    """A table of five boxes that meet, without CoACD."""
    monkeypatch.setattr("sceneprior.core.colliders._coacd", lambda: None)
    boxes = [trimesh.creation.box((1.2, 0.04, 0.8), transform=at(0, 0.7, 0))]
    boxes += [
        trimesh.creation.box((0.06, 0.7, 0.06), transform=at(x, 0.35, z))
        for x in (-0.5, 0.5)
        for z in (-0.3, 0.3)
    ]
    table = trimesh.util.concatenate(boxes)
    parts = convex_parts(Mesh(table.vertices, table.faces))
    volumes = sorted(volume_and_centroid(part)[0] for part in parts)
    assert volumes == pytest.approx(sorted(box.volume for box in boxes))
    # An open mesh and a cavity have no components of their own: one hull.
    for faces in (table.faces[1:], np.vstack([table.faces[:12], table.faces[12:, ::-1]])):
        (hull,) = convex_parts(Mesh(table.vertices, faces))
        assert volume_and_centroid(hull)[0] > 0.5


def at(x: float, y: float, z: float) -> np.ndarray:
    return trimesh.transformations.translation_matrix([x, y, z])


@pytest.mark.parametrize("size_m", [(1.0, 0.0, 1.0), (1.0, 1.0, 0.0)])
def test_flat_boxes_are_settled_like_others(size_m):
    flat = SceneObject("desk", (0.0, 0.5, 0.0), size_m)
    assert len(make_stable(Scene("flat", "front3d_bedroom", (flat,))).scene.objects) == 1
