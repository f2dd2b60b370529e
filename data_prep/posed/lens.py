"""Undoes the distortion of lenses in images of ids: which source pixel each straight one shows."""

import math
from dataclasses import dataclass

import numpy as np

from sceneprior.errors import InputError

_STRAIGHT = 1e-6
"""Coefficients this small move no point by a thousandth of a pixel."""
_WIDEST_RAD = math.radians(65)
"""Half the field of view of a straightened picture, at most: beyond, pinholes stretch too much."""
_ROUNDS = 200
_GRID = 65
_RETURNS_PX = 0.1
"""A pixel of the rim that, bent straight and distorted again, comes back further than this from
where it began shows that the coefficients do not hold there."""


@dataclass(frozen=True)
class Lens:
    """Distortion as OpenCV's models have it, of coordinates on the plane at depth 1."""

    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 (OPENCV), or k1, k2, k3, k4 (OPENCV_FISHEYE)."""
    fisheye: bool = False

    @property
    def is_straight(self) -> bool:
        """Whether a picture is a pinhole's as it is; a fisheye's never is."""
        return not self.fisheye and max(map(abs, self.coefficients)) <= _STRAIGHT

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Where the lens puts rays: (n, 2) on the plane at depth 1, and so the result.

        Source:
            OpenCV's documentation of `projectPoints` and of `fisheye`.
        """
        x, y = points.T
        r2 = x * x + y * y
        if self.fisheye:
            k1, k2, k3, k4 = self.coefficients
            angle = np.arctan(np.sqrt(r2))
            a2 = angle**2
            bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
            return points * (bent / np.maximum(np.sqrt(r2), 1e-12))[:, None]
        k1, k2, p1, p2, k3 = self.coefficients
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=1,
        )

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """The inverse of `distort`; a fisheye's rays end at 65 degrees from the axis.

        A fixed point: what a guess, distorted, misses a point by is added to the guess. It comes
        closer as long as the lens does not fold the picture over; where it does, no result is
        right, which distorting it again shows.
        """
        guess = points.copy()  # of a fisheye: an angle, in the direction of the point
        for _ in range(_ROUNDS):
            rays = _rays(guess) if self.fisheye else guess
            guess = np.clip(guess + points - self.distort(rays), -1e3, 1e3)
        return _rays(guess) if self.fisheye else guess

    def __str__(self) -> str:
        kind = "OPENCV_FISHEYE" if self.fisheye else "OPENCV"
        return f"{kind} {', '.join(f'{value:g}' for value in self.coefficients)}"


def _rays(angles: np.ndarray) -> np.ndarray:
    size = np.maximum(np.linalg.norm(angles, axis=1, keepdims=True), 1e-12)
    return angles / size * np.tan(np.minimum(size, _WIDEST_RAD))


@dataclass(frozen=True)
class Straightened:
    """A pinhole view within what a lens saw, of as many pixels."""

    intrinsics: np.ndarray
    """(3, 3) float64, pixel centres at i + 0.5."""
    rows: np.ndarray
    """(height, width) int64: the row of the distorted picture that each pixel shows."""
    columns: np.ndarray
    cut_share: float
    """Share of the distorted picture's pixels that lie outside of the view."""


def straighten(lens: Lens, intrinsics: np.ndarray, size: tuple[int, int]) -> Straightened:
    """The pinhole view with the largest upright rectangle of which the lens saw every pixel,
    stretched to the picture's size. The nearest source pixel stands for each: ids are no colours.

    Args:
        intrinsics: (3, 3) of the distorted picture, pixel centres at i + 0.5.
        size: (height, width) of it.

    Raises:
        InputError: the lens bends so much that it cannot be undone as far as the picture's rim.
    """
    height, width = size
    K = np.asarray(intrinsics, dtype=np.float64)
    focal, center = np.diag(K)[:2], K[:2, 2]
    sides = np.array([width, height], dtype=np.float64)
    # From corner to corner of the picture.
    grid = np.stack(np.meshgrid(*(np.linspace(0, side, _GRID) for side in sides)), axis=-1)
    wanted = (grid.reshape(-1, 2) - center) / focal
    straight = lens.undistort(wanted)
    off = np.abs((lens.distort(straight) - wanted) * focal).max(axis=1)
    too_wide = np.linalg.norm(straight, axis=1) > 0.999 * math.tan(_WIDEST_RAD)
    if not ((off < _RETURNS_PX) | (too_wide & lens.fisheye)).all():  # NaN is not smaller, either
        raise InputError(
            f"its lens ({lens}) bends so much that the picture cannot be made straight as far as "
            "its rim; check the coefficients and the intrinsics"
        )
    x, y = np.moveaxis(straight.reshape(_GRID, _GRID, 2), 2, 0)
    low = np.array([x[:, 0].max(), y[0].max()])
    high = np.array([x[:, -1].min(), y[-1].min()])
    centres = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    while True:
        rays = low + centres.reshape(-1, 2) * (high - low) / sides
        places = lens.distort(rays) * focal + center
        if (np.abs(places / sides - 0.5) <= 0.5 + 0.5 / sides).all():
            break
        low, high = 0.99 * low, 0.99 * high  # a corner that no pixel of a wide fisheye sees
    nearest = np.clip(np.floor(places), 0, sides - 1).astype(np.int64)
    columns, rows = nearest.reshape(height, width, 2).transpose(2, 0, 1)
    scale = sides / (high - low)
    view = np.diag([*scale, 1.0])
    view[:2, 2] = -low * scale
    kept = ((straight >= low) & (straight <= high)).all(axis=1).mean()
    return Straightened(view, rows, columns, 1 - float(kept))
