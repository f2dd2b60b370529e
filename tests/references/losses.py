"""The view loss object by object, in Python floats: the paper's section 3.4 and supplement B."""

import itertools
import math


def best_assignment(cost):
    """Try every permutation of the first n predictions: (prediction of each object, total)."""
    n = len(cost)
    best = min(
        itertools.permutations(range(n)),
        key=lambda rows: sum(cost[row][column] for column, row in enumerate(rows)),
    )
    return list(best), sum(cost[row][column] for column, row in enumerate(best))


def pair_cost(logits, predicted, label, observed, visible, clear, box_weight, occlusion_slack):
    """Cost of one prediction for one object; boxes are lists over views; 0 if never visible."""
    views = [view for view, seen in enumerate(visible) if seen]
    if not views:
        return 0.0
    apart = [
        box_distance(predicted[view], observed[view], clear[view], occlusion_slack)
        for view in views
    ]
    return -softmax(logits)[label] + box_weight * sum(apart) / len(views)


def box_distance(predicted, observed, clear, occlusion_slack):
    """|x1 - x1'| + |y1 - y1'| + |x2 - x2'| + |y2 - y2'|; beyond an occluder weighs less."""
    total = 0.0
    for side, outward in enumerate((-1, -1, 1, 1)):
        apart = predicted[side] - observed[side]
        weight = occlusion_slack if apart * outward > 0 and not clear[side] else 1.0
        total += weight * abs(apart)
    return total


def softmax(logits):
    top = max(logits)
    powers = [math.exp(value - top) for value in logits]
    return [power / sum(powers) for power in powers]


def class_loss(logits, labels, valid):
    """logits[room][prediction-of-object], labels[room][object]: mean of -log p over valid ones."""
    each = [
        -math.log(softmax(logits[room][item])[labels[room][item]])
        for room in range(len(labels))
        for item in range(len(labels[room]))
        if valid[room][item]
    ]
    return sum(each) / len(each) if each else 0.0


def mean_of_objects(value, counted):
    """value(room, view, item) averaged over the counted views of each object, then objects."""
    objects = []
    for room in range(len(counted)):
        for item in range(len(counted[room][0])):
            views = [view for view in range(len(counted[room])) if counted[room][view][item]]
            if views:
                objects.append(sum(value(room, view, item) for view in views) / len(views))
    return sum(objects) / len(objects) if objects else 0.0


def completeness_loss(logits, counts):
    each = []
    for room, count in enumerate(counts):
        for position, logit in enumerate(logits[room]):
            p = 1 / (1 + math.exp(-logit))
            each.append(-math.log(p if position < count else 1 - p))
    return sum(each) / len(each)


def frustum_angle(center, world_to_camera, intrinsics, middle_px):
    """1 - cos of the angle between the rays to a 3D point and through a pixel, camera frame."""
    point = [
        sum(world_to_camera[row][k] * center[k] for k in range(3)) + world_to_camera[row][3]
        for row in range(3)
    ]
    ray = [
        (middle_px[0] - intrinsics[0][2]) / intrinsics[0][0],
        (middle_px[1] - intrinsics[1][2]) / intrinsics[1][1],
        1.0,
    ]
    dot = sum(a * b for a, b in zip(point, ray, strict=True))
    return 1 - dot / math.hypot(*point) / math.hypot(*ray)


def mask_cross_entropy(rendered, observed):
    """Mean over the pixels of two nested lists: -log of what is said of what is seen."""
    each = [
        -math.log(p if o else 1 - p)
        for row, other in zip(rendered, observed, strict=True)
        for p, o in zip(row, other, strict=True)
    ]
    return sum(each) / len(each)


def iou(rendered, observed):
    pairs = [
        (p, o)
        for row, other in zip(rendered, observed, strict=True)
        for p, o in zip(row, other, strict=True)
    ]
    both = sum(p * o for p, o in pairs)
    either = sum(p + o - p * o for p, o in pairs)
    return both / either if either else 0.0
