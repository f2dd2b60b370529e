"""Every metric, in the order of tables: those that the modules of this folder define.

To add one, write a file here with a function decorated by `metric`, define the metric in
docs/evaluation.md, and take its line of tests/golden/scores.csv.
"""

from importlib import import_module
from pkgutil import iter_modules

from sceneprior.evaluation.metric import DEFINED, MATCHED, USED

_MODULES = (
    "picture_distances", "picture_classifiers", "layouts", "function", "contents", "placement",
    "support", "navigation", "physics", "novelty",
)  # fmt: skip
"""Modules in the order in which tables show their metrics; other modules follow."""
for _name in dict.fromkeys((*_MODULES, *(found.name for found in iter_modules(__path__)))):
    import_module(f"{__name__}.{_name}")

_NETWORKS = ("inception", "alexnet", "effnet_lite0", None)
_SORTED = sorted(DEFINED, key=lambda metric: _NETWORKS.index(metric.network))
METRICS = tuple(metric for metric in _SORTED if metric.sets not in (MATCHED, USED))
"""Metrics of sets of rooms, sorted by network; metrics that read no pictures come last."""
DECODED = tuple(metric for metric in _SORTED if metric.sets == MATCHED)
"""Metrics of decoded training rooms against their ground truth."""
USE = tuple(metric for metric in _SORTED if metric.sets == USED)
"""Metrics of use; their functions compute the `Counts` of one scene."""
