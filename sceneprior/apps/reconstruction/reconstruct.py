"""Reconstruct rooms from instance masks of single images: object by object, or by latents."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.core.boxes import box_corners
from sceneprior.core.cameras import boxes_of_points
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import ObservedImage, SceneViews, as_views, rows_of
from sceneprior.lifted.reconstruction.objects import answer_images
from sceneprior.paper.fit_image import SCHEDULES, fit_latents_to_images, refuse_crowds, view_loss
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import scene_of, with_training_latents
from sceneprior.training.method import Trained, TrainedReconstructor

BATCH = 128
"""Number of latents fitted at once: images times restarts."""
OBJECTS = "objects"
"""Value of `fit` for the object-by-object fit of the lifted method; any other value names a
schedule (`SCHEDULES`) with which a latent is fitted."""
START_BATCH = 256
"""Number of training rooms decoded at once."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a reconstruction."""

    fit: str = OBJECTS
    """`objects` fits object by object; a name of `SCHEDULES` fits one latent per image."""
    restarts: int = 1
    """Number of latents fitted to each image, started at the nearest training rooms; the latent
    with the lowest score is kept."""
    masks: bool = True
    """Also fit latents to masks. False uses only classes and 2D boxes, as is always done if shapes
    are posed prototypes rather than meshes."""


@dataclass(frozen=True)
class Reconstruction:
    """The 3D reconstruction of one image."""

    image: ObservedImage
    scene: Scene
    """One object per mask, in the masks' order."""
    score: float
    """Score for comparing reconstructions of one image; lower is better. For objects it is
    `ObjectAnswer.energy`, for latents the layout loss plus lambda_S * (1 - mean mask IoU), and for
    direct predictions the box error of `_found_directly`."""
    mask_iou: float | None = None
    """Mean IoU over the image's masks; None if masks are not compared as pixels."""
    steps: int | None = None
    """Steps of a latent fit; None for other fits."""
    taken_for: dict[str, str] = field(default_factory=dict)
    """See `ObjectAnswer.taken_for`."""


def reconstruct(
    trained: Trained, images: Sequence[ObservedImage], options: FitOptions
) -> list[Reconstruction]:
    """Reconstruct images of the run's label set, in batches.

    Scenes have no meshes if the run's shape stage has not been trained. A baseline that predicts
    objects from images directly is used without a fit.
    """
    if options.fit not in (OBJECTS, *SCHEDULES):
        raise InputError(
            f"No fit is called '{options.fit}'; choose from {', '.join((OBJECTS, *SCHEDULES))}."
        )
    if options.restarts < 1:
        raise InputError(f"restarts is {options.restarts}; an image needs at least one.")
    if options.restarts > 1 and options.fit == OBJECTS:
        raise InputError("restarts apply only to the fit `paper`, which fits latents; name it.")
    if not isinstance(trained, TrainedReconstructor):
        with_training_latents(trained, "Reconstruction")
    elif options.fit != OBJECTS:
        raise InputError(
            f"A run of `method: {trained.config.method}` has no latents to fit; leave out the fit "
            f"{options.fit}."
        )
    for image in images:
        if image.label_set != trained.config.label_set:
            raise InputError(
                f"{image.name} has classes of label set '{image.label_set}', but the run was "
                f"trained on '{trained.config.label_set}'; prepare the image with that label set."
            )
    if not images:
        return []
    if isinstance(trained, TrainedPrior) and options.fit == OBJECTS:
        return [
            Reconstruction(image, answer.scene, answer.energy, taken_for=answer.taken_for)
            for image, answer in zip(images, answer_images(trained, images), strict=True)
        ]
    found: dict[int, Reconstruction] = {}
    for rows in _batches(images, max(BATCH // options.restarts, 1)):
        part = [images[row] for row in rows]
        if isinstance(trained, TrainedReconstructor):
            answers = _found_directly(trained, part)
        else:
            assert isinstance(trained, TrainedPrior), "checked above: it remembers rooms"
            answers = _reconstruct_batch(trained, part, options)
        found |= zip(rows, answers, strict=True)
    return [found[row] for row in range(len(images))]


def _found_directly(
    trained: TrainedReconstructor, images: Sequence[ObservedImage]
) -> list[Reconstruction]:
    """Predictions of a direct network for images of one size.

    `score` is the mean absolute error of the sides of the objects' projected 2D boxes, relative to
    the image's size.
    """
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
    """Batches of images of one size with similar numbers of objects, to limit padding."""
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
    fit = fit_latents_to_images(trained, repeated, starts.flatten(0, 1), schedule, options.masks)
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
    """For each image, the latents of the training rooms with the lowest layout loss on it."""
    if count > len(trained.logits):
        raise InputError(
            f"{count} restarts need as many training rooms, but the run has "
            f"{len(trained.logits)}; use fewer restarts."
        )
    losses = layout_losses_of_rooms(trained, views)
    nearest = losses.topk(count, dim=1, largest=False).indices
    return trained.prior.latent_space(trained.logits)[nearest]


@torch.no_grad()
def layout_losses_of_rooms(
    trained: TrainedPrior, views: SceneViews
) -> Float[Tensor, "images rooms"]:
    """Layout loss of each decoded training room on each image, from 2D boxes alone."""
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
