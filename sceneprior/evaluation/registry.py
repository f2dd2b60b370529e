"""Every metric, in the order of tables.

To add one, write a file in metrics/, list it here, and define it in docs/evaluation.md.
"""

from pathlib import Path
from typing import Any

from sceneprior.evaluation.alexnet import ALEXNET
from sceneprior.evaluation.metric import Metric
from sceneprior.evaluation.metrics import (
    bounds,
    classifier,
    clearance,
    collisions,
    contents,
    decoded_rooms,
    floor,
    frechet,
    kernel_distance,
    layout_classifier,
    navigation,
    novelty,
    overlaps,
    precision_recall,
    relations,
    stability,
    support,
    voxel_loss,
)
from sceneprior.evaluation.metrics.contents import TYPE_CLASSES
from sceneprior.evaluation.networks import file_digest

_MODULES = (
    frechet, kernel_distance, precision_recall, classifier, layout_classifier, relations, contents,
    overlaps, floor, novelty,
)  # fmt: skip
_NETWORKS = ("inception", "alexnet", "effnet_lite0", None)

METRICS: tuple[Metric, ...] = tuple(
    sorted(
        (metric for module in _MODULES for metric in module.METRICS),
        key=lambda metric: _NETWORKS.index(metric.network),
    )
)
"""Metrics of sets of rooms, sorted by network; metrics that read no pictures come last."""
DECODED: tuple[Metric, ...] = decoded_rooms.METRICS
"""Metrics of decoded training rooms against their ground truth."""
USE: tuple[Metric, ...] = tuple(
    metric
    for module in (collisions, bounds, support, navigation, clearance, voxel_loss, stability)
    for metric in module.METRICS
)
"""Metrics of use; their functions compute the `Counts` of one scene."""


def definitions(names: str, alexnet: Path | None) -> dict[str, Any]:
    """The protocol entries of all metrics, whether or not they could be computed."""
    stated: dict[str, Any] = {} if alexnet is None else {"sca": {**ALEXNET, **file_digest(alexnet)}}
    for metric in METRICS:
        stated |= metric.protocol
    return stated | {
        "independent": "objects of training rooms put together at random (independent_rooms), as "
        "many rooms as real training rooms; drawn as boxes, _meshes: with the real meshes",
        "type_share": list(TYPE_CLASSES.get(names, ())),
    }


def use_definitions() -> dict[str, str]:
    """The protocol entries of the metrics of use."""
    return {
        "surfaces": "meshes of the scenes; boxes of objects without a mesh",
        "support": "expected by class (support_of), floor at height 0",
        "stability": f"{stability.SECONDS:g} s of MuJoCo in the rooms as they are, without walls; "
        f"moved at most {stability.MOVED_M} m, turned at most {stability.TURNED_RAD} rad",
    }
