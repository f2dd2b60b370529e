"""Proxies of objects: template spheres, beveled cubes, and ellipsoids with exact 2D boxes."""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.core.boxes import CUBE_CORNERS
from sceneprior.core.cameras import MIN_DEPTH_M, Boxes2D
from sceneprior.core.repeatable import constants


def icosphere(level: int) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """Make a unit icosphere of 20 * 4**level outward triangles; the authors use level 4."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=level)
    vertices = torch.tensor(np.asarray(sphere.vertices), dtype=torch.float32)
    return vertices, torch.tensor(np.asarray(sphere.faces), dtype=torch.int64)


def to_cube(sphere: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
    """Project a unit sphere's vertices radially onto the cube [-1, 1]^3."""
    return sphere / sphere.abs().amax(dim=-1, keepdim=True)


def beveled_cube(bevels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 32 3"]:
    """Vertices of the cube [-1, 1]^3 with beveled edges; they still touch all six sides.

    `bevels` holds the bevel of the vertical edges and that of the horizontal edges, in half sides,
    [0, 1]: (0, 0) is the cube, (1, 0) a prism over a diamond, and (1, 1) an octahedron.
    """
    upright, level = (1 - bevels).unsqueeze(-2).unbind(dim=-1)
    x, y, z = constants(bevels, *CUBE_CORNERS.flat).view(-1, 3).unbind(dim=-1)
    rings = []
    for across, along in ((x, upright * z), (upright * x, z)):
        across, along = torch.broadcast_tensors(across, along)
        rings.append(torch.stack([across, level * y, along], dim=-1))
        rings.append(torch.stack([level * across, y.expand_as(across), level * along], dim=-1))
    return torch.cat(rings, dim=-2)


def place(
    canonical: Float[Tensor, "rooms objects vertices 3"],
    centers_m: Float[Tensor, "rooms objects 3"],
    sizes_m: Float[Tensor, "rooms objects 3"],
) -> Float[Tensor, "rooms objects vertices 3"]:
    """Transform canonical meshes into their boxes: o = M * s / 2 + c.

    The cube [-1, 1]^3 fills the box, so the unit sphere touches all six sides of the box.
    """
    return canonical * (sizes_m / 2).unsqueeze(-2) + centers_m.unsqueeze(-2)


SERIAL_NUMEL = 32768
"""Number of elements up to which torch runs an operation on one thread. Tensors are split into
pieces of this size. With larger ones, each of a hundred small operations would wait for other
threads, 1 s per step on busy cores; the pieces also fit the cache."""


def boxes_of_ellipsoids(
    centers_m: Float[Tensor, "rooms objects 3"],
    sizes_m: Float[Tensor, "rooms objects 3"],
    world_to_camera: Float[Tensor, "rooms views 4 4"],
    intrinsics: Float[Tensor, "rooms views 3 3"],
    image_size: tuple[int, int],
) -> Boxes2D:
    """Exact 2D box of the ellipsoid inscribed in each 3D box, in every view.

    A point of the ellipsoid is c + (size / 2) * w with |w| <= 1. In a view its column is u = X / Z,
    where X and Z are linear in w: X = X0 + X'w and Z = Z0 + Z'w. If the ellipsoid lies wholly in
    front of the camera, the sides of its box are the tangents of the dual quadric, the roots of
    (Z0^2 - Z'Z') u^2 - 2 (X0 Z0 - X'Z') u + (X0^2 - X'X'). An ellipsoid that crosses the plane at
    depth `MIN_DEPTH_M` is clipped there, and a side may then be an extreme of the ellipse in which
    the plane cuts it. Rows, v, are treated likewise.

    Arguments have the units of `boxes_of_points`; sizes are full extents, and intrinsics may have
    skew.

    Returns:
        Boxes x1, y1, x2, y2 relative to the image size, clamped to [0, 1]; and `in_frustum`. They
        equal the result of `boxes_of_points` for all points of the solid, except that this function
        clips points behind the camera, whereas `boxes_of_points` moves them to `MIN_DEPTH_M`. Both
        functions report an ellipsoid wholly behind the camera as outside the frustum, and return
        the box of its points moved to `MIN_DEPTH_M`. The boxes are differentiable once with respect
        to every tensor, and gradients are finite for finite inputs.

    Source:
        Rubino et al., "3D Object Localisation from Multi-view Image Detections", TPAMI 2018
        (dual quadrics and boxes); the clipping and the backward pass are ours.

    Example: a ball of radius 0.6 m, 1 m ahead, ends at u = tan(asin(0.6)) = 0.75 on both sides.

        >>> center, size = torch.tensor([[[0.0, 0, 1]]]), torch.full((1, 1, 3), 1.2)
        >>> intrinsics = torch.tensor([[[[40.0, 0, 50], [0, 40, 50], [0, 0, 1]]]])
        >>> ahead = torch.eye(4)[None, None]
        >>> boxes, inside = boxes_of_ellipsoids(center, size, ahead, intrinsics, (100, 100))
        >>> [round(x, 5) for x in boxes.flatten().tolist()], inside.item()
        ([0.2, 0.2, 0.8, 0.8], True)
    """
    height, width = image_size
    # Image coordinates are scaled to order 1, so that their squares stay within float32.
    scale = constants(intrinsics, 1 / width, 1 / height, 1.0).unsqueeze(-1)
    rows = scale * (intrinsics @ world_to_camera[..., :3, :3])
    offset = (scale * (intrinsics @ world_to_camera[..., :3, 3:]))[..., 0]
    per_room = 12 * rows.shape[1] * max(centers_m.shape[1], 1)
    step = max(SERIAL_NUMEL // per_room, 1) if rows.device.type == "cpu" else len(rows)
    tensors = (centers_m, sizes_m / 2, rows, offset)
    pieces = zip(*(tensor.split(step) for tensor in tensors), strict=True)
    boxes, in_frustum = zip(*(_BoxesOfEllipsoids.apply(*piece) for piece in pieces), strict=True)
    return Boxes2D(torch.cat(boxes), torch.cat(in_frustum))


class _Sides(NamedTuple):
    """Sides of the 2D boxes. The first axis is (low side, high side), the second (u, v)."""

    value: Float[Tensor, "2 2 rooms views objects"]
    """Unclamped coordinate of the side."""
    at: Float[Tensor, "2 2 3 rooms views objects"]
    """w of the extreme point, which is centre + half size * w."""
    trade: Float[Tensor, "2 2 rooms views objects"]
    """dX / dZ along the side: u for a tangent; for a cut, how far the extreme moves with Z."""
    depth: Float[Tensor, "2 2 rooms views objects"]
    """Z of the extreme point, the divisor of the projection."""


class _BoxesOfEllipsoids(torch.autograd.Function):
    """Boxes from extreme points, with a hand-written gradient.

    A side is the extreme of X / Z over a ball, so by the envelope theorem the motion of the extreme
    point within the ball does not contribute: d side = (dX - trade dZ) / Z at fixed w. No square
    root is differentiated, so gradients stay finite where an outline vanishes. Autograd sees one
    node, and a step takes two thirds of the time that autograd takes for the same formulas.
    """

    @staticmethod
    def forward(ctx: Any, center: Tensor, half: Tensor, rows: Tensor, offset: Tensor) -> Any:
        # Coordinates are the first axes, because sums over a short last axis are slow.
        by_view = rows.permute(2, 3, 0, 1).unsqueeze(-1)
        middle = (by_view * center.permute(2, 0, 1).unsqueeze(2)).sum(dim=1)
        middle = middle + offset.permute(2, 0, 1).unsqueeze(-1)
        spread = by_view * half.permute(2, 0, 1).unsqueeze(2)
        sides, ahead = _find_sides(middle, spread)
        meets_image = ((sides.value[0] < 1) & (sides.value[1] > 0)).all(dim=0)
        inside = (sides.value >= 0) & (sides.value <= 1)
        weight = torch.where(inside, 1 / sides.depth, 0)
        ctx.save_for_backward(center, half, rows, sides.at, sides.trade, weight)
        in_frustum = ahead & meets_image
        ctx.mark_non_differentiable(in_frustum)
        return sides.value.clamp(0, 1).flatten(0, 1).movedim(0, -1), in_frustum

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_boxes: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        center, half, rows, at, trade, weight = ctx.saved_tensors
        by_view = rows.permute(2, 3, 0, 1).unsqueeze(-1)
        d_x = d_boxes.movedim(-1, 0).unflatten(0, (2, 2)) * weight
        d_z = -trade * d_x
        d_center = d_half = d_rows = d_offset = None
        if any(ctx.needs_input_grad[:2]):
            # Gradients of the extreme points in the world, summed over views below.
            d_point = d_x.unsqueeze(2) * by_view[:2] + d_z.unsqueeze(2) * by_view[2]
            d_center = d_point.sum(dim=(0, 1, 4)).permute(1, 2, 0)
            d_half = (d_point * at).sum(dim=(0, 1, 4)).permute(1, 2, 0)
        if any(ctx.needs_input_grad[2:]):
            first = (3, 0, 1, 2)
            point = center[:, None].permute(first) + half[:, None].permute(first) * at
            by_row = [d_x.sum(0)[0], d_x.sum(0)[1], d_z.sum((0, 1))]
            d_offset = torch.stack(by_row).sum(-1).permute(1, 2, 0)
            d_lines = (d_x.unsqueeze(2) * point).sum(dim=(0, -1))
            d_depth = (d_z.unsqueeze(2) * point).sum(dim=(0, 1, -1))
            d_rows = torch.cat([d_lines, d_depth[None]]).permute(2, 3, 0, 1)
        return d_center, d_half, d_rows, d_offset


def _find_sides(
    middle: Float[Tensor, "3 rooms views objects"], spread: Float[Tensor, "3 3 rooms views objects"]
) -> tuple[_Sides, Bool[Tensor, "rooms views objects"]]:
    """Find the extreme points, and whether any part of the ellipsoid is in front of the camera.

    Args:
        middle: X0, Y0, Z0 of the centre, with X0 and Y0 relative to the image size.
        spread: X', Y' and Z', three numbers each: the point of w is at middle + spread @ w.
    """
    tiny = 1e-30  # its square underflows to 0; dividing by anything larger is safe in float32
    sign = constants(middle, -1.0, 1.0).reshape(2, 1, 1, 1, 1)
    z0, dz = middle[2], spread[2]
    reach_sq = (dz * dz).sum(dim=0)
    reach = reach_sq.sqrt()
    in_front = z0 - reach >= MIN_DEPTH_M
    ahead = z0 + reach > MIN_DEPTH_M
    # A shear u -> u - shear at fixed Z simplifies the formulas and avoids cancellation. It moves
    # the centre of an ellipsoid in front to u = 0, and aligns a cut ellipsoid with X and Z.
    lean = (spread[:2] * dz).sum(dim=1) / reach_sq
    shear = torch.where(in_front, middle[:2] / z0, torch.where(ahead, lean, 0))
    dx = spread[:2] - shear.unsqueeze(1) * dz
    x0 = torch.where(in_front, 0, middle[:2] - shear * z0)
    dx_dz = torch.where(in_front, (dx * dz).sum(dim=1), 0)
    width_sq = (dx * dx).sum(dim=1)
    width = width_sq.sqrt()

    # Tangents: a u^2 - 2 b u + c = 0 has real roots if the camera is outside the outline.
    a = (z0 - reach) * (z0 + reach)
    b = x0 * z0 - dx_dz
    c = (x0.abs() - width) * (x0.abs() + width)
    root_sq = dx_dz * dx_dz + x0 * x0 * reach_sq + width_sq * a  # b b - a c without cancellation
    root = root_sq.clamp(min=0).sqrt().clamp(min=tiny)
    sum_of_both = torch.where(b < 0, b - root, b + root)
    far, near = sum_of_both / a, c / sum_of_both
    tangent = torch.where((sign < 0) == (b < 0), far, near)
    # The tangent point has depth root * lever / norm; behind the plane it is not visible.
    lever = z0 * root - sign * x0 * reach_sq
    norm = z0 * z0 * width_sq + x0 * x0 * reach_sq
    touches = in_front | (ahead & (root_sq > 0) & (root * lever >= MIN_DEPTH_M * norm))
    # Squared length of X' - tangent Z', the direction of the tangent point's w; no cancellation.
    length_sq = torch.where(in_front, (tangent * z0) ** 2, width_sq + tangent**2 * reach_sq)
    touch_dx = sign / length_sq.sqrt().clamp(min=tiny)
    touch_dz = -tangent * touch_dx
    touch_depth = (z0 + touch_dx * dx_dz + touch_dz * reach_sq).clamp(min=MIN_DEPTH_M)

    # The cut: w = t along Z' and up to sqrt(1 - t t) along X', which are perpendicular here.
    # An ellipsoid wholly behind is treated as if moved to the plane: t = 0, without a shear.
    along = torch.where(ahead, (MIN_DEPTH_M - z0) / reach.clamp(min=tiny), 0).clamp(-1, 1)
    beside = ((1 - along) * (1 + along)).sqrt()
    cut = (x0 + sign * width * beside) / MIN_DEPTH_M
    cut_dx = sign * beside / width.clamp(min=tiny)
    cut_dz = along / reach.clamp(min=tiny)
    # The derivative at a vanishing cut is unbounded, so the cut's radius is clamped to 1e-4.
    drift = sign * width * along / (reach * beside.clamp(min=1e-4)).clamp(min=tiny)

    by_dx = torch.where(touches, touch_dx, cut_dx).unsqueeze(2)
    by_dz = torch.where(touches, touch_dz, cut_dz).unsqueeze(2)
    return _Sides(
        shear + torch.where(touches, tangent, cut),
        by_dx * dx + by_dz * dz,
        shear + torch.where(touches, tangent, -drift),
        torch.where(touches, touch_depth, MIN_DEPTH_M),
    ), ahead
