"""Reconstruct rooms from instance masks of single images: starts, fits, the best as a scene."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.generation.decode import scene_of
from sceneprior.generation.sample import sample_latents
from sceneprior.reconstruction.fit import SCHEDULES, fit_latents, refuse_crowds, view_loss
from sceneprior.reconstruction.image import ObservedImage, as_views, rows_of
from sceneprior.scene import Scene
from sceneprior.training.method import TrainedPrior
from sceneprior.views import SceneViews

BATCH = 128
"""Latents fitted at once: images times restarts."""
STARTS = ("nearest", "random")
START_BATCH = 256
"""Training rooms decoded at once."""


@dataclass(frozen=True)
class FitOptions:
    """How images are reconstructed."""

    schedule: str = "paper"
    """A name in `SCHEDULES`."""
    restarts: int = 1
    """Latents fitted to each image; the one with the lowest score is kept."""
    start: str = "nearest"
    """Where they begin: see `starting_latents`."""
    masks: bool = True
    """False fits classes and 2D boxes alone, as always where shapes are occupancy grids."""
    seed: int = 0
    """Of random starts."""


@dataclass(frozen=True)
class Reconstruction:
    """What one image shows, in 3D."""

    image: ObservedImage
    scene: Scene
    """One object a mask, in the masks' order."""
    score: float
    """Layout loss plus lambda_S * (1 - mean mask IoU): compares answers to one image."""
    mask_iou: float
    """Mean over the image's masks; 0 where masks are not compared."""
    steps: int


def reconstruct(
    trained: TrainedPrior, images: Sequence[ObservedImage], options: FitOptions
) -> list[Reconstruction]:
    """Reconstruct images of the run's label set, many at once. Before the run's shape stage scenes
    are boxes, and masks are not compared; nor are they where shapes are occupancy grids.

    Raises:
        InputError: unknown options, a run without latents of rooms, another label set, or more
            objects than the prior generates.
    """
    if options.schedule not in SCHEDULES:
        raise InputError(
            f"No schedule is called '{options.schedule}'; choose from {', '.join(SCHEDULES)}."
        )
    if options.restarts < 1:
        raise InputError(f"restarts is {options.restarts}; an image needs at least one.")
    if not trained.remembers_rooms:
        raise InputError(
            f"Fitting starts from training rooms, and a run of `method: {trained.config.method}` "
            "keeps no latents of them; take a run of `method: ours`."
        )
    for image in images:
        if image.label_set != trained.config.label_set:
            raise InputError(
                f"{image.name} has classes of label set '{image.label_set}', but the run was "
                f"trained on '{trained.config.label_set}'; prepare the image with that one."
            )
    found: dict[int, Reconstruction] = {}
    for rows in _batches(images, max(BATCH // options.restarts, 1)):
        part = [images[row] for row in rows]
        found |= zip(rows, _reconstruct_batch(trained, part, options), strict=True)
    return [found[row] for row in range(len(images))]


@torch.no_grad()
def unlearnt_classes(trained: TrainedPrior, images: Sequence[ObservedImage]) -> list[str]:
    """Classes of the images that the run gives to no object of any training room it decodes."""
    names = label_set(trained.config.label_set)
    rooms = trained.prior(trained.logits, with_shape=False)
    known = set(rooms.class_logits.argmax(dim=-1).unique().tolist())
    asked = {int(index) for image in images for index in image.object_class}
    return [names[index] for index in sorted(asked - known)]


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
    views = as_views(images)
    refuse_crowds(trained, views)
    starts = starting_latents(trained, views, options.restarts, options.start, options.seed)
    repeated = rows_of(views, torch.arange(len(images)).repeat_interleave(options.restarts))
    schedule = SCHEDULES[options.schedule]
    fit = fit_latents(trained, repeated, starts.flatten(0, 1), schedule, options.masks)
    best = fit.loss.score.reshape(len(images), -1).argmin(dim=1)
    rows = best + options.restarts * torch.arange(len(images))
    labels = trained.config.label_set

    def answer(image: ObservedImage, row: int) -> Reconstruction:
        predictions = fit.loss.matches.prediction[row, : len(image.object_class)].tolist()
        scene = scene_of(fit.scenes, row, predictions, trained.prior, labels, image.name)
        score, mask_iou = float(fit.loss.score[row]), float(fit.loss.mask_iou[row])
        return Reconstruction(image, scene, score, mask_iou, int(fit.steps[row]))

    return [answer(image, row) for image, row in zip(images, rows.tolist(), strict=True)]


def starting_latents(
    trained: TrainedPrior, views: SceneViews, count: int, kind: str = "nearest", seed: int = 0
) -> Float[Tensor, "images count width"]:
    """Several starts for each image.

    `nearest` are the training rooms, as decoded, whose layout loss on the image is least; `random`
    ones are drawn around the training rooms, as new rooms are (the kernel distribution), the same
    for every image.

    Raises:
        InputError: an unknown kind, or more starts than training rooms.
    """
    if kind not in STARTS:
        raise InputError(f"No start is called '{kind}'; choose from {', '.join(STARTS)}.")
    if kind == "random":
        drawn = sample_latents(trained.prior.latent_space, trained.logits, count, seed, "kernel")
        return drawn.expand(len(views.is_object), -1, -1)
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
