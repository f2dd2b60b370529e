"""Evaluate a run, or a folder of the user's scenes, by shards with or without 3D ground truth."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sceneprior.apps.api import load
from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.apps.retrieval.retrieve import retrieve_all
from sceneprior.core.classes import label_set
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import known_in_3d, reference_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shards import iterate_rooms, list_shards
from sceneprior.evaluation.metric import (
    METHOD,
    Comparison,
    Estimate,
    RoomSet,
    emptiness,
    resample_counts,
)
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.contents import (
    common_label_set,
    reconstruction_scores,
    without_void,
)
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis, result_of, seeded_rows
from sceneprior.evaluation.use import UseOptions, evaluate_use
from sceneprior.paper.config import PaperConfig
from sceneprior.paper.fit_image import decode_images, view_loss
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import decode_training_rooms, marked
from sceneprior.render.scene_files import load_scene_folder
from sceneprior.training.method import Trained

VIEWS = 4
"""Number of views per training room in which decoded masks are compared."""
_BATCH = 8
_OF_COUNTS, _OF_BOXES = ("mean_objects", "type_share", "category_kl"), ("overlap_volume_m3",)
_NOTE = (
    "The rooms of these shards are known from views alone: objects are counted as they appear in "
    "the views, and metrics that need 3D ground truth are left out."
)


def evaluate_run(
    run: Path | str,
    count: int,
    options: EvalOptions,
    shards: Path | None = None,
    distribution: str | None = None,
    use: UseOptions | None = None,
    asked: dict[str, Any] | None = None,
    models: Path | None = None,
) -> dict[str, Any]:
    """Score generated rooms against test rooms (`scores_of`).

    The options' seed also draws the latents; `shards` and `distribution` default to the run's.

    Args:
        use: Also compute metrics of use; without shards, compute only these.
        asked: Request for the rooms, as arguments of `Prior.sample`; only with `use`.
        models: CAD models that replace all objects of the rooms (apps/retrieval). Decoded training
            rooms, which would keep their own meshes, are left out then.
    """
    prior = load(run)
    trained, own = prior.trained, Path(prior.trained.config.data.shards)
    if shards is None and own.is_dir():
        shards = own
    elif shards is None and use is None:
        raise InputError(
            f"{run} was trained on shards '{own}', which do not exist; name the shards to compare "
            "with: --shards."
        )
    sample = partial(prior.sample, count, options.seed, distribution, **(asked or {}))
    if models is None:
        scores = scores_of(sample, shards, options, use, trained)
    else:
        bank = open_models(models, prior.label_set)
        scores = scores_of(lambda: [*retrieve_all(sample(), bank)], shards, options, use)
        scores["protocol"]["models"] = models.resolve().name
    latents = "its own"
    if isinstance(trained, TrainedPrior):
        latents = marked(distribution or trained.distribution)
    scores["protocol"] |= {"run": Path(run).name, "stage": trained.stage, "latents": latents}
    if asked:
        # Given objects are told by their values.
        scores["protocol"]["request"] = json.loads(json.dumps(asked, default=repr))
    return scores


def evaluate_folder(
    folder: Path,
    count: int | None,
    options: EvalOptions,
    shards: Path | None,
    use: UseOptions | None = None,
) -> dict[str, Any]:
    """Score `count` of the user's scenes (None: all), of any method, against test rooms; with
    `use`, metrics of use are added and `shards` are optional."""
    scenes = load_scene_folder(folder)
    if count is not None and count > len(scenes):
        raise InputError(
            f"{count} scenes are to be evaluated, but {folder} holds {len(scenes)}; leave out -n "
            "to take all of them, or make more."
        )
    rows = seeded_rows(len(scenes), count or len(scenes), options.seed)
    scores = scores_of(lambda: [scenes[row] for row in rows], shards, options, use)
    scores["protocol"] |= {"scenes": folder.resolve().name, "n_scenes_available": len(scenes)}
    return scores


def scores_of(
    generate: Callable[[], list[Scene]],
    shards: Path | None,
    options: EvalOptions,
    use: UseOptions | None,
    trained: Trained | None = None,
) -> dict[str, Any]:
    """Scores of rooms against the test rooms of shards, and their metrics of use.

    If a run keeps the latents of its training rooms, these rooms are decoded and scored as well:
    against their 3D ground truth or, if the shards have none, against the observed masks. This
    comes first, because it refuses shards that are not the run's.
    """
    if shards is not None:
        list_shards(shards, options.split)  # raises if the split has no rooms
    in_3d = shards is not None and known_in_3d(shards, options.split)
    keeping = trained if isinstance(trained, TrainedPrior) and trained.remembers_rooms else None
    scores: dict[str, Any] | None = None
    if shards is None or (use is not None and use.alone):
        generated = generate()
    elif in_3d:
        pairs = [] if keeping is None else decoded_and_true(keeping, shards)
        generated = generate()
        scores = evaluate_synthesis(generated, shards, options, [decoded for decoded, _ in pairs])
        if pairs:
            scores |= reconstruction_scores(pairs)
    else:
        masks = {} if keeping is None else mask_scores(keeping, shards)
        generated = generate()
        scores = evaluate_from_views(generated, shards, options) | masks
    if use is not None:
        scores = evaluate_use(generated, options, use, shards if in_3d else None, scores)
    assert scores is not None  # without `use`, there are shards
    return scores


# -- Training rooms, decoded -----------------------------------------------------------------------


def decoded_and_true(
    trained: Trained, shards: Path, meshes: bool = False
) -> list[tuple[Scene, Scene]]:
    """Pairs of each decoded training room and its 3D ground truth, which training does not use.

    The truth holds only tracked objects, since other objects appear in no view. Rotated copies of
    rooms are left out. `meshes` loads the true meshes, which pictures need and scores of boxes do
    not.
    """
    real = reference_scenes(shards, "train", tracked_only=True, meshes=meshes)
    truth = {scene.name: scene for scene in real}
    decoded = {scene.name: scene for scene in decode_training_rooms(trained)}
    missing = sorted(set(decoded) - set(truth) - {name for name in decoded if "@" in name})
    if missing:
        raise InputError(
            f"{shards} does not hold training room {missing[0]} of this run "
            f"({len(missing)} are missing); give the shards it was trained on with --shards."
        )
    return [(decoded[name], truth[name]) for name in truth if name in decoded]


@torch.no_grad()
def mask_scores(trained: TrainedPrior, shards: Path) -> dict[str, float]:
    """Mean soft IoU of the masks of decoded training rooms with the observed masks, as in training.

    The key is `mask_iou_held_out` if `data.view_fraction` holds views of every room out of
    training; the IoU is then computed in such views. Otherwise it is computed in training views,
    and the key is `mask_iou_training_views`. Empty for runs that decode no meshes: those of methods
    other than `paper`, and those before the shape stage.
    """
    config = trained.config
    if not isinstance(config, PaperConfig) or trained.stage == "layout":
        return {}
    data = config.data
    training = ViewDataset(
        shards, "train", views_per_room=VIEWS, rotations=data.rotations, seed=config.seed,
        mask_step=data.mask_step, view_fraction=data.view_fraction,
    )  # fmt: skip
    rooms = training.for_validation()
    if set(rooms.room_ids) != set(trained.room_ids):
        raise InputError(
            f"{shards} does not hold the training rooms of this run; give the shards it was "
            "trained on with --shards."
        )
    total, pairs = 0.0, 0
    rows = range(0, len(rooms), rooms.rotations)
    for start in range(0, len(rows), _BATCH):
        views = rooms.__getitems__([(row, 0) for row in rows[start : start + _BATCH]])
        points = trained.prior.latent_space(trained.logits[views.room_index])
        found = view_loss(trained, decode_images(trained, points, views), views)
        seen = views.visible.sum(dim=(1, 2))
        total, pairs = total + float((found.mask_iou * seen).sum()), pairs + int(seen.sum())
    key = "mask_iou_training_views" if rooms is training else "mask_iou_held_out"
    return {key: total / pairs} if pairs else {}


# -- Rooms without 3D ground truth, such as posed captures -----------------------------------------


def evaluate_from_views(
    generated: Sequence[Scene], shards: Path, options: EvalOptions
) -> dict[str, Any]:
    """Compute the metrics that need no 3D ground truth, in the format of `evaluate_synthesis`.

    The result holds the generated rooms' scores by key of `METRICS`, the real training rooms'
    scores under `train_rooms`, and the test rooms' scores under `<key>_test`.
    """
    generated = [without_void(scene) for scene in generated]
    names = common_label_set(generated)
    scenes = {
        "generated": generated, "train_rooms": _observed(shards, "train", names),
        "test": _observed(shards, options.split, names),
    }  # fmt: skip
    sets = {
        name: RoomSet(rooms, {}, resample_counts(len(rooms), options.resamples, (options.seed, k)))
        for k, (name, rooms) in enumerate(scenes.items())
    }
    # These metrics read scenes alone, and those of counts only the classes of objects.
    others = Comparison(sets["test"], [], [], [], options.seed, None, np.zeros((0, 0), bool), 0.0)
    columns: dict[str, dict[str, Estimate]] = {}
    for name, rooms in sets.items():
        keys = [*_OF_COUNTS, *_OF_BOXES * (name == "generated")]
        found = {
            metric.key: metric.function(rooms, others)
            for metric in METRICS
            if metric.key in keys and name in metric.sets
        }
        columns[name] = {key: each for key, each in found.items() if each.value is not None}
    measured = columns["generated"]
    return result_of(columns) | {
        "note": " ".join(filter(None, (emptiness(generated), _NOTE))),
        "protocol": {
            "label_set": names,
            "shards": Path(shards).resolve().name,
            "split": options.split,
            **{f"n_{name}": len(rooms) for name, rooms in scenes.items()},
            "seed": options.seed,
            "resamples": options.resamples,
            "intervals": METHOD,
            "left_out": {m.key: "rooms in 3D" for m in METRICS if m.key not in measured},
        },
    }


def _observed(shards: Path, split: str, names: str) -> list[Scene]:
    """Rooms of the tracked objects of each room, which have classes but no boxes."""
    scenes = []
    for shard, room_id in iterate_rooms(shards, split):
        if shard.label_set != names:
            raise InputError(
                f"Scores compare scenes of one label set, but the scenes have '{names}' and "
                f"{shards} has '{shard.label_set}'."
            )
        labels = [label_set(names)[index] for index in shard.read_room(room_id).object_class]
        objects = [SceneObject(label, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for label in labels]
        scenes.append(without_void(Scene(room_id, names, tuple(objects))))
    return scenes
