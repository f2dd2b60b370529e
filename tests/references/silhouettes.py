"""Soft silhouettes one pixel and one face at a time, in Python floats: the definition. And the
fast mode from its words: one shape, the union of the projected faces, by shapely."""

import math

import numpy as np
import shapely

NOWHERE = (0.0, math.inf, math.inf)


def exact_loop(pixels, depths, faces, drawn, settings):
    """Coverage, order and depth (meshes, H, W) of projected meshes (meshes, vertices, 2).

    Order is what decides who is in front: the depth of the nearest face that contains the
    pixel centre, or else of the nearest one whose blur reaches it.
    """
    height, width = settings.image_size
    result = np.empty((3, len(pixels), height, width))
    for mesh in range(len(pixels)):
        for row in range(height):
            for column in range(width):
                point = (column + 0.5, row + 0.5)
                seen = NOWHERE
                if drawn[mesh]:
                    seen = mesh_at_pixel(point, pixels[mesh], depths[mesh], faces, settings)
                result[:, mesh, row, column] = seen
    return result


def mesh_at_pixel(point, pixels, depths, faces, settings):
    """Coverage, order and depth of one mesh at one point."""
    log_missed, depth, halo = 0.0, math.inf, math.inf
    for face in faces:
        corners = [tuple(map(float, pixels[k])) for k in face]
        z = [float(depths[k]) for k in face]
        touch = face_at_pixel(point, corners, z, settings.blur_px2, settings.near_m)
        if touch is None:
            continue
        distance2, inside, here = touch
        x = (distance2 if inside else -distance2) / settings.sigma_px2
        # log(1 - sigmoid(x)); the chance that this face misses the pixel.
        log_missed -= max(x, 0.0) + math.log1p(math.exp(-abs(x)))
        if inside:
            depth = min(depth, here)
        else:
            halo = min(halo, here)
    return -math.expm1(log_missed), depth if depth < math.inf else halo, depth


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


def composite_loop(coverage, order, mode):
    """Visible masks (images, objects, H, W) from coverages and orders."""
    visible = np.zeros(coverage.shape)
    images, objects, height, width = coverage.shape
    for image in range(images):
        for row in range(height):
            for column in range(width):
                here = [k for k in range(objects) if np.isfinite(order[image, k, row, column])]
                here.sort(key=lambda k: (order[image, k, row, column], k))
                if not here:
                    continue
                missed = 1.0
                for k in here:
                    alone = coverage[image, k, row, column]
                    if mode != "paper":
                        visible[image, k, row, column] = alone * (
                            missed if mode == "layered" else 1
                        )
                    missed *= 1 - alone
                if mode == "paper":
                    visible[image, here[0], row, column] = 1 - missed
    return visible


def shape_of(pixels, depths, faces, near_m=0.05):
    """The union of the projected faces of one mesh, a shapely polygon or several."""
    corners = pixels[faces[(depths[faces] > near_m).all(axis=1)]]
    triangles = shapely.polygons(corners)
    whole = shapely.union_all(triangles[shapely.area(triangles) > 5e-13])
    # Edges that meet only up to rounding leave holes of 1e-15 px2: nobody means them.
    polygons = []
    for polygon in shapely.get_parts(whole):
        holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area > 1e-6]
        polygons.append(shapely.Polygon(polygon.exterior, holes))
    return shapely.union_all(polygons)


def shape_coverage(shape, image_size, sigma_px2, blur_px2):
    """sigmoid(+-d / sigma), d the squared distance of a pixel centre to the shape's boundary;
    hard from `blur_px2` on."""
    rows, columns = np.mgrid[: image_size[0], : image_size[1]] + 0.5
    points = shapely.points(columns, rows)
    squared = shapely.distance(points, shape.boundary) ** 2
    inside = shapely.covers(shape, points)
    signed = np.where(inside, squared, -squared) / sigma_px2
    with np.errstate(over="ignore"):  # far outside: 1 / (1 + inf) = 0
        return np.where(squared < blur_px2, 1 / (1 + np.exp(-signed)), inside)


def junctions(shape, pixels):
    """Corners of the shape at which two projected edges cross: they are no vertex's."""
    corners = shapely.get_coordinates(shape)
    apart = np.linalg.norm(corners[:, None] - pixels[None], axis=-1).min(axis=1)
    return corners[apart > 1e-9]
