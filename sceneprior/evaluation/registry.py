"""Every metric, in the order of tables; a new one is a file in metrics/ and its name here."""

from collections.abc import Sequence

from sceneprior.evaluation.metric import Metric
from sceneprior.evaluation.metrics import (
    classifier,
    contents,
    decoded_rooms,
    floor,
    frechet,
    kernel_distance,
    novelty,
    overlaps,
    precision_recall,
)

_MODULES = (
    frechet, kernel_distance, precision_recall, classifier, contents, overlaps, floor, novelty,
)  # fmt: skip
_NETWORKS = ("inception", "alexnet", "effnet_lite0", None)

METRICS: tuple[Metric, ...] = tuple(
    sorted(
        (metric for module in _MODULES for metric in module.METRICS),
        key=lambda metric: _NETWORKS.index(metric.network),
    )
)
"""Of sets of rooms; by network, those that read no pictures last."""
DECODED: tuple[Metric, ...] = decoded_rooms.METRICS
"""Of decoded training rooms."""

_BETTER = {"closer": "lower", "lower": "lower", "higher": "higher", "half": "0.5", "none": "–"}


def as_markdown() -> str:
    """The lists of docs/evaluation.md, which a test compares with this."""
    against = [metric for metric in METRICS if "test" not in metric.sets]
    alone = [metric for metric in METRICS if "test" in metric.sets]
    parts = (
        ("### Against test rooms", against),
        ("### Of a set by itself", alone),
        ("### Of decoded training rooms", DECODED),
    )
    return "\n\n".join(f"{heading}\n\n{_table(metrics)}" for heading, metrics in parts) + "\n"


def _table(metrics: Sequence[Metric]) -> str:
    lines = ["| key | unit | better | definition |", "| --- | --- | --- | --- |"]
    for metric in metrics:
        source = f" *{metric.source}.*" if metric.source else ""
        better = _BETTER[metric.direction]
        lines.append(f"| `{metric.key}` | {metric.unit} | {better} | {metric.definition}{source} |")
    return "\n".join(lines)
