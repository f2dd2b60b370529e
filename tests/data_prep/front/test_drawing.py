"""Drawing of a room: poor views are drawn again, up to a limit, and pictures show the masks."""

import numpy as np
import pytest
from front_files import bedroom
from front_reading import only_room
from golden_values import hold

from data_prep.front.recipe import load_recipe
from data_prep.front.views import prepare_room
from sceneprior.core.cameras import camera_centers
from sceneprior.core.classes import STUFF
from sceneprior.core.observations import stuff_size, stuff_step, thinned, thinned_intrinsics
from sceneprior.render.offscreen import SoftwareRenderer

SMALL = ("views.image_size=[60, 80]", "views.min_object_pixels=20")


class CountingRenderer(SoftwareRenderer):
    """Counts views; the first `blind` of them see nothing."""

    def __init__(self, blind=0):
        self.blind, self.drawn = blind, []

    def instance_ids_of_views(self, meshes, cameras, image_size):
        images = super().instance_ids_of_views(meshes, cameras, image_size)
        if len(meshes) == len(STUFF) - 1:  # the room itself
            return images
        start = sum(self.drawn)
        self.drawn.append(len(cameras))
        images[: max(self.blind - start, 0)] = 0
        return images


@pytest.fixture
def drawn_room(front):
    return only_room(front, front.house("house", bedroom("A")))


def prepare(room, renderer, *rules, count=12, seed=0):
    recipe = load_recipe("bedroom", (*SMALL, *rules))
    return prepare_room(room, count, recipe, seed, renderer)


def test_views_that_see_too_little_are_drawn_again_and_the_best_stays(drawn_room):
    # Twelve views see nothing, five of their second tries neither.
    renderer = CountingRenderer(blind=12 + 5)
    views, _ = prepare(drawn_room, renderer)
    assert renderer.drawn[0] == 12 and renderer.drawn[1] == 12 and renderer.drawn[2] >= 5
    assert len(renderer.drawn) <= 8 and (views.visible.sum(axis=1) > 0).all()
    # No view shows two objects that fill it: every one is drawn `tries` times.
    renderer = CountingRenderer()
    rules = ("views.min_object_pixels=4800", "views.tries=3")
    views, _ = prepare(drawn_room, renderer, *rules, count=6)
    assert renderer.drawn == [6, 6, 6] and len(views.visible) == 6
    assert prepare(drawn_room, CountingRenderer(blind=10**6)) is None


def test_the_room_and_the_seed_decide(drawn_room):
    renderer = SoftwareRenderer()
    one, other, third = (prepare(drawn_room, renderer, seed=seed)[0] for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)
    np.testing.assert_array_equal(one.instance_ids, other.instance_ids)
    assert (one.world_to_camera != third.world_to_camera).any()
    eyes = camera_centers(one.world_to_camera)
    found = {"eyes": eyes.astype(float).tolist(), "ahead": one.world_to_camera[:, 2, :3].tolist()}
    hold("drawing", found, slack=1e-4)
    hold("drawing", {"pixels": one.mask_pixels.astype(float).tolist()}, slack=0.01)


def test_floor_and_walls_are_drawn_behind_furniture(drawn_room):
    """Each pixel shows what its ray meets: the floor at y = 0, or the wall at z = -2."""
    views, _ = prepare(drawn_room, SoftwareRenderer(), "views.image_size=[180, 480]")
    step = stuff_step(views.image_size)
    assert step == 2 and views.stuff.shape[1:] == stuff_size(views.image_size)
    free = views.instance_ids[(..., *thinned(step))] == 0
    assert not views.stuff[~free].any()
    K = thinned_intrinsics(views.intrinsics[0], step)
    seen = set()
    for stuff, pose, is_free in zip(views.stuff, views.world_to_camera, free, strict=True):
        eye = camera_centers(pose)
        for row, column in np.argwhere(is_free)[::97]:
            ray = pose[:3, :3].T @ np.linalg.solve(K, [column + 0.5, row + 0.5, 1])
            down, back = -eye[1] / ray[1], (-2 - eye[2]) / ray[2]
            on_floor, on_wall = eye + down * ray, eye + back * ray
            expected = "unknown"
            if back > 0 and abs(on_wall[0]) < 2 and 0 < on_wall[1] < 2.6:
                expected = "wall"
            elif down > 0 and np.abs(on_floor[[0, 2]]).max() < 2:
                expected = "floor"
            assert STUFF[stuff[row, column]] == expected
            seen.add(expected)
    assert seen == {"floor", "wall", "unknown"}
