"""Parts: their mirror images, the cells that they fill, and closed meshes that stretch."""

import numpy as np
import pytest
import trimesh
from parts_of_rooms import CORNER, TABLE, boxes

from sceneprior.core.parts import (
    BOWL,
    BOX,
    CYLINDER,
    DOME,
    ELLIPSOID,
    THIN_M,
    Parts,
    Stretch,
    inside,
    surface_of_parts,
)

CURVED = [
    Parts(np.array([kind]), np.array([0]), np.array([[[-0.5, 0.25], [-0.25, 0.5], [-0.5, 0.5]]]))
    for kind in (CYLINDER, ELLIPSOID, DOME, BOWL)
]
VOLUMES = [np.pi / 4, np.pi / 6, np.pi / 6, np.pi / 6]


@pytest.mark.parametrize(("parts", "share"), zip(CURVED, VOLUMES, strict=True))
def test_curved_parts_fill_their_share_of_their_box(parts, share):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200_000, 3))
    kind, ends = next(parts.solids())
    found = inside(kind, ends, points)
    assert found.mean() == pytest.approx(share * 0.75 * 0.75, rel=0.02)
    assert (found <= inside(BOX, ends, points)).all()
    vertices, faces = surface_of_parts(parts)
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_volume and mesh.volume == pytest.approx(share * 0.75 * 0.75, rel=0.08)


def touching_parts(seed: int) -> Parts:
    """Parts whose ends are often equal, and nearly equal to the ends of the box."""
    rng = np.random.default_rng(seed)
    ends = np.sort([rng.choice(9, 2, replace=False) for _ in range(18)]).reshape(6, 3, 2) / 8 - 0.5
    ends = (ends + rng.choice([0.0, 4e-4], ends.shape)).clip(-0.5, 0.5)
    return Parts(rng.integers(0, 5, 6), rng.integers(0, 4, 6), ends)


@pytest.mark.parametrize("parts", [TABLE, CORNER, *CURVED, *map(touching_parts, range(40))])
def test_meshes_are_closed_and_have_few_faces(parts):
    vertices, faces = surface_of_parts(parts)
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert len(mesh.faces) == len(faces) <= 3000 and np.abs(vertices).max() <= 0.5


def test_legs_keep_their_thickness_and_tables_fill_their_new_box():
    size_m = np.array([0.8, 0.75, 0.4])
    wide_m = np.array([1.6, 0.75, 0.8])
    legs = boxes((0, 64, 62, 64, 0, 64), (0, 4, 0, 62, 0, 8), mirrored=(0, 3))
    assert 4 / 64 * size_m[0] < THIN_M and 8 / 64 * size_m[2] < THIN_M
    points = np.array([[-0.5, -0.5, -0.5], [4 / 64 - 0.5, 62 / 64 - 0.5, 8 / 64 - 0.5], [0.5] * 3])
    low, inner, high = Stretch.of(legs, size_m).moved(points, wide_m) * wide_m
    np.testing.assert_allclose(high - low, wide_m)
    thickness = (inner - low)[[0, 2]]
    np.testing.assert_allclose(thickness, [4 / 64 * 0.8, 8 / 64 * 0.4])
    assert (inner - low)[1] == pytest.approx(62 / 64 * 0.75), "height is as before"
