"""Evaluate a prior in training: scores and a picture of the rooms that it generates."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sceneprior.classes import VOID, label_set
from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError, ShardError
from sceneprior.evaluation.metrics.contents import (
    TYPE_CLASSES,
    class_frequencies,
    frequency_kl,
    object_counts,
    type_share,
)
from sceneprior.evaluation.metrics.overlaps import overlap_pairs
from sceneprior.generation.decode import decode_latents, synthesize
from sceneprior.generation.sample import sample_latents, uses_sampler
from sceneprior.geometry.cameras import boxes_of_points
from sceneprior.geometry.meshes import place
from sceneprior.losses.matching import match_objects
from sceneprior.models.shape_decoder import ShapeDecoder
from sceneprior.offscreen import SoftwareRenderer
from sceneprior.pictures import contact_sheet
from sceneprior.scene import Scene
from sceneprior.shards import iterate_rooms, list_shards
from sceneprior.silhouettes.render import render_scene
from sceneprior.topdown import topdown, topdown_protocol
from sceneprior.training.method import PriorConfig, RunConfig, Trained, TrainedPrior
from sceneprior.training.monitor import EvaluationResult
from sceneprior.training.ours import PaperConfig
from sceneprior.views import SceneViews

PICTURED = 16
"""Generated rooms in the picture."""
COLUMNS = 4
TILE_PX = 160
REMEMBERED = 8
"""Training rooms whose masks are compared; their views are the first draw of epoch 0."""
VIEWS = 4


class SampleEvaluator:
    """Evaluate a prior in training; `SampleMonitor` calls it as `SamplesConfig` says.

    The scores, of `samples.count` rooms generated from always the same seed:

    - `category_kl`: from the frequencies of the compared rooms' classes to the generated ones'
    - `objects`, `objects_off`: mean number a room, and how far that is from the compared rooms',
      as a share of theirs; `empty_share`: rooms without any object
    - `overlaps`: intersecting pairs of boxes a room
    - `type_share`: rooms with the furniture that makes them what they are; not for ScanNet

    And, of runs that remember training rooms, which baselines need not:

    - `overlaps_decoded`: pairs of decoded training rooms, below which generated ones seldom get
    - `mask_iou`: of a few decoded training rooms, mean over the objects that their views see;
      hard masks of what is in front, in the layout stage of the undeformed template; not where
      shapes are occupancy grids, of which no masks are drawn

    Compared rooms count what cameras saw of them: ground truth in 3D is never read.

    Raises:
        InputError: `samples.metric` does not exist for the run's label set or stages.
    """

    def __init__(self, config: RunConfig):
        self.config = config = config.with_label_set()
        if config.samples.metric == "type_share" and config.label_set not in TYPE_CLASSES:
            raise InputError(
                f"samples.metric is type_share, but {config.label_set} mixes room types; choose "
                "category_kl, objects_off, overlaps or mask_iou."
            )
        if config.samples.metric == "mask_iou" and not config.remembers_rooms:
            raise InputError(
                f"samples.metric is mask_iou, but `method: {config.method}` remembers no rooms; "
                "choose category_kl, objects_off, overlaps or type_share."
            )
        if config.samples.metric == "mask_iou" and not has_meshes(config):
            raise InputError(
                "samples.metric is mask_iou, which compares masks of meshes, but model.shape is "
                "occupancy; choose category_kl, objects_off, overlaps or type_share."
            )

    def __call__(self, trained: Trained) -> EvaluationResult:
        settings = self.config.samples
        if not isinstance(trained, TrainedPrior) or uses_sampler(trained, None):
            generated = synthesize(trained, settings.count, settings.seed)
            return EvaluationResult(
                self._scores(generated), tile(generated[:PICTURED]), self._compared[0]
            )
        z = sample_latents(
            trained.prior.latent_space, trained.logits, settings.count, settings.seed,
            trained.distribution,
        )  # fmt: skip
        generated = _decode(trained, z, with_shape=False)
        scores = self._scores(generated)
        if trained.remembers_rooms:
            plain = [row for row, name in enumerate(trained.room_ids) if "@" not in name]
            remembered = trained.prior.latent_space(trained.logits[plain[: settings.count]])
            decoded = _decode(trained, remembered, with_shape=False)
            scores["overlaps_decoded"] = overlap_pairs(decoded)
            if trained.prior.faces is not None:
                scores["mask_iou"] = mask_iou_of_rooms(trained, self._views)
        pictured = _decode(trained, z[:PICTURED], with_shape=trained.stage != "layout")
        return EvaluationResult(scores, tile(pictured), self._compared[0])

    def _scores(self, generated: list[Scene]) -> dict[str, float]:
        _, frequencies, mean_objects = self._compared
        counts = object_counts(generated)
        scores = {
            "category_kl": frequency_kl(frequencies, class_frequencies(generated)),
            "objects": float(counts.mean()),
            "objects_off": float(abs(counts.mean() / mean_objects - 1)),
            "empty_share": float((counts == 0).mean()),
            "overlaps": overlap_pairs(generated),
        }
        share = type_share(generated)
        return scores if share is None else scores | {"type_share": share}

    @cached_property
    def _compared(self) -> tuple[str, Float[np.ndarray, " classes"], float]:
        folder, split = Path(self.config.data.shards), self.config.samples.against
        try:
            list_shards(folder, split)
        except ShardError:
            split = "train"
        counts = np.zeros(len(label_set(self.config.label_set)))
        rooms = 0
        for shard, room_id in iterate_rooms(folder, split):
            counts += np.bincount(shard.read_room(room_id).object_class, minlength=len(counts))
            rooms += 1
        counts[VOID] = 0
        total = max(counts.sum(), 1.0)
        # A plain number: it ends up in checkpoints, which hold no numpy.
        return split, counts / total, float(total / rooms)

    @cached_property
    def _views(self) -> SceneViews:
        data = self.config.data
        # The seed chose the share of the views, too.
        rooms = ViewDataset(
            Path(data.shards), "train", views_per_room=VIEWS, rotations=data.rotations,
            mask_step=data.mask_step, view_fraction=data.view_fraction, seed=self.config.seed,
            limit=REMEMBERED,
        )  # fmt: skip
        return rooms.__getitems__([(row, 0) for row in range(0, len(rooms), rooms.rotations)])


def has_meshes(config: RunConfig) -> bool:
    """Whether a run's shapes are meshes, of which masks are drawn."""
    return isinstance(config, PriorConfig) and config.model.shape.name == "mesh"


