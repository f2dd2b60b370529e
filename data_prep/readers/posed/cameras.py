"""Cameras of posed pictures: the keys of transforms.json, and lenses, whose images of ids are
undistorted by nearest-neighbour sampling."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sceneprior.core.checked import plain
from sceneprior.core.errors import InputError

_OPENCV = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

Number = Annotated[float, Field(gt=-1e12, lt=1e12)]
_STRAIGHT = 1e-6
"""Coefficients up to this size shift no point by as much as a thousandth of a pixel."""
_WIDEST_RAD = math.radians(65)
"""Maximum half field of view of an undistorted picture; wider pinhole views stretch too much."""
_ROUNDS = 200
_GRID = 65
_RETURNS_PX = 0.1
"""Maximum error after undistorting and redistorting a point; a larger one shows that the
coefficients are not valid there."""


@dataclass(frozen=True)
class Lens:
    """Lens distortion of coordinates on the plane at depth 1, by OpenCV's models."""

    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 (OPENCV), or k1, k2, k3, k4 (OPENCV_FISHEYE)."""
    fisheye: bool = False

    @property
    def is_straight(self) -> bool:
        """True for a pinhole without distortion, never for a fisheye."""
        return not self.fisheye and max(map(abs, self.coefficients)) <= _STRAIGHT

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Distort points on the plane at depth 1: (n, 2) to (n, 2)."""
        import cv2

        rays = np.concatenate([points, np.ones((len(points), 1))], axis=1).reshape(-1, 1, 3)
        project = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        still, plane = np.zeros(3), np.eye(3)
        distorted, _ = project(rays, still, still, plane, np.array(self.coefficients))
        return np.asarray(distorted).reshape(-1, 2)

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Invert `distort`; a fisheye's rays are limited to 65 degrees from the axis.

        Fixed-point iteration: the residual after distorting the guess is added to the guess. It
        converges where the distortion is invertible; elsewhere the result is wrong, which
        distorting it again reveals.
        """
        guess = points.copy()  # for a fisheye: an angle, in the direction of the point
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


class Camera(BaseModel):
    """Camera keys of a frame, or of a file for all its frames."""

    model_config = ConfigDict(strict=True, frozen=True)

    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    w: Number | None = None
    h: Number | None = None
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    camera_model: Any = "PINHOLE"
    is_fisheye: Any = False

    @model_validator(mode="after")
    def _has_a_lens_that_is_read(self) -> "Camera":
        model = plain(str(self.camera_model)) if isinstance(self.camera_model, str) else "no text"
        if model.upper() not in (*_OPENCV, *_FISHEYE):
            raise ValueError(
                f"its camera_model is {model}; expected a pinhole, OPENCV or OPENCV_FISHEYE. "
                "Undistort pictures and masks, or model the camera again."
            )
        stray = {"p1": self.p1, "p2": self.p2} if self.fisheye else {"k4": self.k4}
        for key, value in stray.items():
            if value:
                kind = "OPENCV_FISHEYE" if self.fisheye else "OPENCV"
                raise ValueError(f"its {key} is {value:g}, which {kind} does not have.")
        return self

    @property
    def fisheye(self) -> bool:
        """True for OpenCV's fisheye model."""
        return bool(self.is_fisheye) or str(self.camera_model).upper() in _FISHEYE

    @property
    def lens(self) -> Lens:
        """Lens distortion."""
        if self.fisheye:
            return Lens((self.k1, self.k2, self.k3, self.k4), fisheye=True)
        return Lens((self.k1, self.k2, self.p1, self.p2, self.k3))


class Straightened(NamedTuple):
    """An undistorted pinhole view with the size of the distorted picture."""

    intrinsics: np.ndarray
    """(3, 3) float64, pixel centres at i + 0.5."""
    rows: np.ndarray
    """(height, width) int64: source row of each pixel in the distorted picture."""
    columns: np.ndarray
    """(height, width) int64: source column of each pixel."""
    cut_share: float
    """Share of the distorted picture that lies outside the view."""


def straighten(lens: Lens, intrinsics: np.ndarray, size: tuple[int, int]) -> Straightened:
    """Compute an undistorted view in which every pixel was visible through the lens.

    The view is an axis-aligned rectangle inside the undistorted picture, stretched to the
    picture's size. Each pixel takes the nearest source pixel, since ids cannot be interpolated.
    Intrinsics and size are those of the distorted picture, pixel centres at i + 0.5.
    """
    height, width = size
    K = np.asarray(intrinsics, dtype=np.float64)
    focal, center = np.diag(K)[:2], K[:2, 2]
    sides = np.array([width, height], dtype=np.float64)
    if not ((center > 0) & (center < sides)).all():
        x, y = center
        raise InputError(
            f"its principal point ({x:g}, {y:g}) lies outside the picture of {width} x {height} "
            "pixels; give w and h of the pictures that cx and cy belong to"
        )
    # A grid of points over the whole picture, its border included.
    grid = np.stack(np.meshgrid(*(np.linspace(0, side, _GRID) for side in sides)), axis=-1)
    wanted = (grid.reshape(-1, 2) - center) / focal
    straight = lens.undistort(wanted)
    off = np.abs((lens.distort(straight) - wanted) * focal).max(axis=1)
    too_wide = np.linalg.norm(straight, axis=1) > 0.999 * math.tan(_WIDEST_RAD)
    if not ((off < _RETURNS_PX) | (too_wide & lens.fisheye)).all():  # NaN fails, too
        raise InputError(
            f"its lens ({lens}) distorts so much that the picture cannot be undistorted up to its "
            "border; check the coefficients and the intrinsics"
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
        low, high = 0.99 * low, 0.99 * high  # a corner lies outside a wide fisheye's picture
    nearest = np.clip(np.floor(places), 0, sides - 1).astype(np.int64)
    columns, rows = nearest.reshape(height, width, 2).transpose(2, 0, 1)
    scale = sides / (high - low)
    view = np.diag([*scale, 1.0])
    view[:2, 2] = -low * scale
    kept = ((straight >= low) & (straight <= high)).all(axis=1).mean()
    return Straightened(view, rows, columns, 1 - float(kept))
