"""Reconstruct rooms from instance masks of single images, object by object or by latents, and write
scenes, and pictures of the masks next to the result."""

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sceneprior.apps.rooms import PAGE_FILE, clear_scenes, write_scene
from sceneprior.core.boxes import box_corners
from sceneprior.core.cameras import Pinhole, boxes_of_points, pixel_rays
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import write_whole
from sceneprior.core.parallel import run_tasks
from sceneprior.core.repeatable import single_threaded
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import ObservedImage, SceneViews, as_views, rows_of
from sceneprior.evaluation.page import png_uri, write_rooms_page
from sceneprior.lifted.reconstruction.objects import answer_images
from sceneprior.paper.fit_image import SCHEDULES, fit_latents_to_images, refuse_crowds, view_loss
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import scene_of, with_training_latents
from sceneprior.render.appearance import (
    contact_sheet,
    object_colors,
    paint_ids,
    png_bytes,
    quiet_colors,
    scene_meshes,
)
from sceneprior.render.offscreen import SoftwareRenderer
from sceneprior.render.topdown import topdown, topdown_protocol
from sceneprior.training.method import Trained, TrainedReconstructor

BATCH = 128
"""Number of images of a task, times restarts: the latents fitted at once."""
OBJECTS = "objects"
"""Value of `fit` for the object-by-object fit of the lifted method; any other value names a
schedule (`SCHEDULES`) with which a latent is fitted."""
START_BATCH = 256
"""Number of training rooms decoded at once."""

HEIGHT_PX = 360
"""Height of each panel, to which masks are scaled."""
GAP_PX, LINE_PX, COLUMN_PX = 8, 24, 170
"""Gap between panels; height and width of an entry of the legend."""
PAPER, INK = (255, 255, 255), (40, 40, 40)
MARGIN_M = 0.3
"""Smallest margin around the camera in the top view."""
SIGHT_M = 0.8
"""Length of the lines that show the field of view in the top view."""


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
    cpu_s: float = 0.0
    """CPU seconds that it took."""


