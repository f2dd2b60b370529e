"""Ids by hand, and shaded pictures."""

import numpy as np

from sceneprior.core.cameras import Pinhole
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen import Renderer

INTRINSICS = np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
SIZE = (96, 128)


def box(center, size, inside_out=False):
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]) / 2
    quads = np.array(
        [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    )
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = np.asarray(center) + corners * size
    return Mesh(vertices, faces[:, ::-1] if inside_out else faces)


def bounds(mask):
    rows, columns = np.nonzero(mask)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def test_a_unit_box_covers_exactly_its_projection():
    # The near side lies at z = 4.5: x from -0.25 to 0.75 is u from 58.44 to 80.67, of which the
    # centres of columns 58 to 79 are inside; y from -0.5 to 0.5 is v from 36.89 to 59.11.
    ids = Renderer().instance_ids(
        [box((0.25, 0, 5), (1, 1, 1))], Pinhole(np.eye(4), INTRINSICS), SIZE
    )
    assert ids.dtype == np.uint16 and ids.shape == SIZE
    assert bounds(ids == 1) == (58, 37, 80 + 1, 59)
    assert (ids[37:59, 58:81] == 1).all()


def test_equally_near_faces_go_to_the_first_mesh():
    wall = box((0, 0, 3), (9, 9, 0.1))
    ids = Renderer().instance_ids([wall, wall], Pinhole(np.eye(4), INTRINSICS), SIZE)
    assert (ids == 1).all()


def test_many_ids_and_empty_meshes():
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    meshes = [empty] * 699 + [box((0, 0, 3), (1, 1, 1)), empty]
    ids = Renderer().instance_ids(meshes, Pinhole(np.eye(4), INTRINSICS), SIZE)
    assert set(np.unique(ids)) == {0, 700}
    nothing = Renderer().instance_ids_of_views([], [Pinhole(np.eye(4), INTRINSICS)] * 2, SIZE)
    assert nothing.shape == (2, *SIZE) and not nothing.any()


def test_several_sizes_one_after_the_other():
    wall = box((0, 0, 3), (99, 99, 0.1))
    for size in ((5, 7), (64, 64), (5, 7)):
        assert (Renderer().instance_ids([wall], Pinhole(np.eye(4), INTRINSICS), size) == 1).all()


def test_shaded_pictures():
    colors = np.array([[200, 40, 40], [40, 40, 200]], dtype=np.uint8)
    meshes = [box((-1, 0, 5), (1, 1, 1)), box((1, 0, 5), (1, 1, 1))]
    picture = Renderer().shaded(
        meshes, colors, Pinhole(np.eye(4), INTRINSICS), SIZE, (255, 250, 245)
    )
    assert picture.dtype == np.uint8 and picture.shape == (*SIZE, 3)
    assert picture[0, 0].tolist() == [255, 250, 245]
    red, blue = picture[48, 64 - 20].astype(int), picture[48, 64 + 20].astype(int)
    assert red[0] > 3 * red[2] and blue[2] > 3 * blue[0]
    ids = Renderer().instance_ids(meshes, Pinhole(np.eye(4), INTRINSICS), SIZE)
    inner = ids == 1
    for _ in range(2):  # away from the softened rim, the picture is where the ids are
        inner &= (
            np.roll(inner, 1, 0)
            & np.roll(inner, -1, 0)
            & np.roll(inner, 1, 1)
            & np.roll(inner, -1, 1)
        )
    assert (picture[inner][:, 0] > picture[inner][:, 2]).all()
