"""Visible soft masks from the coverage and depth order of single objects, and their gradient.

The coverage of object k, drawn alone, is coverage_k = 1 - 1 / odds_k. There are three modes:

`alone`: the mask of an object is its coverage, without occlusion.

`paper`: the coverage of the whole scene, assigned to the front-most object of each pixel. The loss
cannot shift the boundary between two objects that touch in the image.

`layered`: alpha compositing. Object k is visible where it covers a pixel and no nearer object does,

    visible_k = coverage_k * prod_{j nearer than k} (1 - coverage_j),

so a loss at the boundary between two objects moves the front one, which reveals or hides the one
behind.

Objects are ordered by their depth at the pixel (see faces.py); the order carries no gradient.
"""

import numpy as np
from numba import njit

from sceneprior.render.silhouettes.cpu.kernels import in_threads

MODES = ("alone", "layered", "paper")
ALONE, LAYERED, PAPER = range(3)


@njit(inline="always")
def _in_row(bounds, origin, objects, row, here):
    """Write to `here` the objects whose window meets an image row, and return their number."""
    count = 0
    for k in range(objects):
        if bounds[origin + k, 0] <= row < bounds[origin + k, 1]:
            here[count] = k
            count += 1
    return count


@njit(inline="always")
def _in_strip(bounds, starts, origin, row, strip, here, count, who, where):
    """Write to `who` the objects of `here` whose window meets a strip, and to `where` the offset of
    the strip's row in their buffers; return their number."""
    found = 0
    for i in range(count):
        mesh = origin + here[i]
        if bounds[mesh, 2] <= strip < bounds[mesh, 3]:
            rows = bounds[mesh, 1] - bounds[mesh, 0]
            step = (strip - bounds[mesh, 2]) * rows + row - bounds[mesh, 0]
            who[found] = here[i]
            where[found] = starts[mesh] + step * 8
            found += 1
    return found


@njit(inline="always")
def _sort(order, where, found, lane, sequence, depth):
    """Sort the objects that touch a pixel, nearest first; insertion sort, since they are few."""
    count = 0
    for i in range(found):
        value = order[where[i] + lane]
        if value == -np.inf:
            continue
        z = 1.0 / value if value > 0.0 else -value
        place = count
        while place > 0 and depth[place - 1] > z:
            sequence[place], depth[place] = sequence[place - 1], depth[place - 1]
            place -= 1
        sequence[place], depth[place] = i, z
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _compose(first, last, odds, order, bounds, starts, mode, visible, front, front_depth):
    """Compute the visible masks, the front-most object and its depth of images[first:last].

    Inputs are packed in windows. Results are written to arrays over whole images, which the caller
    initialises: `visible` with 0, `front` with -1 and `front_depth` with inf.
    """
    _, objects, height, width = visible.shape
    T = visible.dtype.type
    one = T(1)
    for image in range(first, last):
        origin = image * objects
        here = np.empty(objects, dtype=np.int64)
        who, where = np.empty(objects, dtype=np.int64), np.empty(objects, dtype=np.int64)
        sequence, depth = np.empty(objects, dtype=np.int64), np.empty(objects)
        for row in range(height):
            in_row = _in_row(bounds, origin, objects, row, here)
            for strip in range((width + 7) // 8 if in_row > 0 else 0):
                found = _in_strip(bounds, starts, origin, row, strip, here, in_row, who, where)
                lanes = min(8, width - strip * 8)
                for i in range(found):
                    for lane in range(lanes):
                        nearness = order[where[i] + lane]
                        column = strip * 8 + lane
                        if nearness > 0.0 and one / nearness < front_depth[image, row, column]:
                            front_depth[image, row, column] = one / nearness
                            front[image, row, column] = who[i]
                if mode == ALONE or found == 1:
                    for i in range(found):
                        for lane in range(lanes):
                            visible[image, who[i], row, strip * 8 + lane] = (
                                one - one / odds[where[i] + lane]
                            )
                    continue
                for lane in range(lanes if found > 0 else 0):
                    column = strip * 8 + lane
                    left = one
                    for place in range(_sort(order, where, found, lane, sequence, depth)):
                        i = sequence[place]
                        missed = one / odds[where[i] + lane]
                        if mode == LAYERED:
                            visible[image, who[i], row, column] = left * (one - missed)
                        left *= missed
                    if mode == PAPER and left < one:
                        visible[image, who[sequence[0]], row, column] = one - left


@njit(cache=True, nogil=True, error_model="numpy")
def _compose_backward(first, last, odds, order, bounds, starts, mode, upstream, packed):
    """Compute -dL/dlog(missed), packed in windows, from the dense dL/dvisible."""
    _, objects, height, width = upstream.shape
    T = upstream.dtype.type
    one, zero = T(1), T(0)
    for image in range(first, last):
        origin = image * objects
        here = np.empty(objects, dtype=np.int64)
        who, where = np.empty(objects, dtype=np.int64), np.empty(objects, dtype=np.int64)
        sequence, depth = np.empty(objects, dtype=np.int64), np.empty(objects)
        before = np.empty(objects + 1, dtype=odds.dtype)
        for row in range(height):
            in_row = _in_row(bounds, origin, objects, row, here)
            for strip in range((width + 7) // 8 if in_row > 0 else 0):
                found = _in_strip(bounds, starts, origin, row, strip, here, in_row, who, where)
                lanes = min(8, width - strip * 8)
                if mode == ALONE or found == 1:
                    for i in range(found):
                        for lane in range(lanes):
                            j = where[i] + lane
                            packed[j] = upstream[image, who[i], row, strip * 8 + lane] / odds[j]
                    continue
                for lane in range(lanes if found > 0 else 0):
                    column = strip * 8 + lane
                    count = _sort(order, where, found, lane, sequence, depth)
                    before[0] = one
                    for place in range(count):
                        before[place + 1] = before[place] / odds[where[sequence[place]] + lane]
                    behind = zero if mode == LAYERED else one
                    for place in range(count - 1, -1, -1):
                        j = where[sequence[place]] + lane
                        missed = one / odds[j]
                        if mode == LAYERED:
                            above = upstream[image, who[sequence[place]], row, column]
                            packed[j] = before[place] * (above - behind) * missed
                            behind = above * (one - missed) + missed * behind
                        else:
                            # The front-most object's mask is 1 - prod missed of all objects.
                            above = upstream[image, who[sequence[0]], row, column]
                            packed[j] = above * before[place] * behind * missed
                            behind *= missed


def compose(odds, order, windows, compositing, shape):
    """Visible masks (images, objects, H, W), front-most object and its depth (images, H, W)."""
    images, _, height, width = shape
    visible = np.zeros(shape, dtype=odds.dtype)
    front = np.full((images, height, width), -1, dtype=np.int32)
    depth = np.full((images, height, width), np.inf, dtype=odds.dtype)
    mode = MODES.index(compositing)
    in_threads(_compose, images, odds, order, *windows, mode, visible, front, depth)
    return visible, front, depth


def compose_backward(odds, order, windows, compositing, upstream):
    """-dL/dlog(missed) = dL/dcoverage * (1 - coverage), packed in windows."""
    packed = np.zeros_like(odds)
    mode = MODES.index(compositing)
    in_threads(_compose_backward, len(upstream), odds, order, *windows, mode, upstream, packed)
    return packed
