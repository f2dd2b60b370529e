"""Baselines of reconstruction: the training room with the best masks, and a random training room.

Rooms are matched to images with one fixed cost, which does not depend on the weights of the run
that they are compared with.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence

from sceneprior.core.boxes import QUARTERS, box_corners, quarter_rotation
from sceneprior.core.cameras import Pinhole, boxes_of_points
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import reference_scene
from sceneprior.core.parallel import once
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.shards import Shard, iterate_rooms
from sceneprior.core.views import DecodedScenes, ObservedImage, as_views, rows_of
from sceneprior.paper.matching import assign, matching_cost
from sceneprior.render.appearance import scene_meshes
from sceneprior.render.offscreen import Renderer

BOX_WEIGHT, OCCLUSION_SLACK = 5.0, 0.15
"""Weight and occlusion slack of the cost by which a room's objects are matched to masks
(`matching_cost`). The slack is below 1 since boxes of whole objects extend behind occluders."""
SHORTLIST = 16
"""Number of rooms, the best by class and 2D box, whose masks are compared."""
MASK_COLUMNS = 80
"""Approximate width of the compared masks in pixels; it does not depend on a run's `mask_step`."""
CERTAIN_LOGIT = 30.0
"""Logit of a known class: its probability rounds to 1."""
ABSENT_M = 1e4
"""Coordinate of padding, far from every camera."""


class KnownAnswer(NamedTuple):
    """A known room as the reconstruction of an image."""

    scene: Scene
    objects: tuple[SceneObject | None, ...]
    """The object for each mask; None if the room has none left for it."""


