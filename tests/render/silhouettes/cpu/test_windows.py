"""Windows hold what is drawn and little more, in the layout that windows.py writes down."""

import numpy as np
import pytest
import torch
from silhouette_scenes import MODES, random_scene, seen_ahead

from sceneprior.core.geometry.cameras import project
from sceneprior.core.geometry.meshes import icosphere
from sceneprior.render.silhouettes.cpu import faces, outline
from sceneprior.render.silhouettes.cpu.windows import LANES, windows_of
from sceneprior.render.silhouettes.reference import Settings
from sceneprior.render.silhouettes.render import NEAR_FACE_M, render_silhouettes


def projected(scene: dict) -> tuple[np.ndarray, np.ndarray]:
    seen = project(scene["vertices_m"], scene["world_to_camera"], scene["intrinsics"])
    seen = seen.flatten(0, 2)
    return seen[..., :2].contiguous().numpy(), seen[..., 2].contiguous().numpy()


def settings_of(size: tuple[int, int], blur_px2: float) -> Settings:
    return Settings(size, 0.5, blur_px2, NEAR_FACE_M, "", "")


def boxes_by_hand(pixels, depths, drawn, image_size, reach):
    """Pixels with their centre within reach of a mesh's box: (row0, row1, column0, column1)."""
    boxes = []
    for points, z, shown in zip(pixels, depths, drawn, strict=True):
        points = points[z > NEAR_FACE_M]
        rows = columns = np.zeros(0, dtype=int)
        if shown and len(points):
            (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
            rows, columns = np.arange(image_size[0]), np.arange(image_size[1])
            rows = rows[(rows + 0.5 >= top - reach) & (rows + 0.5 <= bottom + reach)]
            columns = columns[(columns + 0.5 >= left - reach) & (columns + 0.5 <= right + reach)]
        if len(rows) and len(columns):
            boxes.append((rows[0], rows[-1] + 1, columns[0], columns[-1] + 1))
        else:
            boxes.append((0, 0, 0, 0))
    return np.array(boxes)


@pytest.mark.parametrize("reach", [0.0, 2.7])
def test_windows_are_the_boxes_by_hand_in_strips_of_eight(reach):
    scene = random_scene(0, rooms=2, objects=6, views=8)
    pixels, depths = projected(scene)
    drawn = np.arange(len(pixels)) % 7 != 3
    windows = windows_of(pixels, depths, drawn, settings_of((24, 32), reach**2))
    boxes = boxes_by_hand(pixels, depths, drawn, (24, 32), reach)
    assert 0 < (boxes[:, 1] == 0).sum() < len(boxes)
    wanted = np.column_stack([boxes[:, :2], boxes[:, 2] // 8, -(-boxes[:, 3] // 8)])
    np.testing.assert_array_equal(windows.bounds, wanted)
    area = (wanted[:, 1] - wanted[:, 0]) * (wanted[:, 3] - wanted[:, 2]) * LANES
    np.testing.assert_array_equal(np.diff(windows.start), area)
    assert windows.start[0] == 0 and windows.start.dtype == np.int64


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


@pytest.mark.parametrize("engine", [faces, outline])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_pixel_is_where_the_layout_says(engine, dtype):
    scene = random_scene(17, views=2)
    scene["image_size"] = (21, 29)
    settings = settings_of((21, 29), 4.6)
    pixels, depths = (array.astype(dtype) for array in projected(scene))
    drawn = np.ones(len(pixels), dtype=bool)
    windows = windows_of(pixels, depths, drawn, settings)
    triangles = scene["faces"].numpy()
    odds, order, _ = engine.cover(pixels, depths, triangles, windows, settings)
    assert odds.shape == order.shape == (windows.start[-1],) and odds.dtype == order.dtype == dtype
    dense = np.zeros((len(pixels), 21, 29))
    for mesh, (row0, row1, strip0, strip1) in enumerate(windows.bounds):
        rows = row1 - row0
        for row in range(row0, row1):
            for column in range(strip0 * 8, min(strip1 * 8, 29)):
                place = windows.start[mesh] + ((column // 8 - strip0) * rows + row - row0) * 8
                dense[mesh, row, column] = 1 - 1 / odds[place + column % 8]
    mode = MODES[engine is outline]
    masks = render_silhouettes(
        **scene, sigma_px2=0.5, blur_ndc=4.6 / 10.5**2, mode=mode, compositing="alone"
    )
    assert masks.max() > 0.9
    wanted = masks.flatten(0, 2).numpy()
    np.testing.assert_allclose(dense, wanted, rtol=0, atol=3e-5 if dtype == np.float32 else 1e-12)
