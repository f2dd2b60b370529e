"""Soft silhouettes one pixel and one face at a time, in Python floats: the definition."""

import math

import numpy as np


def soft_coverage_loop(pixels, depths, faces, drawn, image_size, sigma_px2, blur_px2, near_m):
    """Coverage and depth (meshes, H, W) of projected meshes (meshes, vertices, 2)."""
    height, width = image_size
    coverage = np.zeros((len(pixels), height, width))
    depth = np.full((len(pixels), height, width), np.inf)
    for mesh in range(len(pixels)):
        for row in range(height):
            for column in range(width):
                point = (column + 0.5, row + 0.5)
                log_missed = 0.0
                for face in faces if drawn[mesh] else ():
                    corners = [tuple(map(float, pixels[mesh][k])) for k in face]
                    z = [float(depths[mesh][k]) for k in face]
                    touch = face_at_pixel(point, corners, z, blur_px2, near_m)
                    if touch is None:
                        continue
                    distance2, inside, here = touch
                    x = (distance2 if inside else -distance2) / sigma_px2
                    # log(1 - sigmoid(x)); the chance that this face misses the pixel.
                    log_missed -= max(x, 0.0) + math.log1p(math.exp(-abs(x)))
                    depth[mesh, row, column] = min(depth[mesh, row, column], here)
                coverage[mesh, row, column] = -math.expm1(log_missed)
    return coverage, depth


def face_at_pixel(point, corners, z, blur_px2, near_m):
    """Squared distance to the outline, whether inside, and depth; None where it does not count."""
    if min(z) <= near_m:
        return None
    a, b, c = corners
    area = cross(a, b, c)
    if abs(area) <= 1e-12:
        return None
    weights = [cross(b, c, point) / area, cross(c, a, point) / area, cross(a, b, point) / area]
    inside = all(weight > 0 for weight in weights)
    distance2 = min(to_segment(point, a, b), to_segment(point, b, c), to_segment(point, c, a))
    if not inside and distance2 >= blur_px2:
        return None
    clipped = [max(weight, 0.0) for weight in weights]
    inverse = sum(weight / depth for weight, depth in zip(clipped, z, strict=True))
    return distance2, inside, sum(clipped) / inverse


def cross(start, end, point):
    return (end[0] - start[0]) * (point[1] - start[1]) - (end[1] - start[1]) * (point[0] - start[0])


def to_segment(point, start, end):
    ex, ey = end[0] - start[0], end[1] - start[1]
    length2 = ex * ex + ey * ey
    t = 0.0
    if length2 > 0:
        t = ((point[0] - start[0]) * ex + (point[1] - start[1]) * ey) / length2
        t = min(max(t, 0.0), 1.0)
    return (point[0] - start[0] - t * ex) ** 2 + (point[1] - start[1] - t * ey) ** 2


def composite_loop(coverage, depth, mode):
    """Visible masks (images, objects, H, W) from coverages and depths."""
    visible = np.zeros(coverage.shape)
    images, objects, height, width = coverage.shape
    for image in range(images):
        for row in range(height):
            for column in range(width):
                here = [k for k in range(objects) if np.isfinite(depth[image, k, row, column])]
                here.sort(key=lambda k: (depth[image, k, row, column], k))
                if not here:
                    continue
                missed = 1.0
                for k in here:
                    if mode == "layered":
                        visible[image, k, row, column] = missed * coverage[image, k, row, column]
                    missed *= 1 - coverage[image, k, row, column]
                if mode == "paper":
                    visible[image, here[0], row, column] = 1 - missed
    return visible
