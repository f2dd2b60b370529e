"""Reconstruct rooms from instance masks of single images: object by object, or by latents."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.generation.decode import scene_of
from sceneprior.geometry.cameras import boxes_of_points
from sceneprior.geometry.corners import box_corners
from sceneprior.reconstruction.fit import SCHEDULES, fit_latents, refuse_crowds, view_loss
from sceneprior.reconstruction.image import ObservedImage, as_views, rows_of
from sceneprior.reconstruction.objects import answer_images
from sceneprior.scene import Scene, SceneObject
from sceneprior.training.method import Trained, TrainedPrior, TrainedReconstructor
from sceneprior.views import SceneViews

BATCH = 128
"""Latents fitted at once: images times restarts."""
OBJECTS = "objects"
"""Answers object by object, ours; any other fit is of a latent, by a schedule."""
START_BATCH = 256
"""Training rooms decoded at once."""


@dataclass(frozen=True)
class FitOptions:
    """How images are reconstructed."""

    fit: str = OBJECTS
    """`objects` (objects.py), or a latent is fitted by one of `SCHEDULES`."""
    restarts: int = 1
    """Latents fitted to each image, from the training rooms nearest to it; the one with the lowest
    score is kept."""
    masks: bool = True
    """False fits latents to classes and 2D boxes alone, as where shapes are occupancy grids."""


@dataclass(frozen=True)
class Reconstruction:
    """What one image shows, in 3D."""

    image: ObservedImage
    scene: Scene
    """One object a mask, in the masks' order."""
    score: float
    """Compares answers to one image, less is better: `ObjectAnswer.energy`, or of a latent layout
    loss plus lambda_S * (1 - mean mask IoU), or see `_found_directly`."""
    mask_iou: float | None = None
    """Mean over the image's masks; None where masks are not compared as pixels."""
    steps: int | None = None
    """Of a latent's fit."""
    taken_for: dict[str, str] = field(default_factory=dict)
    """See `ObjectAnswer.taken_for`."""


