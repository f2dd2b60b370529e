"""A seed in, a small folder of view shards out: bedrooms of boxes, drawn by the z-buffer.

Every array says the same room: ids are rendered from the meshes of the ground truth, boxes are
measured on the ids. Masks are at least 5 pixels wide and high, as data_prep's are.
"""

import json
from pathlib import Path

import numpy as np
import trimesh

from sceneprior.core.cameras import Pinhole
from sceneprior.core.classes import label_set
from sceneprior.core.files import write_whole
from sceneprior.core.observations import RoomGroundTruth, RoomViews
from sceneprior.core.scene import Mesh
from sceneprior.core.shard_writing import shard_bytes
from sceneprior.render.offscreen import SoftwareRenderer

LABEL_SET = "front3d_bedroom"
IMAGE_SIZE = (72, 96)
VIEWS = 8
HALF_M = (2.2, 1.8)
"""Half the floor along x and z."""
SIZES_M = {
    "double_bed": (1.8, 0.6, 2.0),
    "nightstand": (0.5, 0.5, 0.4),
    "wardrobe": (1.4, 2.1, 0.6),
    "ceiling_lamp": (0.6, 0.4, 0.6),
    "desk": (1.1, 0.75, 0.55),
}


def write_shard(path: Path, label_set_name: str, rooms) -> None:
    write_whole(path, shard_bytes(path.name, label_set_name, rooms))


def write_toy_shards(folder: Path, train: int = 12, test: int = 4, seed: int = 0) -> None:
    """Write `train` and `test` splits of at most 6 rooms a shard, models/ and index.json."""
    rng = np.random.default_rng(seed)
    for split, count in (("train", train), ("test", test)):
        rooms = [make_toy_room(f"toy/{split}_{index:02d}", rng) for index in range(count)]
        for start in range(0, count, 6):
            path = folder / split / f"part_{start // 6:03d}.h5"
            write_shard(path, LABEL_SET, rooms[start : start + 6])
    (folder / "models").mkdir()
    for label in SIZES_M:
        trimesh.creation.box().export(folder / "models" / f"{label}_box.ply")
    index = {
        "format": "sceneprior-shards",
        "version": 1,
        "label_set": LABEL_SET,
        "room_type": "bedroom",
        "rooms": {"train": train, "test": test},
    }
    (folder / "index.json").write_text(json.dumps(index, indent=1) + "\n")


def make_toy_room(room_id: str, rng: np.random.Generator) -> tuple[RoomViews, RoomGroundTruth]:
    """A bed at the back wall, a wardrobe at the left one, a lamp, perhaps a nightstand and desk."""
    labels, sizes, centers = _furnish(rng)
    unit = trimesh.creation.box()
    meshes = [
        Mesh(np.asarray(unit.vertices) * size + center, np.asarray(unit.faces))
        for size, center in zip(sizes, centers, strict=True)
    ]
    poses = np.stack([_camera(angle, rng) for angle in np.arange(VIEWS) * 2 * np.pi / VIEWS])
    height, width = IMAGE_SIZE
    lens = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    images = SoftwareRenderer().instance_ids_of_views(
        meshes, [Pinhole(pose, lens) for pose in poses], IMAGE_SIZE
    )
    boxes, visible, pixels = measure(images, len(labels))
    tracked = np.flatnonzero(visible.any(axis=0))
    order = np.concatenate([tracked, np.setdiff1d(np.arange(len(labels)), tracked)])
    number = np.zeros(len(labels) + 1, dtype=np.uint8)
    number[tracked + 1] = np.arange(1, len(tracked) + 1)
    names = label_set(LABEL_SET)
    classes = np.array([names.index(label) for label in labels], dtype=np.int16)
    views = RoomViews(
        room_id=room_id,
        object_class=classes[tracked],
        world_to_camera=poses.astype(np.float32),
        intrinsics=np.tile(lens.astype(np.float32), (VIEWS, 1, 1)),
        boxes=boxes[:, tracked],
        visible=visible[:, tracked],
        mask_pixels=pixels[:, tracked],
        sides_clear=np.repeat(visible[:, tracked, None], 4, axis=2),
        instance_ids=number[images],
        image_size=IMAGE_SIZE,
    )
    matrices = np.tile(np.eye(4, dtype=np.float32), (len(labels), 1, 1))
    matrices[:, (0, 1, 2), (0, 1, 2)] = sizes
    matrices[:, :3, 3] = centers
    x, z = HALF_M
    truth = RoomGroundTruth(
        object_class=classes[order],
        centers_m=centers[order].astype(np.float32),
        sizes_m=sizes[order].astype(np.float32),
        yaw_rad=np.zeros(len(labels), np.float32),
        model_ids=tuple(f"{labels[k]}_box" for k in order),
        model_to_room=matrices[order],
        floor_m=np.array([[-x, -z], [x, -z], [x, z], [-x, z]], np.float32),
        height_m=2.6,
    )
    return views, truth


def measure(images: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes (T, n, 4) relative to the image, visible (T, n) and pixel counts of id images."""
    views, height, width = images.shape
    boxes = np.zeros((views, count, 4), np.float32)
    visible = np.zeros((views, count), bool)
    pixels = np.zeros((views, count), np.int32)
    for view in range(views):
        for k in range(count):
            rows, columns = np.nonzero(images[view] == k + 1)
            if len(rows) == 0 or min(np.ptp(rows), np.ptp(columns)) + 1 <= 4:
                continue
            visible[view, k] = True
            pixels[view, k] = len(rows)
            boxes[view, k] = (
                columns.min() / width,
                rows.min() / height,
                (columns.max() + 1) / width,
                (rows.max() + 1) / height,
            )
    return boxes, visible, pixels


def _furnish(rng: np.random.Generator) -> tuple[list[str], np.ndarray, np.ndarray]:
    x, z = HALF_M
    bed_x = rng.uniform(-0.3, 0.5)
    places = {
        "double_bed": (bed_x, -z + 1.0),
        "wardrobe": (-x + 0.7, z - 0.3 - rng.uniform(0, 0.2)),
        "ceiling_lamp": (0.0, 0.0),
    }
    if rng.random() < 0.7:
        places["nightstand"] = (bed_x + 1.2, -z + 0.2)
    if rng.random() < 0.5:
        places["desk"] = (x - 0.6, z - 0.4)
    labels = list(places)
    sizes = np.array([SIZES_M[label] for label in labels]) * rng.uniform(0.9, 1.1, (len(labels), 3))
    ground = np.array([places[label] for label in labels])
    y = sizes[:, 1] / 2
    y[labels.index("ceiling_lamp")] = 1.9
    return labels, sizes, np.column_stack([ground[:, 0], y, ground[:, 1]])


def _camera(angle: float, rng: np.random.Generator) -> np.ndarray:
    """On an ellipse near the walls, 1.5 m up, looking across the middle of the room."""
    x, z = HALF_M
    eye = np.array([0.8 * x * np.sin(angle), rng.uniform(1.4, 1.8), 0.8 * z * np.cos(angle)])
    target = np.array([rng.uniform(-0.4, 0.4), 1.2, rng.uniform(-0.4, 0.4)])
    return look_at(eye, target)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """World-to-camera matrix, OpenCV axes, the image upright (world y up)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ eye
    return matrix
