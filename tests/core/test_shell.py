"""Walls on any outline: closed, outside the room, with holes, and not through furniture."""

import numpy as np
import pytest
import shapely
import trimesh
from rooms_of_solids import solid_box

from sceneprior.core.scene import Opening, Scene
from sceneprior.core.shell import THICK_M, Shell, shell_of

SQUARE = np.array([[-2.0, -1.5], [2.0, -1.5], [2.0, 1.5], [-2.0, 1.5]])
L = np.array([[-2.5, -2], [2.5, -2], [2.5, 0.5], [0.5, 0.5], [0.5, 2.2], [-2.5, 2.2]])
SLANTED = np.array([[-2.5, -2], [2.5, -2], [2.5, 0.5], [0.5, 2.2], [-2.5, 2.2]])
DOOR = Opening("door", (1.0, -2.0), (1.9, -2.0), 0.0, 2.0)
WINDOW = Opening("window", (-2.5, -1.0), (-2.5, 1.0), 0.9, 2.1)


def room(outline=None, *objects, **more) -> Scene:
    return Scene("room", "front3d_bedroom", objects, outline, **more)


def solid(shell: Shell, name: str) -> trimesh.Trimesh:
    mesh = shell.meshes()[name]
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces)


@pytest.mark.parametrize("outline", [SQUARE, SQUARE[::-1], L, SLANTED, SLANTED[::-1]])
def test_every_mesh_is_closed_and_outside_the_room(outline):
    shell = shell_of(room(outline, openings=()))
    floor = shapely.Polygon(outline)
    for name in shell.meshes():
        mesh = solid(shell, name)
        assert mesh.is_volume and mesh.volume > 0, name
    assert solid(shell, "floor").volume == pytest.approx(floor.area * THICK_M)
    assert solid(shell, "floor").bounds[:, 1].tolist() == [-THICK_M, 0]
    assert solid(shell, "ceiling").bounds[0, 1] == shell.height_m == 2.6
    whole = floor.buffer(THICK_M, join_style="mitre")
    walls = [solid(shell, f"wall_{row}") for row in range(len(outline))]
    plan = [shapely.convex_hull(shapely.MultiPoint(wall.vertices[:, ::2])) for wall in walls]
    assert shapely.union_all(plan).symmetric_difference(whole - floor).area < 1e-6
    assert sum(each.area for each in plan) == pytest.approx((whole - floor).area)


@pytest.mark.parametrize("row", range(4))
def test_a_corner_listed_twice_is_one_corner(row):
    doubled = np.insert(SQUARE, row, SQUARE[row], axis=0)
    once, twice = shell_of(room(SQUARE)), shell_of(room(doubled))
    np.testing.assert_array_equal(twice.outline_m, once.outline_m)
    assert list(twice.meshes()) == list(once.meshes())


@pytest.mark.parametrize("outline", [SQUARE, L, SLANTED])
def test_walls_stand_clear_of_furniture(outline):
    """A desk through the wall at +x: that wall alone moves, and its window with it."""
    desk = solid_box("desk", (2.4, 0.4, -0.5), (1.0, 0.8, 0.6))
    far = float(outline[:, 0].max())
    window = Opening("window", (far, -1.0), (far, 0.0), 0.9, 2.1)
    shell = shell_of(room(outline, desk, openings=(window,)))
    assert shell.grown_m == pytest.approx(2.9 - far)
    floor = shapely.Polygon(shell.outline_m)
    assert floor.covers(shapely.box(1.9, -0.8, 2.9, -0.2).buffer(-1e-9))
    assert floor.covers(shapely.Polygon(outline).buffer(-1e-9))
    low, high = outline.min(axis=0), outline.max(axis=0)
    np.testing.assert_allclose(shell.outline_m.min(axis=0), low)
    np.testing.assert_allclose(shell.outline_m.max(axis=0), [2.9, high[1]])
    (wall,) = (wall for wall in shell.walls if wall.openings)
    assert wall.outward.tolist() == [1, 0] and wall.start_m[0] == pytest.approx(2.9)
