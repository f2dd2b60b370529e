"""One toy room in every format: each reader makes the same views of it, those of the golden file.

`TAKE_READERS=1 pytest tests/data_prep/readers/test_conformance.py` writes the golden file anew.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from toy_formats import FORMATS, arrays_of, read

GOLDEN = Path(__file__).parents[2] / "golden" / "readers.npz"
IMAGES = ("instance_ids", "stuff")
PIXELS = 2e-3
"""Share of pixels that may differ: a triangle's edge through a pixel's centre, on another CPU."""
TOLERANCE = {"boxes": 0.02, "mask_pixels": 4.0}
"""Largest difference of arrays that follow such a pixel; of other numbers, 1e-4."""


def small(name: str, array: np.ndarray) -> np.ndarray:
    """What the golden file keeps: every second pixel of images, the ends of long tables."""
    if name in IMAGES:
        return array[:, ::2, ::2].astype(np.uint8)
    return (
        np.concatenate([array[:5], array[-5:]])
        if len(np.shape(array)) and len(array) > 60
        else array
    )


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(GOLDEN) as file:
        return dict(file)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The room of each format, read once."""
    rooms: dict = {}

    def of(name: str):
        if name not in rooms:
            rooms[name] = read(name, tmp_path_factory.mktemp("files") / "rooms")
        return rooms[name]

    return of


@pytest.mark.skipif("TAKE_READERS" not in os.environ, reason="writes the golden file")
def test_take(made):
    kept = {
        f"{name}/{key}": small(key, array)
        for name in FORMATS
        for key, array in arrays_of(made(name)).items()
    }
    np.savez_compressed(GOLDEN, **kept)


@pytest.mark.parametrize("name", FORMATS)
def test_shards_stay_as_they_are(made, golden, name):
    arrays = {key: small(key, array) for key, array in arrays_of(made(name)).items()}
    wanted = {key.partition("/")[2]: a for key, a in golden.items() if key.startswith(f"{name}/")}
    assert arrays.keys() == wanted.keys()
    for key, array in arrays.items():
        assert array.shape == wanted[key].shape, key
        if key in IMAGES:
            assert (array != wanted[key]).mean() < PIXELS, key
        elif array.dtype.kind == "f" or key in TOLERANCE:
            np.testing.assert_allclose(
                array, wanted[key], rtol=0, atol=TOLERANCE.get(key, 1e-4), err_msg=key
            )
        else:
            np.testing.assert_array_equal(array, wanted[key], key)
