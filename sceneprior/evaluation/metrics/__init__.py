"""Every metric, in the order of tables: those that the modules of this folder define.

To add one, write a file here with a function decorated by `metric`, define the metric in
docs/evaluation.md, and take its line of tests/golden/scores.csv.
"""

from importlib import import_module
from pkgutil import iter_modules

from sceneprior.evaluation.metric import DEFINED, MATCHED, USED

_MODULES = (
    "function", "picture_distances", "picture_classifiers", "layouts", "contents", "placement",
    "support", "navigation", "physics", "novelty",
)  # fmt: skip
"""Modules in the order in which tables show their metrics; other modules follow."""
_STARTS = list[int]()
for _name in dict.fromkeys((*_MODULES, *(found.name for found in iter_modules(__path__)))):
    _STARTS.append(len(DEFINED))
    import_module(f"{__name__}.{_name}")

_NETWORKS = ("inception", "alexnet", "effnet_lite0", None)
_SORTED = DEFINED[: _STARTS[1]]
"""What a person checks first comes first; then metrics of pictures by network, then the rest."""
_SORTED += sorted(DEFINED[_STARTS[1] :], key=lambda metric: _NETWORKS.index(metric.network))
METRICS = tuple(metric for metric in _SORTED if metric.sets not in (MATCHED, USED))
"""Metrics of sets of rooms: function, pictures, then the rest."""
DECODED = tuple(metric for metric in _SORTED if metric.sets == MATCHED)
"""Metrics of decoded training rooms against their ground truth."""
USE = tuple(metric for metric in _SORTED if metric.sets == USED)
"""Metrics of use; their functions compute the `Counts` of one scene."""
