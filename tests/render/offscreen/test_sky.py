"""Light from the sky: open floors are bright, what stands under something is dark."""

import numpy as np
import pytest

from sceneprior.core.cameras import Pinhole, look_at
from sceneprior.core.scene import Mesh
from sceneprior.render.appearance import box_mesh
from sceneprior.render.offscreen.zbuffer import DARKEST, rasterize, sky_light

SIZE = (60, 80)
CAMERA = Pinhole(
    look_at(np.array([0.0, 4.0, 4.0]), np.zeros(3)),
    np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]),
)


def light_of(*meshes: Mesh):
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices_m for mesh in meshes])
    faces = np.concatenate([mesh.faces + at for mesh, at in zip(meshes, starts, strict=False)])
    _, depth_m = rasterize(
        vertices, faces, CAMERA.world_to_camera, (60.0, 60.0, 40 + 0.25, 30 + 0.25), SIZE
    )
    return sky_light(vertices, faces, CAMERA, depth_m), depth_m


def pixel(point_m):
    seen = CAMERA.world_to_camera[:3, :3] @ point_m + CAMERA.world_to_camera[:3, 3]
    return tuple((CAMERA.intrinsics @ seen / seen[2])[[1, 0]].astype(int))


FLOOR = box_mesh((0.0, -0.05, 0.0), (3.0, 0.1, 3.0))


def test_an_open_floor_is_bright_and_the_background_stays_as_it_is():
    light, depth_m = light_of(FLOOR)
    assert (light[~np.isfinite(depth_m)] == 1).all()
    top = light[pixel(np.zeros(3))]
    assert top == 1
    assert (light >= DARKEST).all()


def test_under_a_table_it_is_dark_and_beside_it_lighter_the_further_away():
    light, _ = light_of(FLOOR, box_mesh((0.0, 0.6, -0.5), (1.2, 0.05, 1.0)))
    near, far = (light[pixel(np.array([0, 0, z]))] for z in (0.1, 1.3))
    assert near < far - 0.1
    assert far == pytest.approx(1, abs=0.15)
