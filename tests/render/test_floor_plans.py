"""Floor plans: the whole room is in the picture, at a scale that can be read."""

import numpy as np
import pytest

from sceneprior.core.classes import label_set
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.render.appearance import FLOOR_COLOR, quiet_colors
from sceneprior.render.topdown import DOOR, LEGEND_PX, PLAN_PX, WALL, WINDOW, floor_plan

BEDROOM = "front3d_bedroom"
COLORS = dict(zip(label_set(BEDROOM), quiet_colors(label_set(BEDROOM)).tolist(), strict=True))


def box(label: str, center_m, size_m) -> SceneObject:
    return SceneObject(label, center_m, size_m)


def drawn(picture: np.ndarray, color) -> np.ndarray:
    """Columns and rows of pixels of a colour in the plan."""
    return np.argwhere((picture[:, :PLAN_PX] == color).all(axis=-1))[:, ::-1]


@pytest.mark.parametrize("away_m", [0.0, 5.0, 40.0])
def test_rooms_of_any_size_are_wholly_in_the_picture(away_m):
    bed = box("double_bed", (away_m, 0.3, 0.0), (2.0, 0.6, 1.6))
    lamp = box("ceiling_lamp", (-away_m, 12.0, 0.0), (1.0, 0.2, 1.0))
    picture = floor_plan(Scene("a", BEDROOM, (bed, lamp)))
    assert picture.shape == (PLAN_PX, PLAN_PX + LEGEND_PX, 3)
    for item in (bed, lamp):
        found = drawn(picture, COLORS[item.label])
        assert len(found) and found.min() > 10 and found.max() < PLAN_PX - 10


def test_floors_walls_and_openings_are_drawn():
    floor_m = np.array([[0, 0], [4, 0], [4, 2], [2, 2], [2, 4], [0, 4]], float)
    door = Opening("door", (4, 0.5), (4, 1.4), 0.0, 2.0)
    window = Opening("window", (0.5, 0), (1.5, 0), 0.9, 2.0)
    picture = floor_plan(Scene("a", BEDROOM, (), floor_m, openings=(door, window)))
    scale = PLAN_PX * 0.9 / 4
    area_m2 = len(drawn(picture, FLOOR_COLOR)) / scale**2
    assert area_m2 == pytest.approx(12, rel=0.03)
    assert len(drawn(picture, WALL)) > 1000
    for color, length_m, axis in ((DOOR, 0.9, 1), (WINDOW, 1.0, 0)):
        found = drawn(picture, color)
        assert np.ptp(found[:, axis]) == pytest.approx(length_m * scale, abs=4)
