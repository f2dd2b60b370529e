"""Scale, position and colours of top-down pictures."""

import numpy as np
import pytest

from sceneprior.core.classes import class_colors
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.appearance import box_mesh, quiet_colors
from sceneprior.render.topdown import TopDownProtocol, perspective, topdown, topdown_protocol

BED, LAMP = 9, 14  # rows of double_bed and pendant_lamp in the bedroom label set


def bedroom(*objects: SceneObject) -> Scene:
    return Scene("room", "front3d_bedroom", objects)


def test_a_cube_covers_exactly_its_pixels_with_x_right_and_z_down():
    # 12.5 mm a pixel: 1 m is 80 pixels, and the origin is the corner shared by pixels 255, 256.
    cube = SceneObject("double_bed", (1.0, 0.5, 2.0), (1.0, 1.0, 1.0))
    image = topdown(bedroom(cube))
    expected = np.full((512, 512, 3), 255, np.uint8)
    expected[256 + 120 : 256 + 200, 256 + 40 : 256 + 120] = class_colors(22)[BED]
    np.testing.assert_array_equal(image, expected)


def test_what_is_nearest_to_the_ceiling_wins_whatever_the_order():
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (2.0, 0.6, 2.0))
    lamp = SceneObject("pendant_lamp", (0.0, 2.2, 0.0), (0.5, 0.4, 0.5))
    image = topdown(bedroom(bed, lamp))
    np.testing.assert_array_equal(image, topdown(bedroom(lamp, bed)))
    assert tuple(image[256, 256]) == tuple(class_colors(22)[LAMP])
    assert (image == class_colors(22)[BED]).all(-1).sum() == 160**2 - 40**2


def test_outlines_darken_borders_and_readers_see_quiet_colours():
    scene = bedroom(SceneObject("desk", (0.0, 0.4, 0.0), (1.0, 0.8, 1.0)))
    plain, lined = topdown(scene), topdown(scene, outlines=True)
    quiet = quiet_colors(["desk"])[0]
    recolored = np.where((plain == class_colors(22)[8]).all(-1, keepdims=True), quiet, plain)
    changed = (recolored != lined).any(-1)
    # Four sides of 80 pixels: above and left inside the desk, where they share a corner, below
    # and right just outside, where they do not meet.
    assert changed.sum() == 4 * 80 - 1
    assert (lined[changed] <= 127).all()


def test_protocols_hold_the_rooms_they_are_for():
    assert topdown_protocol("front3d_bedroom").metres_per_pixel == 0.0125
    assert topdown_protocol("front3d_living").metres_per_pixel == 0.025
    assert TopDownProtocol().as_dict()["metres_per_pixel"] == 0.0125
    with pytest.raises(InputError, match="No label set is called 'kitchen'"):
        topdown_protocol("kitchen")


def test_a_box_mesh_is_closed_and_faces_outwards():
    mesh = box_mesh((1.0, 2.0, 3.0), (2.0, 3.0, 4.0))
    a, b, c = np.swapaxes(mesh.vertices_m[mesh.faces], 0, 1)
    # The divergence theorem: signed tetrahedra sum to the volume only if all faces face out.
    assert np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6 == pytest.approx(24.0, abs=1e-12)
    np.testing.assert_allclose(mesh.vertices_m.min(0), [0.0, 0.5, 1.0])
    np.testing.assert_allclose(mesh.vertices_m.max(0), [2.0, 3.5, 5.0])


def test_the_whole_room_fits_into_the_perspective():
    scene = bedroom(
        SceneObject("wardrobe", (-1.5, 1.0, -1.0), (1.0, 2.0, 0.6)),
        SceneObject("pendant_lamp", (1.0, 2.4, 1.0), (0.5, 0.5, 0.5)),
    )
    image = perspective(scene, (120, 160))
    rows, columns = np.nonzero((image != 255).any(-1))
    # 4% of air, half of it on each side, in the direction that is the tighter one.
    fill = (np.ptp(rows) + 1) / 120, (np.ptp(columns) + 1) / 160
    assert max(fill) == pytest.approx(0.96, abs=0.02)
    assert rows.min() + rows.max() == pytest.approx(119, abs=2)
    assert columns.min() + columns.max() == pytest.approx(159, abs=2)


def test_an_empty_room_is_background():
    assert (topdown(bedroom()) == 255).all()
    assert perspective(bedroom(), (60, 80)).shape == (60, 80, 3)
