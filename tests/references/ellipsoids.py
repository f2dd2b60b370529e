"""2D boxes of ellipsoids: once from the textbook's dual quadric, once from a cloud of points."""

import torch


def interval_of_quadric(camera, center, half, axis, near):
    """(low, high) of u (axis 0) or v (axis 1) of what is in front of z = near; autograd goes along.

    Args:
        camera: (3, 4) projection K [R | t], float64.
        center, half: (3,) of the ellipsoid.
    """
    home = torch.eye(4, dtype=center.dtype)
    home = torch.cat([home[:, :3], torch.cat([center, center.new_ones(1)])[:, None]], dim=1)
    dual = home @ torch.diag(torch.cat([half**2, -half.new_ones(1)])) @ home.T
    depth, reach = camera[2, :3] @ center + camera[2, 3], (camera[2, :3] * half).norm()
    if depth + reach <= near:  # all behind: every point moves to z = near
        middle = camera[axis, :3] @ center + camera[axis, 3]
        width = (camera[axis, :3] * half).norm()
        return (middle - width) / near, (middle + width) / near
    # The image's origin goes to the centre where there is one: far from it nothing but rounding is
    # left of a small outline.
    origin = torch.zeros((), dtype=center.dtype)
    if depth > reach:
        origin = ((camera[axis, :3] @ center + camera[axis, 3]) / depth).detach()
    shift = torch.eye(3, dtype=center.dtype)
    shift[axis, 2] = -origin
    camera = shift @ camera
    conic = -camera @ dual @ camera.T  # C*, its sign such that [2, 2] is Z0^2 - Z'Z'
    ends = []
    discriminant = conic[axis, 2] ** 2 - conic[2, 2] * conic[axis, axis]
    if discriminant > 0:
        for sign in (-1, 1):
            u = (conic[axis, 2] + sign * discriminant.sqrt()) / conic[2, 2]
            # The point on the line's plane l: Q* l, divided by its last number.
            plane = camera.T @ (torch.eye(3, dtype=camera.dtype)[axis] - u * torch.eye(3)[2])
            point = dual @ plane
            if camera[2] @ (point / point[3]) >= near:
                ends.append(u)
    if depth - reach < near:
        # The largest X on z = near, by Lagrange: the cut's centre and its half width.
        x, z = camera[axis, :3] * half, camera[2, :3] * half
        lean = (x @ z) / (z @ z)
        middle = camera[axis, :3] @ center + camera[axis, 3] + lean * (near - depth)
        width = (x - lean * z).norm() * (1 - (near - depth) ** 2 / (z @ z)).sqrt()
        ends += [(middle - width) / near, (middle + width) / near]
    return origin + torch.stack(ends).min(), origin + torch.stack(ends).max()


def boxes_of_quadrics(centers_m, sizes_m, world_to_camera, intrinsics, image_size, near):
    """`boxes_of_ellipsoids` one ellipsoid, one view and one side at a time."""
    rooms, views, objects = *world_to_camera.shape[:2], centers_m.shape[1]
    found = centers_m.new_zeros(rooms, views, objects, 4)
    in_frustum = torch.zeros(rooms, views, objects, dtype=torch.bool)
    for room in range(rooms):
        for view in range(views):
            camera = intrinsics[room, view] @ world_to_camera[room, view, :3]
            for item in range(objects):
                center, half = centers_m[room, item], sizes_m[room, item] / 2
                pairs = [interval_of_quadric(camera, center, half, i, near) for i in range(2)]
                ends = [
                    end / size for pair, size in zip(pairs, image_size[::-1], strict=True)
                    for end in pair
                ]  # fmt: skip
                x1, x2, y1, y2 = ends
                found[room, view, item] = torch.stack([x1, y1, x2, y2]).clamp(0, 1)
                top = camera[2, :3] @ center + camera[2, 3] + (camera[2, :3] * half).norm()
                meets = x1 < 1 and x2 > 0 and y1 < 1 and y2 > 0
                in_frustum[room, view, item] = bool(top > near and meets)
    return found, in_frustum
