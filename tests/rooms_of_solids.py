"""Furniture that is a box, for tests of rooms in simulators."""

import numpy as np

from sceneprior.core.scene import SceneObject, Solid


def solid_box(label: str, center_m, size_m) -> SceneObject:
    """An object that is a box, and has it as its solid."""
    center, half = np.array(center_m, dtype=float), np.array(size_m, dtype=float) / 2
    solid = Solid("box", tuple((center - half).tolist()), tuple((center + half).tolist()))
    size = tuple((2 * half).tolist())
    return SceneObject(label, tuple(center.tolist()), size, solids=(solid,))
