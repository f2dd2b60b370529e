"""Projection, 2D boxes and rays, by hand and by symmetry."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close
from toy_rooms import look_at

from sceneprior.core.boxes import box_corners
from sceneprior.core.cameras import (
    MIN_DEPTH_M,
    boxes_of_points,
    camera_centers,
    pixel_rays,
    project,
)

LENS = torch.tensor([[50.0, 0, 40], [0, 60, 30], [0, 0, 1]], dtype=torch.float64)
SIZE = (60, 80)
AHEAD = torch.eye(4, dtype=torch.float64)


def a_room(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """(1, 5, 8, 3) box corners and (1, 6, 4, 4) cameras, some with boxes behind them."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(1, 5, 3, generator=generator, dtype=torch.float64) * 4 - 2
    sizes = torch.rand(1, 5, 3, generator=generator, dtype=torch.float64) + 0.2
    cameras = [
        torch.from_numpy(look_at(np.array([2 * math.sin(a), 1.5, 2 * math.cos(a)]), np.ones(3) / 2))
        for a in range(6)
    ]
    return box_corners(centers, sizes), torch.stack(cameras)[None]


def test_every_room_and_view_has_its_own_camera():
    points, cameras = a_room()
    rooms = torch.cat([points, points + 0.3])
    poses = torch.cat([cameras, cameras.flip(1)])
    intrinsics = LENS.expand(2, 6, 3, 3).clone()
    intrinsics[1, 2, 0, 0] = 77
    seen = project(rooms, poses, intrinsics)
    for room in range(2):
        for view in range(6):
            for item in range(5):
                for corner in range(8):
                    x, y, z, _ = poses[room, view] @ torch.cat(
                        [rooms[room, item, corner], rooms.new_ones(1)]
                    )
                    near = max(float(z), MIN_DEPTH_M)
                    fx = intrinsics[room, view, 0, 0]
                    # Behind the camera: cx * z is divided by the smallest depth too.
                    u = (fx * x + 40 * z) / near
                    v = (60 * y + 30 * z) / near
                    assert_close(
                        seen[room, view, item, corner],
                        torch.stack([u, v, z]),
                        rtol=1e-12,
                        atol=1e-9,
                    )


@pytest.mark.parametrize(
    ("corners", "box", "inside"),
    [
        # u = 25 x + 40, v = 30 y + 30 at z = 2; relative to 80 x 60.
        ([[-0.4, -0.5, 2], [0.4, 0.5, 2]], [30 / 80, 15 / 60, 50 / 80, 45 / 60], True),
        ([[-4, 0, 2], [0, 0.5, 2]], [0, 30 / 60, 40 / 80, 45 / 60], True),  # cut on the left
        ([[-9, -9, 2], [9, 9, 2]], [0, 0, 1, 1], True),  # larger than the image
        ([[2, 0, 2], [3, 0.5, 2]], [1, 0.5, 1, 0.75], False),  # right of it
        ([[-3, 0, 2], [-1.7, 0.5, 2]], [0, 0.5, 0, 0.75], False),  # left of it
        ([[0, 2, 2], [0.4, 3, 2]], [0.5, 1, 50 / 80, 1], False),  # below
        ([[0, -3, 2], [0.4, -2, 2]], [0.5, 0, 50 / 80, 0], False),  # above
        ([[1.6, 0, 2], [1.6, 0.5, 2]], [1, 0.5, 1, 0.75], False),  # u = 80: touches, no more
    ],
)
def test_boxes_are_clamped_and_know_whether_they_meet_the_image(corners, box, inside):
    points = torch.tensor([[corners]], dtype=torch.float64)
    found = boxes_of_points(points, AHEAD[None, None], LENS[None, None], SIZE)
    assert_close(found.boxes.flatten(), torch.tensor(box, dtype=torch.float64), rtol=0, atol=1e-12)
    assert bool(found.in_frustum) is inside


def test_what_is_wholly_behind_the_camera_is_not_in_the_frustum():
    corners = [[-0.4, -0.5, -2], [0.4, 0.5, -1]]
    points = torch.tensor([[corners]], dtype=torch.float64)
    assert not boxes_of_points(points, AHEAD[None, None], LENS[None, None], SIZE).in_frustum
    # So large that its corners, moved before the camera, surround the image.
    around = torch.tensor([[[[-9.0, -9, -1], [9, 9, -1]]]], dtype=torch.float64)
    assert not boxes_of_points(around, AHEAD[None, None], LENS[None, None], SIZE).in_frustum
    straddling = torch.tensor([[[*corners, [0, 0, 1.0]]]], dtype=torch.float64)
    assert boxes_of_points(straddling, AHEAD[None, None], LENS[None, None], SIZE).in_frustum


def test_boxes_pull_on_the_outermost_point_only():
    points = torch.tensor([[[[-0.4, -0.5, 2], [0.4, 0.5, 2], [0, 0, 2]]]], dtype=torch.float64)
    points.requires_grad_()
    found = boxes_of_points(points, AHEAD[None, None], LENS[None, None], SIZE)
    found.boxes[..., 0].sum().backward()  # x1 = (25 x + 40) / 80
    expected = torch.zeros(3, 3, dtype=torch.float64)
    expected[0, 0] = 25 / 80
    expected[0, 2] = 50 * 0.4 / 4 / 80
    assert_close(points.grad[0, 0], expected, rtol=1e-12, atol=1e-12)


def test_projection_passes_gradcheck():
    points, cameras = a_room(1)
    points = points[:, :2, :3].clone().requires_grad_()
    lens = LENS.expand(1, 2, 3, 3)
    in_front = project(points, cameras[:, :2], lens)[..., 2] > 0.1
    assert torch.autograd.gradcheck(
        lambda p: project(p, cameras[:, :2], lens)[in_front], (points,), atol=1e-5
    )


def test_pixel_rays_are_the_way_back_from_project():
    generator = torch.Generator().manual_seed(3)
    _, cameras = a_room()
    lens = LENS.expand(1, 6, 3, 3)
    pixels = torch.rand(1, 6, 7, 2, generator=generator, dtype=torch.float64) * 90 - 5
    rays = pixel_rays(pixels, cameras, lens)
    for view in range(6):
        start = camera_centers(cameras[:, view])
        for length in (0.5, 3.0):
            points = start[:, None] + length * rays[:, view]
            seen = project(points[:, None], cameras[:, view : view + 1], lens[:, :1])[0, 0, 0]
            assert_close(seen[:, :2], pixels[0, view], rtol=0, atol=1e-9)
            assert_close(
                seen[:, 2], torch.full((7,), length, dtype=torch.float64), rtol=0, atol=1e-12
            )