def reconstruct(
    trained: Trained, images: Sequence[ObservedImage], options: FitOptions
) -> list[Reconstruction]:
    """Reconstruct images of the run's label set, many at once. Before the run's shape stage scenes
    are boxes. A run of a baseline that answers images directly does so.

    Raises:
        InputError: unknown options, a run that cannot answer images, another label set, or, where
            latents are fitted, more objects than the prior generates.
    """
    if options.fit not in (OBJECTS, *SCHEDULES):
        raise InputError(
            f"No fit is called '{options.fit}'; choose from {', '.join((OBJECTS, *SCHEDULES))}."
        )
    if options.restarts < 1:
        raise InputError(f"restarts is {options.restarts}; an image needs at least one.")
    if options.restarts > 1 and options.fit == OBJECTS:
        raise InputError("restarts are of latents; name a fit of those, paper or released.")
    direct = isinstance(trained, TrainedReconstructor)
    if direct and options.fit != OBJECTS:
        raise InputError(
            f"A run of `method: {trained.config.method}` has no latents to fit; leave out the fit "
            f"{options.fit}."
        )
    if not direct and not trained.remembers_rooms:
        raise InputError(
            f"Reconstruction starts from training rooms, and a run of `method: "
            f"{trained.config.method}` keeps no latents of them; take a run of "
            "`method: ours`, or a prior that was packed with --latents."
        )
    for image in images:
        if image.label_set != trained.config.label_set:
            raise InputError(
                f"{image.name} has classes of label set '{image.label_set}', but the run was "
                f"trained on '{trained.config.label_set}'; prepare the image with that one."
            )
    if not images:
        return []
    found: dict[int, Reconstruction] = {}
    if isinstance(trained, TrainedReconstructor):
        for rows in _batches(images, BATCH):
            found |= zip(rows, _found_directly(trained, [images[row] for row in rows]), strict=True)
        return [found[row] for row in range(len(images))]
    assert isinstance(trained, TrainedPrior), "checked above: it remembers rooms"
    if options.fit == OBJECTS:
        return [
            Reconstruction(image, answer.scene, answer.energy, taken_for=answer.taken_for)
            for image, answer in zip(images, answer_images(trained, images), strict=True)
        ]
    for rows in _batches(images, max(BATCH // options.restarts, 1)):
        part = [images[row] for row in rows]
        found |= zip(rows, _reconstruct_batch(trained, part, options), strict=True)
    return [found[row] for row in range(len(images))]


def _found_directly(
    trained: TrainedReconstructor, images: Sequence[ObservedImage]
) -> list[Reconstruction]:
    """What a network says of images of one size; `score` is the mean distance of a side of the
    objects' 2D boxes, relative to the image's size."""
    views = as_views(images, trained.config.data.mask_step)
    names = label_set(trained.config.label_set)
    answers = []
    for row, (image, found) in enumerate(zip(images, trained.prior.find(views), strict=True)):
        objects = tuple(
            SceneObject(names[index], *item)
            for index, item in zip(image.object_class.tolist(), found, strict=True)
        )
        scene = Scene(image.name, image.label_set, objects)
        corners = box_corners(torch.tensor(scene.centers_m), torch.tensor(scene.sizes_m)).float()
        camera = (views.world_to_camera[row, None], views.intrinsics[row, None])
        boxes = boxes_of_points(corners.unsqueeze(0), *camera, views.image_size).boxes[0, 0]
        apart = (boxes - torch.from_numpy(image.boxes)).abs().mean()
        answers.append(Reconstruction(image, scene, float(apart)))
    return answers


def _batches(images: Sequence[ObservedImage], most: int) -> Iterator[list[int]]:
    """Images of one size together, and such of about as many objects: padding costs time."""
    by_size: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for row in sorted(range(len(images)), key=lambda row: len(images[row].object_class)):
        by_size[images[row].instance_ids.shape].append(row)
    for rows in by_size.values():
        yield from (rows[at : at + most] for at in range(0, len(rows), most))


def _reconstruct_batch(
    trained: TrainedPrior, images: Sequence[ObservedImage], options: FitOptions
) -> list[Reconstruction]:
    views = as_views(images, trained.config.data.mask_step)
    refuse_crowds(trained, views)
    starts = starting_latents(trained, views, options.restarts)
    repeated = rows_of(views, torch.arange(len(images)).repeat_interleave(options.restarts))
    schedule = SCHEDULES[options.fit]
    fit = fit_latents(trained, repeated, starts.flatten(0, 1), schedule, options.masks)
    best = fit.loss.score.reshape(len(images), -1).argmin(dim=1)
    rows = best + options.restarts * torch.arange(len(images))
    labels = trained.config.label_set

    def answer(image: ObservedImage, row: int) -> Reconstruction:
        predictions = fit.loss.matches.prediction[row, : len(image.object_class)].tolist()
        scene = scene_of(fit.scenes, row, predictions, trained.prior, labels, image.name)
        compared = options.masks and fit.scenes.vertices_m is not None
        mask_iou = float(fit.loss.mask_iou[row]) if compared else None
        return Reconstruction(
            image, scene, float(fit.loss.score[row]), mask_iou, int(fit.steps[row])
        )

    return [answer(image, row) for image, row in zip(images, rows.tolist(), strict=True)]


def starting_latents(
    trained: TrainedPrior, views: SceneViews, count: int
) -> Float[Tensor, "images count width"]:
    """For each image, the training rooms whose layout loss on it, as decoded, is least.

    Raises:
        InputError: more starts than training rooms.
    """
    if count > len(trained.logits):
        raise InputError(
            f"{count} nearest training rooms were asked for, but the run has "
            f"{len(trained.logits)}; ask for fewer restarts."
        )
    losses = layout_losses_of_rooms(trained, views)
    nearest = losses.topk(count, dim=1, largest=False).indices
    return trained.prior.latent_space(trained.logits)[nearest]


@torch.no_grad()
def layout_losses_of_rooms(
    trained: TrainedPrior, views: SceneViews
) -> Float[Tensor, "images rooms"]:
    """What each decoded training room would cost as the answer to each image, by 2D boxes alone."""
    most = views.is_object.shape[1]
    batches = [
        trained.prior.decode(z, False, torch.ones(len(z), most, dtype=torch.bool))
        for z in trained.prior.latent_space(trained.logits).split(START_BATCH)
    ]

    def losses_of(image: int) -> Float[Tensor, " rooms"]:
        losses = []
        for rooms in batches:
            repeated = rows_of(views, torch.full((len(rooms.centers_m),), image))
            losses.append(view_loss(trained, rooms, repeated, masks=False).score)
        return torch.cat(losses)

    return torch.stack([losses_of(image) for image in range(len(views.is_object))])
