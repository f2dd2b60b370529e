"""Collisions between meshes: SceneEval's COL, and PhyScene's Col_obj and Col_scene."""

from itertools import combinations

import numpy as np
from jaxtyping import Bool

from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import USED, Counts, metric
from sceneprior.evaluation.surfaces import (
    Triangles,
    area_centroid,
    bounds,
    edge_hits,
    inside,
    meeting_pairs,
    triangles_of,
)

SEPARATION_M = 0.005
"""Distance by which two touching objects are moved apart before they are tested again."""


def colliding(scene: Scene) -> Bool[np.ndarray, " objects"]:
    """True for objects whose surface intersects another object's: SceneEval's COL.

    Two objects collide if their triangles intersect or touch, and still do so after the second
    object is moved by 5 mm, from the mean of the contact points towards its own centroid. So
    objects that touch, or overlap by up to about 5 mm, do not collide; nor does an object that lies
    wholly inside another, because their surfaces do not intersect.

    Source:
        3dlg-hcvc/SceneEval, metrics/collision.py. SceneEval takes contact points from the library
        FCL; here they are the points where edges pass through triangles or, without such points,
        the centroids of the touching triangles.
    """
    surfaces = [triangles_of(item) for item in scene.objects]
    found = np.zeros(len(surfaces), dtype=bool)
    for first, second in _near_pairs(surfaces):
        if _collide(surfaces[first], surfaces[second]):
            found[[first, second]] = True
    return found


def _collide(a: Triangles, b: Triangles) -> bool:
    pairs = meeting_pairs(a, b)
    if not len(pairs):
        return False
    meeting = a[pairs[:, 0]], b[pairs[:, 1]]
    contacts = edge_hits(*meeting)
    if not len(contacts):
        contacts = np.concatenate(meeting).mean(axis=1)
    away = area_centroid(b) - contacts.mean(axis=0)
    length = np.linalg.norm(away)
    if length > 0:
        b = b + away / length * SEPARATION_M
    return _boxes_meet(a, b) and len(meeting_pairs(a, b)) > 0


def containing(scene: Scene) -> Bool[np.ndarray, " objects"]:
    """True for both objects of a pair if the earlier one contains a vertex of the later one:
    PhyScene's collision test.

    Only vertices of the later object of a pair are tested, as in the published code, so two boxes
    that cross without a corner inside each other are missed.

    Source:
        PhyScene/PhyScene, scripts/eval/calc_ckl.py, `overlap_type: mesh` (Yang et al., CVPR 2024).
        PhyScene tests against closed, remeshed models; here a point is inside if its winding number
        in the original mesh, counted along +y, is not 0.
    """
    surfaces = [triangles_of(item) for item in scene.objects]
    found = np.zeros(len(surfaces), dtype=bool)
    for first, second in _near_pairs(surfaces):
        if found[first] and found[second]:
            continue
        points = np.unique(surfaces[second].reshape(-1, 3), axis=0)
        low, high = bounds(surfaces[first])
        points = points[((points > low) & (points < high)).all(axis=1)]
        if inside(points, surfaces[first]).any():
            found[[first, second]] = True
    return found


def _near_pairs(surfaces: list[Triangles]) -> list[tuple[int, int]]:
    return [
        (first, second)
        for first, second in combinations(range(len(surfaces)), 2)
        if _boxes_meet(surfaces[first], surfaces[second])
    ]


def _boxes_meet(a: Triangles, b: Triangles) -> bool:
    (a_low, a_high), (b_low, b_high) = bounds(a), bounds(b)
    return bool((np.minimum(a_high, b_high) >= np.maximum(a_low, b_low)).all())


@metric(
    "sceneeval_col_objects", "COL: objects that collide (SceneEval)", "share", "lower", USED,
    protocol={"surfaces": "meshes of the scenes; boxes of objects without a mesh"},
)  # fmt: skip
@metric("sceneeval_col_scenes", "COL: rooms with a collision (SceneEval)", "share", "lower", USED)
def _sceneeval(scene: Scene) -> Counts:
    found = colliding(scene)
    return {
        "sceneeval_col_objects": (float(found.sum()), len(found)),
        "sceneeval_col_scenes": (float(found.any()), 1),
    }


@metric("physcene_col_objects", "Col_obj: objects that collide (PhyScene)", "share", "lower", USED)
@metric(
    "physcene_col_scenes", "Col_scene: rooms with a collision (PhyScene)", "share", "lower", USED
)
def _physcene(scene: Scene) -> Counts:
    found = containing(scene)
    return {
        "physcene_col_objects": (float(found.sum()), len(found)),
        "physcene_col_scenes": (float(found.any()), 1),
    }
