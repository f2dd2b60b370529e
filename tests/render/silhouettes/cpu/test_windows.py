"""Windows hold what is drawn and little more, in the layout that windows.py writes down."""

import numpy as np
import torch
from silhouette_scenes import seen_ahead

from sceneprior.core.geometry.cameras import project
from sceneprior.core.geometry.meshes import icosphere
from sceneprior.render.silhouettes.cpu.windows import windows_of
from sceneprior.render.silhouettes.reference import Settings
from sceneprior.render.silhouettes.render import NEAR_FACE_M


def projected(scene: dict) -> tuple[np.ndarray, np.ndarray]:
    seen = project(scene["vertices_m"], scene["world_to_camera"], scene["intrinsics"])
    seen = seen.flatten(0, 2)
    return seen[..., :2].contiguous().numpy(), seen[..., 2].contiguous().numpy()


def settings_of(size: tuple[int, int], blur_px2: float) -> Settings:
    return Settings(size, 0.5, blur_px2, NEAR_FACE_M, "", "")


def test_memory_grows_with_visible_pixels_not_with_objects_x_views_x_image():
    sphere, _ = icosphere(1)
    small = sphere * 0.2
    ahead = small + torch.tensor([0.0, 0, 4.0])
    unseen = [small + torch.tensor(at) for at in ([9.0, 0, 4], [0, -9, 4], [0, 0, -4])]
    size = (96, 128)
    one, many = (
        windows_of(
            *projected(seen_ahead(torch.stack(meshes), torch.zeros(0, 3).long(), size, 64.0)),
            np.ones(len(meshes), dtype=bool),
            settings_of(size, 2.0**2),
        )
        for meshes in ([ahead], [ahead, *unseen * 50])
    )
    assert many.start[-1] == one.start[-1]  # what nobody sees takes nothing
    # 64 * 0.4 / 4 = 6.4 px wide, and 2 px to either side; up to two strips more than needed.
    assert 10 * 16 <= one.start[-1] <= 12 * 24 < 96 * 128 / 40