def _decode(trained: TrainedPrior, z: Tensor, with_shape: bool) -> list[Scene]:
    stage = "shape" if with_shape else "layout"
    names = [f"{row:04d}" for row in range(len(z))]
    return decode_latents(replace(trained, stage=stage), z, names)


@torch.no_grad()
def mask_iou_of_rooms(trained: TrainedPrior, views: SceneViews) -> float:
    """Mean IoU of hard masks of decoded training rooms with the observed ones.

    Args:
        trained: A prior of meshes; before the shape stage each box has the plain template in it.
        views: Of training rooms, with instance ids.
    """
    config, prior = trained.config, trained.prior
    assert isinstance(config, PaperConfig), "a run that remembers rooms has a view loss"
    weights = config.loss
    scenes = prior(trained.logits[views.room_index], with_shape=trained.stage != "layout")
    shape, vertices = prior.shape, scenes.vertices_m
    assert isinstance(shape, ShapeDecoder), "masks are drawn of meshes"
    if vertices is None:
        template = shape.template.expand(*scenes.centers_m.shape[:2], -1, -1)
        vertices = place(template, scenes.centers_m, scenes.sizes_m)
    boxes = boxes_of_points(vertices, views.world_to_camera, views.intrinsics, views.image_size)
    matches = match_objects(scenes, boxes, views, weights.match_box, weights.occlusion_slack)
    ids = views.observed_ids
    height, width = ids.shape[-2:]
    counts = views.is_object.sum(dim=-1, keepdim=True)
    front = render_scene(
        vertices, shape.faces, views.world_to_camera, views.intrinsics_at(height, width),
        (height, width), mode="fast", drawn=torch.arange(vertices.shape[1]) < counts,
    ).front  # fmt: skip
    room, view, item = (views.visible & matches.valid.unsqueeze(1)).nonzero(as_tuple=True)
    mine = front[room, view] == matches.prediction[room, item][:, None, None]
    seen = ids[room, view] == (item + 1)[:, None, None]
    both = (mine & seen).sum(dim=(1, 2))
    return float((both / (mine | seen).sum(dim=(1, 2)).clamp(min=1)).mean())


def tile(scenes: Sequence[Scene]) -> UInt8[np.ndarray, "height width 3"]:
    """Rooms from straight above in rows of four, coloured by class."""
    # Our own z-buffer: GL must not be opened in a process that trains on the GPU.
    renderer = SoftwareRenderer()
    protocol = replace(topdown_protocol(scenes[0].label_set), image_size=(TILE_PX, TILE_PX))
    tiles = [topdown(scene, renderer, protocol, outlines=True) for scene in scenes]
    return contact_sheet(tiles, COLUMNS)
