"""The ray loss ray by ray and sample by sample, in Python floats."""

import itertools
import math


def ray_loss(logits, centers, sizes, margin, rays, samples, offsets):
    """(loss, accuracy) of nested lists: logits[object][x][y][z], offsets[object][ray].

    `rays` are lists of origins, directions, hits and ends, each [object][ray].
    """
    origins, directions, hits, ends = rays
    entropies, right = [], []
    for item, grid in enumerate(logits):
        frame = [margin * size for size in sizes[item]]
        for ray in range(len(hits[item])):
            origin, direction = origins[item][ray], directions[item][ray]
            part = part_in_frame(origin, direction, centers[item], frame, ends[item][ray])
            if part is None:
                continue
            enter, leave = part
            values = []
            for sample in range(samples):
                along = enter + (leave - enter) * (sample + offsets[item][ray]) / samples
                point = [o + along * d for o, d in zip(origin, direction, strict=True)]
                values.append(logit_at(grid, point, centers[item], frame))
            soft = math.log(sum(math.exp(4 * value) for value in values)) / 4
            p = 1 / (1 + math.exp(-(soft - math.log(samples) / 8)))
            entropies.append(-math.log(p if hits[item][ray] else 1 - p))
            right.append((max(values) > 0) == hits[item][ray])
    if not entropies:
        return 0.0, 0.0
    return sum(entropies) / len(entropies), sum(right) / len(right)


def part_in_frame(origin, direction, center, frame, end):
    """From where to where along the ray it is in the frame, or None."""
    enter, leave = 0.0, end
    for o, d, c, edge in zip(origin, direction, center, frame, strict=True):
        low, high = c - edge / 2, c + edge / 2
        if d == 0:
            if not low <= o <= high:
                return None
            continue
        first, second = sorted(((low - o) / d, (high - o) / d))
        enter, leave = max(enter, first), min(leave, second)
    return (enter, leave) if leave > enter else None


def logit_at(grid, point, center, frame):
    """Trilinear between the centres of cells; a point beyond the outermost ones takes theirs."""
    corners = []
    for value, c, edge, cells in zip(point, center, frame, shape_of(grid), strict=True):
        place = (value - (c - edge / 2)) / edge * cells - 0.5
        place = min(max(place, 0.0), cells - 1.0)
        below = min(int(place), cells - 2)
        corners.append(((below, below + 1 - place), (below + 1, place - below)))
    return sum(
        x_weight * y_weight * z_weight * grid[x][y][z]
        for (x, x_weight), (y, y_weight), (z, z_weight) in itertools.product(*corners)
    )


def total_variation(logits):
    """Mean |difference| of occupancies along x, plus that along y, plus that along z."""
    axes = ([], [], [])
    for grid in logits:
        cells = shape_of(grid)
        for cell in itertools.product(*(range(n) for n in cells)):
            for axis in range(3):
                after = list(cell)
                after[axis] += 1
                if after[axis] < cells[axis]:
                    axes[axis].append(abs(occupied(grid, after) - occupied(grid, cell)))
    return sum(sum(axis) / len(axis) for axis in axes)


def occupied(grid, cell):
    x, y, z = cell
    return 1 / (1 + math.exp(-grid[x][y][z]))


def shape_of(grid):
    return len(grid), len(grid[0]), len(grid[0][0])