def reconstruct(
    prior: Any,
    images: Sequence[ObservedImage],
    fit: str = OBJECTS,
    restarts: int = 1,
    masks: bool = True,
) -> list[Reconstruction]:
    """Reconstruct images of the run's label set, a batch a task.

    Scenes have no meshes if the run's shape stage has not been trained. A baseline that predicts
    objects from images directly is used without a fit.

    Args:
        prior: A `Prior`, which workers load themselves, or a `Trained`.
        fit: `objects` fits object by object; a name of `SCHEDULES` fits one latent per image.
        restarts: Number of latents fitted to each image, started at the nearest training rooms; the
            latent with the lowest score is kept.
        masks: Also fit latents to masks. False uses only classes and 2D boxes, as is always done if
            shapes are posed prototypes rather than meshes.
    """
    trained: Trained = getattr(prior, "trained", prior)
    if fit not in (OBJECTS, *SCHEDULES):
        raise InputError(
            f"No fit is called '{fit}'; choose from {', '.join((OBJECTS, *SCHEDULES))}."
        )
    if restarts < 1:
        raise InputError(f"restarts is {restarts}; an image needs at least one.")
    if restarts > 1 and fit == OBJECTS:
        raise InputError("restarts apply only to the fit `paper`, which fits latents; name it.")
    if not isinstance(trained, TrainedReconstructor):
        with_training_latents(trained, "Reconstruction")
    elif fit != OBJECTS:
        raise InputError(
            f"A run of `method: {trained.config.method}` has no latents to fit; leave out the fit "
            f"{fit}."
        )
    for image in images:
        if image.label_set != trained.config.label_set:
            raise InputError(
                f"{image.name} has classes of label set '{image.label_set}', but the run was "
                f"trained on '{trained.config.label_set}'; prepare the image with that label set."
            )
    # Batches of images of one size with similar numbers of objects, to limit padding.
    by_size: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for row in sorted(range(len(images)), key=lambda row: len(images[row].object_class)):
        by_size[images[row].instance_ids.shape].append(row)
    most = max(BATCH // restarts, 1)
    batches = [
        size[at : at + most] for size in by_size.values() for at in range(0, len(size), most)
    ]
    tasks = {
        f"batch {number}, from {images[batch[0]].name} on": ([images[row] for row in batch],)
        for number, batch in enumerate(batches, start=1)
    }
    answers = run_tasks(partial(_reconstructed, prior, fit, restarts, masks), tasks, "fitting")
    found = dict(zip(chain(*batches), chain(*answers), strict=True))
    return [found[row] for row in range(len(images))]


@single_threaded()
def _reconstructed(
    prior: Any, fit: str, restarts: int, masks: bool, images: Sequence[ObservedImage]
) -> list[Reconstruction]:
    """Reconstruct one batch."""
    begin, trained = time.process_time(), getattr(prior, "trained", prior)
    if isinstance(trained, TrainedReconstructor):
        found = _found_directly(trained, images)
    elif fit != OBJECTS:
        found = _fitted(trained, images, fit, restarts, masks)
    else:
        found = [
            Reconstruction(image, answer.scene, answer.energy, taken_for=answer.taken_for)
            for image, answer in zip(images, answer_images(trained, images), strict=True)
        ]
    cpu_s = (time.process_time() - begin) / len(images)
    return [replace(one, cpu_s=cpu_s) for one in found]


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


def _fitted(
    trained: TrainedPrior, images: Sequence[ObservedImage], fit: str, restarts: int, masks: bool
) -> list[Reconstruction]:
    """Latents fitted to images of one size, from the training rooms with the lowest layout losses
    on each."""
    views = as_views(images, trained.config.data.mask_step)
    refuse_crowds(trained, views)
    if restarts > len(trained.logits):
        raise InputError(
            f"{restarts} restarts need as many training rooms, but the run has "
            f"{len(trained.logits)}; use fewer restarts."
        )
    losses = layout_losses_of_rooms(trained, views)
    nearest = losses.topk(restarts, dim=1, largest=False).indices
    starts = trained.prior.latent_space(trained.logits)[nearest]
    repeated = rows_of(views, torch.arange(len(images)).repeat_interleave(restarts))
    given = (starts.flatten(0, 1), SCHEDULES[fit], masks)
    found = fit_latents_to_images(trained, repeated, *given)
    compared = masks and found.scenes.vertices_m is not None
    best = found.loss.score.reshape(len(images), -1).argmin(dim=1)
    rows = best + restarts * torch.arange(len(images))
    answers = []
    for image, row in zip(images, rows.tolist(), strict=True):
        predictions = found.loss.matches.prediction[row, : len(image.object_class)].tolist()
        scene = scene_of(trained, found.scenes, row, predictions, image.name)
        mask_iou = float(found.loss.mask_iou[row]) if compared else None
        score, steps = float(found.loss.score[row]), int(found.steps[row])
        answers.append(Reconstruction(image, scene, score, mask_iou, steps))
    return answers


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


def write_reconstructions(found: Sequence[Reconstruction], folder: Path) -> None:
    """Write `<name>.json`, `.glb` and `.png`, and `<name>_seen.png`, for each image.

    The JSON's `extra` holds the image's room and view, its camera, and the scores of the fit.
    """
    clear_scenes(folder)
    for one in found:
        image = one.image
        extra = {
            "room_id": image.room_id,
            "view": image.view,
            "world_to_camera": image.world_to_camera.tolist(),
            "intrinsics": image.intrinsics.tolist(),
            "image_size": list(image.instance_ids.shape),
            "score": round(one.score, 5),
            "mask_iou": None if one.mask_iou is None else round(one.mask_iou, 4),
            "steps": one.steps,
            "taken_for": one.taken_for,
        }
        write_whole(Path(folder) / f"{image.name}_seen.png", png_bytes(_picture(one)))
        write_scene(replace(one.scene, extra=extra), folder, image.name)


def write_page(found: Reconstruction, folder: Path) -> None:
    """Write `rooms.html` to the folder of `write_reconstructions`."""
    seen = png_uri(Image.fromarray(_picture(found)))
    write_rooms_page(
        Path(folder) / PAGE_FILE,
        [found.scene],
        title=found.image.name,
        subtitle="A room from the masks of one image",
        pictures=[("The masks, the reconstruction from the same camera, and from above", seen)],
    )


def _picture(found: Reconstruction) -> UInt8[np.ndarray, "height width 3"]:
    """Three panels (masks, camera view, top view) with titles and a legend, coloured by class."""
    image, scene = found.image, found.scene
    names = label_set(image.label_set)
    colors = quiet_colors(names)
    camera = Pinhole(image.world_to_camera.astype(np.float64), image.intrinsics.astype(np.float64))
    panels = {
        "masks given": paint_ids(
            image.instance_ids.astype(np.int64), colors[image.object_class], PAPER
        ),
        "found, same camera": SoftwareRenderer().shaded(
            scene_meshes(scene), object_colors(scene), camera, image.instance_ids.shape
        ),
        "found, from above": _from_above(scene, image),
    }
    scaled = []
    for panel in panels.values():
        width = max(round(panel.shape[1] * HEIGHT_PX / panel.shape[0]), 1)
        size = (width, HEIGHT_PX)
        scaled.append(np.asarray(Image.fromarray(panel).resize(size, Image.Resampling.NEAREST)))
    sheet = contact_sheet(scaled, 3, list(panels), GAP_PX)
    shown = {names[index] for index in image.object_class} | {each.label for each in scene.objects}
    rows = [index for index, name in enumerate(names) if name in shown]
    return np.concatenate([sheet, _legend([names[row] for row in rows], colors[rows], sheet)])


def _legend(
    names: Sequence[str],
    colors: UInt8[np.ndarray, "classes 3"],
    above: UInt8[np.ndarray, "_ width 3"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Colours of classes, in columns below a picture of the same width."""
    columns = max(above.shape[1] // COLUMN_PX, 1)
    legend = Image.new("RGB", (above.shape[1], LINE_PX * -(-len(names) // columns)), PAPER)
    draw, font = ImageDraw.Draw(legend), ImageFont.load_default(14)
    for place, (name, color) in enumerate(zip(names, colors.tolist(), strict=True)):
        y, x = LINE_PX * (place // columns), COLUMN_PX * (place % columns) + GAP_PX
        draw.rectangle((x, y + 6, x + 12, y + 18), tuple(color))
        draw.text((x + 17, y + 3), name, INK, font)
    return np.asarray(legend)


def _from_above(scene: Scene, image: ObservedImage) -> UInt8[np.ndarray, "height width 3"]:
    """Top-down picture of the reconstruction, with the camera and its field of view."""
    eye = image.eye_m
    reach_m = [np.abs(scene.centers_m) + scene.sizes_m / 2, np.abs(eye) + MARGIN_M]
    widest_m = 2 * float(np.concatenate([part.reshape(-1, 3) for part in reach_m])[:, [0, 2]].max())
    protocol = topdown_protocol(scene.label_set)
    window_m = max(protocol.window_m, widest_m)  # unlike in metrics, nothing is cut off
    protocol = replace(protocol, image_size=(HEIGHT_PX, HEIGHT_PX), window_m=window_m)
    plan = Image.fromarray(topdown(scene, protocol, outlines=True))

    def pixel(point_m: np.ndarray) -> tuple[float, float]:
        x, z = point_m[[0, 2]] / protocol.metres_per_pixel + HEIGHT_PX / 2
        return float(x), float(z)

    draw = ImageDraw.Draw(plan)
    middle = image.intrinsics[1, 2]
    sides = np.array([[0, middle], [image.instance_ids.shape[1], middle]])
    for ray in pixel_rays(sides, image.world_to_camera, image.intrinsics):
        draw.line((pixel(eye), pixel(eye + SIGHT_M * ray)), INK, 2)
    x, y = pixel(eye)
    draw.ellipse((x - 4, y - 4, x + 4, y + 4), INK)
    return np.asarray(plan)