class KnownRooms:
    """The training rooms in 3D, each in four turns, as reconstructions of images.

    Scenes hold boxes only, since a data set's meshes in four turns take many gigabytes; `furnished`
    reads the meshes of one room.
    """

    def __init__(self, shards: Path):
        self._folder = Path(shards)
        rooms = [
            (shard.path, reference_scene(shard, room_id, shards, meshes=False))
            for shard, room_id in iterate_rooms(shards, "train")
        ]
        self._paths = [path for path, _ in rooms]
        self.scenes = [
            turn_scene(scene, quarter) for _, scene in rooms for quarter in range(QUARTERS)
        ]
        """Each room turned by 0, 90, 180 and 270 degrees."""
        certain = CERTAIN_LOGIT * torch.eye(len(label_set(self.scenes[0].label_set)))
        self._logits = pad_sequence([certain[scene.class_indices] for scene in self.scenes], True)
        centers_m = [torch.from_numpy(scene.centers_m).float() for scene in self.scenes]
        self._centers_m = pad_sequence(centers_m, True, ABSENT_M)
        sizes_m = [torch.from_numpy(scene.sizes_m).float() for scene in self.scenes]
        self._sizes_m = pad_sequence(sizes_m, True)

    def __reduce__(self) -> tuple[Any, ...]:
        return once, (KnownRooms, self._folder)  # each worker reads the rooms itself

    def furnished(self, row: int) -> Scene:
        """`scenes[row]` with its meshes."""
        scene = self.scenes[row]
        with Shard(self._paths[row // QUARTERS]) as shard:
            home = reference_scene(shard, scene.name, self._folder)
        return turn_scene(home, row % QUARTERS)

    def drawn(self, image: ObservedImage, rng: np.random.Generator) -> KnownAnswer:
        """A random room other than the image's own, matched to its masks."""
        row = int(rng.choice(self._others(image)))
        return self._answer(row, self._matched(torch.tensor([row]), image)[0][0])

    def nearest(self, image: ObservedImage, renderer: Renderer) -> KnownAnswer:
        """The room other than the image's own with the highest mean IoU over the image's masks.

        Masks are rendered only for the `SHORTLIST` rooms that are best by classes and 2D boxes.
        """
        others = self._others(image)
        matched, costs = self._matched(others, image)
        best = costs.argsort()[:SHORTLIST].tolist()
        offered = [self._answer(int(others[at]), matched[at]) for at in best]
        return max(offered, key=lambda one: mask_overlap(one, image, renderer))

    def _answer(self, row: int, matched: Sequence[int]) -> KnownAnswer:
        scene = self.furnished(row)
        count = len(scene.objects)
        return KnownAnswer(scene, tuple(scene.objects[k] if k < count else None for k in matched))

    def _others(self, image: ObservedImage) -> Tensor:
        rows = [row for row, scene in enumerate(self.scenes) if scene.name != image.room_id]
        if not rows:
            raise InputError(
                f"The shards' only training room is {image.room_id} itself, so there is no other "
                "to compare its reconstruction with; take shards with more training rooms."
            )
        return torch.tensor(rows)

    def _matched(
        self, rows: Int[Tensor, " rooms"], image: ObservedImage
    ) -> tuple[list[list[int]], Float[Tensor, " rooms"]]:
        """For each room, the index of the object assigned to each mask (an index beyond the last
        object means none), and the mean cost of the assignment."""
        view = rows_of(as_views([image], 1), torch.zeros(len(rows), dtype=torch.int64))
        # As many padding objects as there are masks, so that every mask gets an index.
        masks = view.is_object.shape[1]
        logits, centers_m, sizes_m = (
            F.pad(values[rows], (0, 0, 0, masks), value=value)
            for values, value in (
                (self._logits, 0.0), (self._centers_m, ABSENT_M), (self._sizes_m, 0.0)
            )
        )  # fmt: skip
        decoded = DecodedScenes(logits, centers_m, sizes_m, torch.zeros(centers_m.shape[:2]))
        corners = box_corners(centers_m, sizes_m)
        boxes = boxes_of_points(corners, view.world_to_camera, view.intrinsics, view.image_size)
        costs = matching_cost(decoded, boxes, view, BOX_WEIGHT, OCCLUSION_SLACK)
        slots = [costs.shape[1]] * len(rows)  # the objects have no order, so all of them take part
        chosen = assign(costs, slots, view.is_object.sum(dim=-1).tolist())
        return chosen.tolist(), costs.gather(1, chosen.unsqueeze(1))[:, 0].mean(dim=1)


def turn_scene(scene: Scene, quarter: int) -> Scene:
    """The room turned by `quarter` quarter turns about the vertical axis, +z towards +x."""
    turn = quarter_rotation(quarter)
    floor = None if scene.floor_m is None else scene.floor_m @ turn[::2, ::2].T
    extra = {**scene.extra, "turned_degrees": 90 * (quarter % QUARTERS)}
    objects = tuple(turn_object(item, quarter) for item in scene.objects)
    return replace(scene, objects=objects, floor_m=floor, extra=extra)


def turn_object(item: SceneObject, quarter: int) -> SceneObject:
    """An object of a room that is turned by `quarter` quarter turns."""
    turn = quarter_rotation(quarter)
    center_m, size_m = turn @ np.array(item.center_m), np.abs(turn) @ np.array(item.size_m)
    mesh = item.mesh and Mesh(item.mesh.vertices_m @ turn.T, item.mesh.faces)
    return SceneObject(item.label, tuple(center_m.tolist()), tuple(size_m.tolist()), mesh)


def mask_overlap(answer: KnownAnswer, image: ObservedImage, renderer: Renderer) -> float:
    """Mean IoU of an image's masks with the rendered masks of the objects assigned to them; void
    pixels are left out."""
    scene = answer.scene
    observed = image.sampled_ids(max(1, round(image.instance_ids.shape[1] / MASK_COLUMNS)))
    height, width = observed.shape
    full = image.instance_ids.shape
    intrinsics = np.diag([width / full[1], height / full[0], 1]) @ image.intrinsics
    camera = Pinhole(np.asarray(image.world_to_camera, dtype=np.float64), intrinsics)
    drawn = renderer.instance_ids(scene_meshes(scene), camera, (height, width))
    number = {id(item): row + 1 for row, item in enumerate(scene.objects)}
    known = observed <= len(image.object_class)
    overlaps = []
    for mask, item in enumerate(answer.objects):
        # No pixel is -1, so a mask without an object has IoU 0.
        mine, seen = known & (drawn == number.get(id(item), -1)), observed == mask + 1
        overlaps.append((mine & seen).sum() / max((mine | seen).sum(), 1))
    return float(np.mean(overlaps))
