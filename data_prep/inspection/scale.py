"""Scale of rooms whose unit is not known, estimated from the sizes of objects of known classes.

The height and the longer side of an upright box around each object (readers/upright.py), and the
height of the cameras, are compared with the usual ones.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from data_prep.readers.upright import find_floor, fit_upright
from sceneprior.core.cameras import camera_centers
from sceneprior.core.observations import RoomViews
from sceneprior.furniture.catalog import Percentiles, real_size

OBJECTS_AT_LEAST = 3
"""Minimum number of objects of known size for an estimate."""
_MISFIT_SHARE = 0.02
"""Maximum mean distance between a box and its masks, relative to the image's longer side."""
_BOX_ERRORS, _BOX_BIAS = (0.25, 0.35), -0.1
"""Standard deviations and median of the errors of a box's height and longer side, as logarithms:
parts of objects are hidden."""
_CORRELATION = 1.2
"""Factor of an object's error, because its height and its length err together."""
_PIECES = 3
"""Minimum number of pieces that determine a room's floor: two lamps may hang at the same height."""
_CAMERA_M: Percentiles = ((0.8, 1.4, 1.9),)
"""Percentiles of the height above the floor at which cameras are held."""
_DEGREES, _ROUNDS = 3, 30
"""Degrees of freedom of Student's t distribution, which lets single objects be far off; and
iterations of its maximum likelihood estimate."""
_SIGMAS, _USERS = 3.0, 0.22
"""Standard errors, and logarithm of the difference of all furniture from the table's, that do not
explain a scale that is wrong."""


class LogSize(NamedTuple):
    """Logarithm of the size of an object, or of the cameras' height, relative to the usual one."""

    name: str
    """Class of the object; "" for the cameras."""
    log: float
    deviation: float
    """Expected standard deviation."""


class Scale(NamedTuple):
    """Estimate of the scale of rooms."""

    factor: float
    """Size of objects relative to that of their classes; 1 if the unit is right."""
    error: float
    """Standard error of the factor's logarithm."""
    objects: Counter[str]
    """Number of objects of each class."""

    def __str__(self) -> str:
        most = ", ".join(name for name, _ in self.objects.most_common(3))
        most += " and others" * (len(self.objects) > 3)
        sizes = f"the sizes of {self.objects.total()} objects ({most})"
        return f"{sizes} are about {self.factor:.2g} of what these classes have"

    @property
    def is_wrong(self) -> bool:
        """True if the unit must be another one."""
        return bool(abs(np.log(self.factor)) > _SIGMAS * self.error + _USERS)

    @property
    def bound(self) -> float:
        """Largest factor by which lengths may be too long or too short."""
        return float(np.exp(abs(np.log(self.factor)) + _SIGMAS * self.error + _USERS))


def floor_and_sizes(
    views: RoomViews, names: Sequence[str]
) -> tuple[float | None, tuple[LogSize, ...]]:
    """Height of the floor, None if few objects show it (`find_floor`), and the sizes of the cameras
    and of the objects whose classes in the label set `names` are known."""
    poses, image_size = views.world_to_camera.astype(np.float64), views.image_size
    eyes = camera_centers(poses)
    # Boxes are fitted in a room in which cameras stand about 2 m from their middle.
    unit = max(float(np.sqrt(eyes.var(axis=0).sum())) / 2, 1e-9)
    poses[:, :3, 3] /= unit
    corners, misfit_px = fit_upright(views, image_size, poses, views.intrinsics)
    corners *= unit
    level = find_floor(views, image_size, corners, misfit_px)
    floor_m = level[0] if level is not None and level[1] >= _PIECES else None
    found: list[LogSize] = []
    if floor_m is not None and (above := float(np.median(eyes[:, 1])) - floor_m) > 0:
        found.append(_compared("", [above], _CAMERA_M, (0.0,)))
    for index, box, misfit in zip(views.object_class, corners, misfit_px, strict=True):
        known = real_size(names[index])
        if known is not None and misfit < _MISFIT_SHARE * max(image_size):
            z, y, x = np.linalg.norm(box[[1, 2, 4]] - box[0], axis=1).tolist()
            width, height, depth = known
            longer = max(width, depth, key=lambda percentiles: percentiles[1])
            sizes_m = np.exp(-_BOX_BIAS) * np.array([y, max(x, z)])
            found.append(_compared(names[index], sizes_m, (height, longer), _BOX_ERRORS))
    return floor_m, tuple(found)


def _compared(
    name: str, sizes_m: Sequence[float] | np.ndarray, known: Percentiles, errors: Sequence[float]
) -> LogSize:
    """Mean of the logarithms of sizes relative to the medians, weighted by their variances."""
    p10, p50, p90 = np.array(known).T
    weights = 1 / ((np.log(p90 / p10) / 2.563) ** 2 + np.square(errors))
    mean = (weights * np.log(sizes_m / p50)).sum() / weights.sum()
    return LogSize(name, float(mean), float(_CORRELATION / np.sqrt(weights.sum())))


def estimate_scale(sizes: Sequence[LogSize]) -> Scale | None:
    """Maximum of the likelihood of the scale; None for fewer than `OBJECTS_AT_LEAST` objects. The
    observed deviations may raise the standard error, because rooms may differ in scale."""
    names = Counter(size.name for size in sizes if size.name)
    if names.total() < OBJECTS_AT_LEAST:
        return None
    logs, deviations = np.array([size[1:] for size in sizes]).T
    mean = np.median(logs)
    for _ in range(_ROUNDS):
        weights = (_DEGREES + 1) / (_DEGREES + ((logs - mean) / deviations) ** 2) / deviations**2
        mean = (weights * logs).sum() / weights.sum()
    observed = (weights**2 * (logs - mean) ** 2).sum() / weights.sum() ** 2
    error = np.sqrt(max(observed, 1 / weights.sum()))
    return Scale(float(np.exp(mean)), float(error), names)
