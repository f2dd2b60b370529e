"""Cameras of the renderers."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Pinhole:
    """A perspective camera: `point_camera = world_to_camera @ point_world`, OpenCV axes."""

    world_to_camera: np.ndarray
    """(4, 4), metres."""
    intrinsics: np.ndarray
    """(3, 3), pixels; without skew."""


@dataclass(frozen=True)
class Orthographic:
    """A parallel camera; the centre of the image lies on its optical axis."""

    world_to_camera: np.ndarray
    """(4, 4), metres. Only geometry in front of the camera is drawn."""
    metres_per_pixel: float


Camera = Pinhole | Orthographic
