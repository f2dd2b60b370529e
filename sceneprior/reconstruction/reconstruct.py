"""Images with instance masks in, furnished rooms that explain them out (section 5.2)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from sceneprior.classes import VOID, label_set
from sceneprior.errors import InputError
from sceneprior.reconstruction.fit import SCHEDULES, Fit, fit_latents, refuse_crowds, rows_of
from sceneprior.reconstruction.observed import ObservedImage, as_views
from sceneprior.reconstruction.refinement import refine
from sceneprior.reconstruction.starts import starting_latents
from sceneprior.scene import Mesh, Scene, SceneObject
from sceneprior.training.method import TrainedPrior
from sceneprior.views import DecodedScenes

BATCH = 128
"""Latents fitted at once: images times restarts."""
MASK_COLUMNS = 80
"""About how many pixels wide masks are compared; training's 480 / 6."""


@dataclass(frozen=True)
class FitOptions:
    """How images are reconstructed."""

    schedule: str = "paper"
    """A name in `SCHEDULES`."""
    restarts: int = 1
    """Latents fitted to each image; the one with the lowest score is kept."""
    start: str = "nearest"
    """Where they begin: see `starting_latents`."""
    refine: bool = False
    """Move the found boxes onto their masks afterwards."""
    masks: bool = True
    """False fits classes and 2D boxes alone."""
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
    """Reconstruct images, many at once.

    Args:
        trained: The prior; before its shape stage scenes are boxes, and masks are not compared.
        images: Of the run's label set.
        options: See there.

    Raises:
        InputError: unknown options, a run without latents of rooms, another label set, or more
            objects than the prior generates.
    """
    check_options(options)
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
        found |= dict(zip(rows, _reconstruct_batch(trained, part, options), strict=True))
    return [found[row] for row in range(len(images))]


def check_options(options: FitOptions) -> None:
    """Refuse a schedule that does not exist, and fewer than one restart.

    Raises:
        InputError: either.
    """
    if options.schedule not in SCHEDULES:
        raise InputError(
            f"No schedule is called '{options.schedule}'; choose from {', '.join(SCHEDULES)}."
        )
    if options.restarts < 1:
        raise InputError(f"restarts is {options.restarts}; an image needs at least one.")


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
    by_size: dict[tuple[int, ...], list[int]] = {}
    for row, image in enumerate(images):
        by_size.setdefault(image.instance_ids.shape, []).append(row)
    for rows in by_size.values():
        rows.sort(key=lambda row: len(images[row].object_class))
        for at in range(0, len(rows), most):
            yield rows[at : at + most]


def _reconstruct_batch(
    trained: TrainedPrior, images: Sequence[ObservedImage], options: FitOptions
) -> list[Reconstruction]:
    step = max(1, round(images[0].instance_ids.shape[1] / MASK_COLUMNS))
    views = as_views(images, step)
    refuse_crowds(trained, views)
    starts = starting_latents(trained, views, options.restarts, options.start, options.seed)
    every = torch.arange(len(images)).repeat_interleave(options.restarts)
    repeated = rows_of(views, every)
    fit = fit_latents(
        trained, repeated, starts.flatten(0, 1), SCHEDULES[options.schedule], options.masks
    )
    if options.refine:
        fit = refine(trained, repeated, fit)
    best = fit.loss.score.reshape(len(images), -1).argmin(dim=1)
    rows = best + options.restarts * torch.arange(len(images))
    return [
        _reconstruction(trained, image, fit, row)
        for image, row in zip(images, rows.tolist(), strict=True)
    ]


def _reconstruction(
    trained: TrainedPrior, image: ObservedImage, fit: Fit, row: int
) -> Reconstruction:
    slots = fit.loss.matches.prediction[row, : len(image.object_class)].tolist()
    return Reconstruction(
        image=image,
        scene=answer(trained, fit.scenes, row, slots, image.name),
        score=float(fit.loss.score[row]),
        mask_iou=float(fit.loss.mask_iou[row]),
        steps=int(fit.steps[row]),
    )


def answer(
    trained: TrainedPrior, scenes: DecodedScenes, row: int, slots: Sequence[int], name: str
) -> Scene:
    """The predictions that answer for an image's masks, as a scene, in the masks' order.

    Classes are the prior's likeliest but void: an image is told what it shows.
    """
    names = label_set(trained.config.label_set)
    faces = trained.prior.shape.faces.cpu().numpy()
    objects = []
    for slot in slots:
        logits = scenes.class_logits[row, slot].clone()
        logits[VOID] = -torch.inf
        x, y, z = scenes.centers_m[row, slot].tolist()
        width, height, depth = scenes.sizes_m[row, slot].tolist()
        mesh = None
        if scenes.vertices_m is not None:
            mesh = Mesh(scenes.vertices_m[row, slot].cpu().numpy(), faces)
        objects.append(
            SceneObject(names[int(logits.argmax())], (x, y, z), (width, height, depth), mesh)
        )
    return Scene(name, trained.config.label_set, tuple(objects))
