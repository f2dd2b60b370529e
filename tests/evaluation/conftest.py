"""A folder of toy shards with 3D ground truth."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from toy_rooms import write_shard

from sceneprior.core.classes import label_set
from sceneprior.core.observations import RoomGroundTruth, RoomViews

NAMES = label_set("front3d_bedroom")
PIECES = {"double_bed": (1.8, 0.6, 2.0), "wardrobe": (1.5, 2.1, 0.6), "desk": (1.2, 0.75, 0.6)}


@pytest.fixture(scope="session")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight training and five test bedrooms of boxes; the wardrobe is seen by no camera."""
    folder = tmp_path_factory.mktemp("shards")
    (folder / "models").mkdir()
    for name in PIECES:
        unit = trimesh.creation.box()
        unit.export(folder / "models" / f"{name}_v0.ply")
    rng = np.random.default_rng(0)
    for split, count in (("train", 8), ("test", 5)):
        rooms = [make_room(f"house/{split}_{index}", rng) for index in range(count)]
        write_shard(folder / split / "part_000.h5", "front3d_bedroom", rooms)
    return folder


@pytest.fixture(scope="session")
def toy_room() -> Callable[..., tuple[RoomViews, RoomGroundTruth]]:
    return make_room


def make_room(room_id: str, rng: np.random.Generator) -> tuple[RoomViews, RoomGroundTruth]:
    """Three named pieces and one void piece; desk and bed are tracked, in that order."""
    labels = ["desk", "double_bed", "wardrobe", "void"]
    tracked = 2
    sizes = np.array([PIECES.get(label, (0.4, 0.4, 0.4)) for label in labels])
    centers = np.column_stack(
        [np.array([-1.8, 0, 1.9, 0]), sizes[:, 1] / 2, rng.uniform(-1.5, 1.5, size=4)]
    )
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[:, :3, :3] *= sizes[:, None]  # a unit cube stretched to the piece's size
    matrices[:, :3, 3] = centers
    truth = RoomGroundTruth(
        object_class=np.array([NAMES.index(label) for label in labels], dtype=np.int16),
        centers_m=centers.astype(np.float32),
        sizes_m=sizes.astype(np.float32),
        yaw_rad=np.zeros(4, np.float32),
        model_ids=tuple(f"{label}_v0" if label in PIECES else "" for label in labels),
        model_to_room=matrices.astype(np.float32),
        floor_m=np.array([[-3, -2.5], [3, -2.5], [3, 2.5], [-3, 2.5]], np.float32),
        height_m=2.6,
    )
    ids = np.zeros((2, 60, 80), np.uint8)
    ids[:, 20:40, 10:30], ids[:, 30:50, 40:70] = 1, 2
    boxes = np.array([[10 / 80, 20 / 60, 30 / 80, 40 / 60], [40 / 80, 30 / 60, 70 / 80, 50 / 60]])
    views = RoomViews(
        room_id=room_id,
        object_class=truth.object_class[:tracked],
        world_to_camera=np.tile(np.eye(4, dtype=np.float32), (2, 1, 1)),
        intrinsics=np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)),
        boxes=np.tile(boxes.astype(np.float32), (2, 1, 1)),
        visible=np.ones((2, tracked), bool),
        mask_pixels=np.tile(np.array([400, 600], np.int32), (2, 1)),
        sides_clear=np.ones((2, tracked, 4), bool),
        instance_ids=ids,
        image_size=(60, 80),
    )
    return views, truth


@pytest.fixture
def two_sets(rng) -> tuple[np.ndarray, np.ndarray]:
    """Two sets of features."""
    turn = rng.normal(size=(12, 12))
    return rng.normal(size=(40, 12)) @ turn, rng.normal(size=(30, 12)) @ turn + 0.5
