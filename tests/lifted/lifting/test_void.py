"""Void furniture is unknown: what stands behind it is lifted as if behind an object."""

import numpy as np
import pytest
import trimesh
from toy_rooms import look_at

from sceneprior.core.cameras import Pinhole
from sceneprior.core.classes import VOID
from sceneprior.core.observations import observe
from sceneprior.core.parts import filled_cells
from sceneprior.core.scene import Mesh
from sceneprior.lifted.lifting import RayPool, ShapeGrid
from sceneprior.lifted.lifting.boxes import draw_rays, lift_boxes
from sceneprior.lifted.lifting.hulls import lift_shapes
from sceneprior.lifted.lifting.part_fit import fit_parts
from sceneprior.render.offscreen import SoftwareRenderer

GRID = ShapeGrid(cells=24, margin=1.15)
BED_M = np.array([1.6, 0.6, 2.0])


def room_of(chest_class: int):
    """A solid bed with a chest at its foot, from twelve sides; most see the bed over the chest."""
    unit = trimesh.creation.box()
    boxes = [(BED_M, (0.0, 0.3, -0.6)), (np.array([1.6, 0.8, 0.5]), (0.0, 0.4, 0.75))]
    meshes = [
        Mesh(np.asarray(unit.vertices) * size_m + center_m, np.asarray(unit.faces))
        for size_m, center_m in boxes
    ]
    lens = np.array([[80.0, 0, 80], [0, 80, 60], [0, 0, 1]])
    poses = np.stack(
        [
            look_at(np.array([2.4 * np.sin(a), 1.0 + 0.4 * (k % 2), 2.4 * np.cos(a)]),
                    np.array([0.0, 0.4, 0.0]))
            for k, a in enumerate(np.linspace(-2.0, 2.0, 12))
        ]
    )  # fmt: skip
    images = SoftwareRenderer().instance_ids_of_views(
        meshes, [Pinhole(pose, lens) for pose in poses], (120, 160)
    )
    return observe(images, [9, chest_class]).room_views("room", poses, lens)


def lifted_bed(room):
    """Centre, size and volume (m3) of the lifted bed."""
    boxes = lift_boxes(room)
    hulls = lift_shapes(room, boxes, GRID)
    rays = RayPool(*(part[0] for part in draw_rays(room, boxes, 1024, GRID.margin)))
    parts = fit_parts(rays, hulls[0], GRID.margin, hangs=False)
    volume_m3 = filled_cells(parts, 64, 1.0).mean() * boxes.sizes_m[0].prod()
    return boxes.centers_m[0], boxes.sizes_m[0], volume_m3


def test_a_bed_behind_a_void_chest_keeps_its_height_and_volume():
    """The box is that of the room in which the chest is an object, to the bit. Fewer rays tell
    something of the shape: the chest's box is not known."""
    known, void = room_of(3), room_of(VOID)
    assert len(known.object_class) == 2 and len(void.object_class) == 1
    assert ((void.instance_ids == 2) == (known.instance_ids == 2)).all()
    center_m, size_m, volume_m3 = lifted_bed(void)
    wanted_center_m, wanted_size_m, wanted_m3 = lifted_bed(known)
    np.testing.assert_array_equal(center_m, wanted_center_m)
    np.testing.assert_array_equal(size_m, wanted_size_m)
    assert volume_m3 == pytest.approx(wanted_m3, rel=0.05)
    assert size_m[1] == pytest.approx(BED_M[1], abs=0.1)
    assert volume_m3 == pytest.approx(BED_M.prod(), rel=0.15)
