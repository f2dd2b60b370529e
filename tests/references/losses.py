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
