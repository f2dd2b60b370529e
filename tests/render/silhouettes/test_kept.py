"""tests/golden/silhouettes.npz: what the renderer meant when it was written, kept to the digit."""

from functools import lru_cache

import numpy as np
import pytest
from references.make_silhouettes_oracle import COMPOSITING, FILE, MODES, draw, scene_arrays


@lru_cache
def kept() -> dict[str, np.ndarray]:
    with np.load(FILE) as archive:
        return dict(archive)


def test_the_file_holds_the_scripts_scene_and_nothing_else():
    for name, array in scene_arrays().items():
        # sin and cos may differ by the last digit between machines.
        np.testing.assert_allclose(kept()[name], array, rtol=1e-14, atol=1e-14)
    drawn = {f"{x}_{m}_{c}" for x in ("masks", "gradient") for m in MODES for c in COMPOSITING}
    drawn |= {f"{x}_{m}" for x in ("front", "depth_m") for m in MODES}
    assert set(kept()) == set(scene_arrays()) | drawn
    assert FILE.stat().st_size < 64 * 1024
    # It shows something: all objects in front somewhere, one around the camera in view 1.
    z = kept()["vertices_m"][0, 2] @ kept()["world_to_camera"][0, 1, 2, :3]
    z = z + kept()["world_to_camera"][0, 1, 2, 3]
    assert z.min() < 0 < z.max()
    assert np.unique(kept()["front_exact"]).tolist() == [-1, 0, 1, 2]


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("compositing", COMPOSITING)
@pytest.mark.parametrize("mode", MODES)
def test_both_backends_and_modes_draw_what_was_kept(mode, compositing, backend):
    arrays = {name: kept()[name] for name in scene_arrays()}
    drawn = draw(arrays, mode, compositing, backend)
    masks, grad = (kept()[f"{name}_{mode}_{compositing}"] for name in ("masks", "gradient"))
    assert masks.max() > 0.9 and np.abs(grad).max() > 1
    # float64 sums in another order; seen 2e-15 and 1e-14.
    np.testing.assert_allclose(drawn["masks"], masks, rtol=0, atol=1e-12)
    np.testing.assert_allclose(drawn["gradient"], grad, rtol=0, atol=1e-10 * np.abs(grad).max())
    np.testing.assert_array_equal(drawn["front"], kept()[f"front_{mode}"])
    np.testing.assert_allclose(drawn["depth_m"], kept()[f"depth_m_{mode}"], rtol=1e-12)
