"""2D boxes of ellipsoids: against the dual quadric, dense points, icospheres and by hand."""

import pytest
import torch
from references.ellipsoids import boxes_of_quadrics
from torch.testing import assert_close

from sceneprior.core.cameras import MIN_DEPTH_M
from sceneprior.core.proxies import boxes_of_ellipsoids

SIZE = (60, 80)
WIDE = 1e-5
"""Focal length over image size of a lens that sees 179.99 degrees: few boxes are clamped, and of a
cut, X / 1 mm, some ends are inside of the image."""
KINDS = {  # depth of the centre; full extents; log-normal spread of the extents
    "in front": ((2, 6), 0.8, 0.5),
    "far": ((50, 100), 1.0, 0.5),
    "tiny": ((0.1, 100), 1e-4, 0),
    "thin": ((1, 5), 0.3, 2.0),
    "beside and behind": ((-4, 1), 0.7, 0.5),
    "around the camera": ((-0.6, 0.6), 2.0, 0.7),
    "touching the near plane": ((-1e-3, 3e-3), 2e-3, 0.3),
}


def make_scene(kind, focal=0.7, rooms=3, views=4, objects=3, seed=0):
    """Random rooms; every view has one of the objects at the kind's depth, in or near the image."""
    (nearest, farthest), extent, spread = KINDS[kind]
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    centers = normal(rooms, objects, 3)
    sizes = extent * (spread * normal(rooms, objects, 3)).exp()
    turn = torch.linalg.qr(normal(rooms, views, 3, 3))[0]
    turn = turn * torch.linalg.det(turn)[..., None, None]
    share = torch.rand(rooms, views, 1, generator=generator, dtype=torch.float64)
    depth = nearest + (farthest - nearest) * share
    middle = torch.cat([normal(rooms, views, 2) * (0.3 * depth.abs() + extent / 4), depth], dim=-1)
    aim = centers[:, torch.arange(views) % objects]
    cameras = torch.eye(4, dtype=torch.float64).repeat(rooms, views, 1, 1)
    cameras[..., :3, :3] = turn
    cameras[..., :3, 3] = middle - (turn @ aim[..., None])[..., 0]
    lens = torch.tensor(  # skewed, and no two rows alike
        [[80 * focal, 9 * focal, 42], [0, 70 * focal, 28], [0, 0, 1]], dtype=torch.float64
    )
    return centers, sizes, cameras, lens.expand(rooms, views, 3, 3)


@pytest.mark.parametrize("focal", [0.7, WIDE])
@pytest.mark.parametrize("kind", KINDS)
def test_boxes_and_gradients_are_those_of_the_dual_quadric(kind, focal):
    """In all four tensors: autograd through the textbook's roots knows nothing of our backward."""
    scene = [tensor.clone().requires_grad_() for tensor in make_scene(kind, focal)]
    found = boxes_of_ellipsoids(*scene, SIZE)
    boxes, in_frustum = boxes_of_quadrics(*scene, SIZE, MIN_DEPTH_M)
    # Both lose digits to what is tiny beside its distance or, with the wide lens, to the offset of
    # the principal point; where neither is so, they agree to 1e-14.
    hard = focal == WIDE or kind in ("tiny", "touching the near plane")
    assert_close(found.boxes, boxes, rtol=0, atol=1e-9 if hard else 1e-14)
    assert torch.equal(found.in_frustum, in_frustum)
    pull = torch.randn(boxes.shape, generator=torch.Generator().manual_seed(1), dtype=boxes.dtype)
    ours = torch.autograd.grad((found.boxes * pull).sum(), scene)
    theirs = torch.autograd.grad((boxes * pull).sum(), scene)
    for one, other in zip(ours, theirs, strict=True):
        assert other.abs().max() > 0
        largest = float(other.abs().max())
        assert_close(one, other, rtol=0, atol=largest * (1e-6 if hard else 1e-13))


def a_ball(depth, radius, dtype=torch.float64, **more):
    """A ball on the axis of one camera whose focal length is 50 px; (60, 80) image."""
    center = torch.tensor([[[0.0, 0, depth]]], dtype=dtype)
    lens = torch.tensor([[[[50.0, 0, 40], [0, 50, 30], [0, 0, 1]]]], dtype=dtype)
    ahead = torch.eye(4, dtype=dtype)[None, None]
    return center, torch.full((1, 1, 3), 2 * radius, dtype=dtype), ahead, lens


@pytest.mark.parametrize("focal", [0.7, WIDE])
@pytest.mark.parametrize("kind", ["in front", "thin", "beside and behind", "around the camera"])
def test_gradcheck(kind, focal):
    scene = make_scene(kind, focal, rooms=2, views=2, seed=7)
    # The wide lens is 8e-4 px long: too short to step in its own numbers, and beside the offset of
    # the principal point it leaves boxes 11 digits.
    asking, eps, atol = (scene, 1e-8, 1e-5) if focal != WIDE else (scene[:3], 1e-6, 1e-4)
    assert torch.autograd.gradcheck(
        lambda *tensors: boxes_of_ellipsoids(*tensors, *scene[len(tensors) :], SIZE).boxes,
        [tensor.clone().requires_grad_() for tensor in asking],
        eps=eps,
        atol=atol,
        rtol=1e-4,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("focal", [50.0, 50 * WIDE])
def test_degenerate_ellipsoids_have_finite_boxes_and_gradients(dtype, focal):
    """Points, rods and plates; at the camera, on its plane, on the near plane, touching either."""
    places = torch.tensor(
        [-2, -0.5, -0.25, -1e-3, 0, 1e-3, 2e-3, 0.25, 0.251, 0.5, 100], dtype=dtype
    )
    extents = torch.tensor([0, 1e-30, 1e-20, 1e-10, 1e-4, 0.5, 100], dtype=dtype)
    aside = torch.tensor([0, 1e-3, 0.25, 0.5], dtype=dtype)
    rows = torch.cartesian_prod(aside, places, extents, extents, extents)
    center = torch.stack([rows[:, 0], torch.zeros_like(rows[:, 0]), rows[:, 1]], dim=-1)[None]
    size = rows[None, :, 2:].clone()
    _, _, ahead, lens = a_ball(1, 1, dtype)
    lens[..., (0, 1), (0, 1)] = focal
    scene = [tensor.contiguous().requires_grad_() for tensor in (center, size, ahead, lens)]
    boxes = boxes_of_ellipsoids(*scene, SIZE).boxes
    assert torch.isfinite(boxes).all()
    assert (boxes[..., :2] <= boxes[..., 2:]).all()
    for side in range(4):
        for slope in torch.autograd.grad(boxes[..., side].sum(), scene, retain_graph=True):
            assert torch.isfinite(slope).all()
