"""Baselines of reconstruction: images in, the training rooms in 3D that fit them best out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sceneprior.classes import label_set
from sceneprior.config import LossConfig
from sceneprior.errors import InputError
from sceneprior.evaluation.reference import reference_scene
from sceneprior.evaluation.topdown import scene_meshes
from sceneprior.geometry.boxes import box_corners
from sceneprior.geometry.cameras import boxes_of_points
from sceneprior.losses.matching import match_objects, matching_cost
from sceneprior.offscreen import Pinhole, Renderer
from sceneprior.reconstruction.fit import rows_of
from sceneprior.reconstruction.observed import ObservedImage, as_views
from sceneprior.scene import Mesh, Scene, SceneObject
from sceneprior.shards import Shard, iterate_rooms, thinned
from sceneprior.views import DecodedScenes

SHORTLIST = 16
"""Rooms, best by 2D boxes, whose masks are then compared."""
CERTAIN_LOGIT = 30.0
"""Of a class that is known: its probability rounds to 1."""
ABSENT_M = 1e4
"""Where padding stands: no camera sees it."""
TURNS = 4


@dataclass(frozen=True)
class KnownRooms:
    """Rooms in 3D, each in four turns, as what a prior decodes.

    They are boxes: a data set's meshes in four turns are many gigabytes. `furnished` reads those of
    a room that is wanted.
    """

    folder: Path
    paths: tuple[Path, ...]
    """The shard of each room, before turns."""
    scenes: tuple[Scene, ...]
    decoded: DecodedScenes

    def furnished(self, row: int) -> Scene:
        """`scenes[row]` with its meshes.

        Raises:
            ShardError: a model's file is missing or damaged.
        """
        scene = self.scenes[row]
        with Shard(self.paths[row // TURNS]) as shard:
            home = reference_scene(shard, scene.name, self.folder)
        return turn_scene(home, row % TURNS)


@dataclass(frozen=True)
class KnownAnswer:
    """A known room as the answer to an image."""

    scene: Scene
    objects: tuple[SceneObject | None, ...]
    """One a mask; None where the room has nothing left for it."""


def known_rooms(shards: Path, split: str = "train") -> KnownRooms:
    """The rooms of a split, turned by 0, 90, 180 and 270 degrees.

    Raises:
        ShardError: the shards or their ground truth cannot be read.
    """
    rooms = [
        (shard.path, reference_scene(shard, room_id, shards, meshes=False))
        for shard, room_id in iterate_rooms(shards, split)
    ]
    turned = tuple(turn_scene(scene, quarter) for _, scene in rooms for quarter in range(TURNS))
    names = label_set(turned[0].label_set)
    counts = torch.tensor([len(scene.objects) for scene in turned])
    most = max(int(counts.max()), 1)
    centers = torch.full((len(turned), most, 3), ABSENT_M)
    sizes = torch.zeros(len(turned), most, 3)
    logits = torch.zeros(len(turned), most, len(names))
    for row, scene in enumerate(turned):
        count = len(scene.objects)
        centers[row, :count] = torch.from_numpy(scene.centers_m).float()
        sizes[row, :count] = torch.from_numpy(scene.sizes_m).float()
        logits[row, range(count), scene.class_indices] = CERTAIN_LOGIT
    decoded = DecodedScenes(logits, centers, sizes, torch.zeros(centers.shape[:2]))
    return KnownRooms(Path(shards), tuple(path for path, _ in rooms), turned, decoded)


def turn_scene(scene: Scene, quarter: int) -> Scene:
    """The room turned by so many quarters about the vertical axis: +z goes towards +x."""
    sine, cosine = ((0, 1), (1, 0), (0, -1), (-1, 0))[quarter % 4]
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], dtype=np.float64)

    def turned(item: SceneObject) -> SceneObject:
        x, y, z = (float(value) for value in turn @ np.array(item.center_m))
        width, height, depth = (float(value) for value in np.abs(turn) @ np.array(item.size_m))
        mesh = item.mesh and Mesh(item.mesh.vertices_m @ turn.T, item.mesh.faces)
        return SceneObject(item.label, (x, y, z), (width, height, depth), mesh)

    floor = None if scene.floor_m is None else scene.floor_m @ turn[::2, ::2].T
    return replace(
        scene,
        objects=tuple(turned(item) for item in scene.objects),
        floor_m=floor,
        extra={**scene.extra, "turned_degrees": 90 * (quarter % 4)},
    )


def random_answers(
    rooms: KnownRooms, images: Sequence[ObservedImage], weights: LossConfig, seed: int
) -> list[KnownAnswer]:
    """A room drawn at random for each image, not its own, matched to its masks."""
    rng = np.random.default_rng(seed)
    answers = []
    for image in images:
        row = int(rng.choice(_others(rooms, image)))
        slots, _ = _matched(rooms, torch.tensor([row]), image, weights)
        answers.append(_answer(rooms, row, slots[0]))
    return answers


def nearest_answers(
    rooms: KnownRooms,
    images: Sequence[ObservedImage],
    weights: LossConfig,
    renderer: Renderer,
) -> list[KnownAnswer]:
    """For each image the room, not its own, whose masks agree best: mean IoU over its masks.

    Only the `SHORTLIST` best by classes and 2D boxes are drawn.
    """
    answers = []
    for image in images:
        others = _others(rooms, image)
        _, costs = _matched(rooms, others, image, weights)
        best = others[costs.argsort()[:SHORTLIST]]
        slots, _ = _matched(rooms, best, image, weights)
        offered = [
            _answer(rooms, row, matched) for row, matched in zip(best.tolist(), slots, strict=True)
        ]
        overlaps = [mask_overlap(one.scene, one.objects, image, renderer) for one in offered]
        answers.append(offered[int(np.argmax(overlaps))])
    return answers


def _answer(rooms: KnownRooms, row: int, slots: Sequence[int]) -> KnownAnswer:
    scene = rooms.furnished(row)
    count = len(scene.objects)
    objects = tuple(scene.objects[slot] if slot < count else None for slot in slots)
    return KnownAnswer(scene, objects)


def _others(rooms: KnownRooms, image: ObservedImage) -> Tensor:
    rows = [row for row, scene in enumerate(rooms.scenes) if scene.name != image.room_id]
    if not rows:
        raise InputError(
            f"The shards' only training room is {image.room_id} itself, so there is no other to "
            "compare its reconstruction with; judge with more training rooms."
        )
    return torch.tensor(rows)


def _matched(
    rooms: KnownRooms, rows: Tensor, image: ObservedImage, weights: LossConfig
) -> tuple[list[list[int]], Tensor]:
    """Which object each room offers for each mask, past its last for none; and the mean cost."""
    view = rows_of(as_views([image], 1), torch.zeros(len(rows), dtype=torch.int64))
    # As many empty places beside a room's objects as there are masks, lest they run out.
    masks = view.is_object.shape[1]
    part = rooms.decoded
    decoded = DecodedScenes(
        *(
            torch.cat([tensor[rows], fill.expand(len(rows), masks, *tensor.shape[2:])], dim=1)
            for tensor, fill in (
                (part.class_logits, torch.zeros(part.class_logits.shape[-1])),
                (part.centers_m, torch.full((3,), ABSENT_M)),
                (part.sizes_m, torch.zeros(3)),
                (part.completeness_logits, torch.zeros(())),
            )
        )
    )
    boxes = boxes_of_points(
        box_corners(decoded.centers_m, decoded.sizes_m),
        view.world_to_camera, view.intrinsics, view.image_size,
    )  # fmt: skip
    settings = (weights.match_box, weights.occlusion_slack)
    chosen = match_objects(decoded, boxes, view, *settings, first_n=False).prediction
    costs = matching_cost(decoded, boxes, view, *settings).gather(1, chosen.unsqueeze(1))
    return chosen.tolist(), costs[:, 0].mean(dim=1)


def mask_overlap(
    scene: Scene,
    objects: Sequence[SceneObject | None],
    image: ObservedImage,
    renderer: Renderer,
    columns: int = 80,
) -> float:
    """Mean IoU of an image's masks with those of the objects that answer for them.

    Args:
        scene: Everything that stands in the room, and may hide the objects.
        objects: Some of the scene's, one a mask, in order; None where there is none.
        image: The masks.
        renderer: Draws the scene's.
        columns: About how many pixels wide they are compared.
    """
    step = max(1, round(image.instance_ids.shape[1] / columns))
    observed = image.instance_ids[thinned(step)]
    height, width = observed.shape
    full = image.instance_ids.shape
    lens = np.diag([width / full[1], height / full[0], 1]) @ image.intrinsics
    camera = Pinhole(np.asarray(image.world_to_camera, dtype=np.float64), lens)
    drawn = renderer.instance_ids(scene_meshes(scene), camera, (height, width))
    number = {id(item): row + 1 for row, item in enumerate(scene.objects)}
    overlaps = []
    for mask, item in enumerate(objects):
        mine = drawn == number[id(item)] if item is not None else np.zeros_like(drawn, dtype=bool)
        seen = observed == mask + 1
        overlaps.append((mine & seen).sum() / max((mine | seen).sum(), 1))
    return float(np.mean(overlaps))
