"""Rooms whose objects know nothing of each other, from real ones: what a prior must beat."""

from collections.abc import Sequence

import numpy as np

from sceneprior.errors import InputError
from sceneprior.scene import Scene


def independent_rooms(
    real: Sequence[Scene], count: int, seed: int, with_meshes: bool = False
) -> list[Scene]:
    """Draw rooms from the marginals of real ones: how many objects, and each object by itself.

    The number of objects is that of a real room drawn at random; each object is one of all
    the objects of all the rooms, drawn at random with its class and where it stands. Single objects
    are therefore perfectly real, and only what holds a room together is missing.

    Args:
        real: Rooms to draw from, usually the training rooms.
        count: How many rooms.
        seed: Same seed, same rooms.
        with_meshes: Keep the real meshes, which makes it harder to beat; else objects are boxes.

    Raises:
        InputError: no real room holds an object.
    """
    pool = [item for scene in real for item in scene.objects]
    if not pool:
        raise InputError(
            "Independent rooms are drawn from the objects of real rooms, but none of the "
            f"{len(real)} rooms given holds any; give the training rooms of prepared shards."
        )
    generator = np.random.default_rng(seed)
    sizes = generator.choice([len(scene.objects) for scene in real], size=count)
    rooms = [
        Scene(
            f"independent_{index:04d}",
            real[0].label_set,
            tuple(pool[pick] for pick in generator.integers(len(pool), size=size)),
        )
        for index, size in enumerate(sizes)
    ]
    return rooms if with_meshes else [room.without_meshes() for room in rooms]
