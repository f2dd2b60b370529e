"""Furnish the rest of a room of which some objects are given.

A run's sampler draws what is missing, given what is there. Without one, latents are fitted:

1. Latents are drawn by the run's distribution and decoded. Those whose rooms come nearest to the
   given objects are where the answers start, each answer from others.
2. The network is frozen and each latent moves until its room holds the given classes and boxes,
   drawn back towards its start. Which prediction stands for which given object is found anew at
   each step, as in training, but in 3D.
3. Of an answer's starts the one that ended best is taken, and the given objects are inserted into
   its room (`sceneprior/generation/insert.py`).
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.classes import VOID, label_set
from sceneprior.errors import InputError
from sceneprior.generation.decode import decode_latents
from sceneprior.generation.insert import insert
from sceneprior.generation.sample import draw_latents, uses_sampler
from sceneprior.generation.sampled import class_rows, floor_rectangle, sample_scenes
from sceneprior.losses.layout import take
from sceneprior.losses.matching import assign
from sceneprior.sampler.plan import Given
from sceneprior.scene import Scene
from sceneprior.training.method import TrainedPrior
from sceneprior.views import DecodedScenes, RoomBoxes

DRAWN = 256
"""Latents that starts are chosen from."""
RESTARTS = 3
"""Starts of each answer."""
STEPS = 150
RATE = 0.05
"""Length of an early step of Adam, where the sphere's radius is 1; it falls to 0 by a cosine."""
BOX_WEIGHT = 5.0
"""Of the mean distance of centres and sides in metres, beside the class's cross entropy."""
START_WEIGHT = 2.0
"""Of half the squared distance from the start, which on a sphere is 1 - cosine. More leaves rooms
as the distribution drew them; less fits the given objects better."""


def complete(
    trained: TrainedPrior,
    scenes: Sequence[Scene],
    count: int = 4,
    seed: int = 0,
    distribution: str | None = None,
    steps: int = STEPS,
    classes: Sequence[str] | None = None,
) -> list[list[Scene]]:
    """Furnish the rest of rooms; all rooms and all answers in one batch.

    Args:
        scenes: The given objects of each room: classes, boxes, perhaps meshes. Without any, the
            answers are what the run generates. A sampler keeps to the rectangle round a scene's
            floor.
        count: Answers a room.
        seed, distribution: `sampler`, or of the latents that answers start from; see
            `draw_latents`.
        steps: Of the fit; 0 leaves the drawn latents as they are.
        classes: What to add, and nothing else; None leaves it to the sampler.

    Returns:
        Of each room the answers: see `insert`.

    Raises:
        InputError: a given object cannot be used, or there are more than the run's rooms hold.
    """
    given = gather_given(trained, scenes)
    if uses_sampler(trained, distribution):
        return _drawn(trained, scenes, given, count, seed, classes)
    if classes is not None:
        raise InputError(
            "Which classes to add can be asked of a sampler alone, and these rooms come from "
            "latents; leave the classes out, or train with a section `sampler`."
        )
    starts = _starts(trained, given, count * RESTARTS, seed, distribution)
    z, loss = fit_latents(trained, starts, repeated(given, count * RESTARTS), steps)
    # Starts are in order of promise; dealt out in turn, every answer has good ones.
    best = loss.view(len(scenes), RESTARTS, count).argmin(dim=1, keepdim=True)
    z = z.view(len(scenes), RESTARTS, count, -1).take_along_dim(best.unsqueeze(-1), dim=1)[:, 0]
    names = [f"complete_{k:02d}" for k in range(count)]
    return [
        [insert(room, scene, seed=seed) for room in decode_latents(trained, own, names)]
        for scene, own in zip(scenes, z, strict=True)
    ]


def _drawn(
    trained: TrainedPrior,
    scenes: Sequence[Scene],
    given: RoomBoxes,
    count: int,
    seed: int,
    classes: Sequence[str] | None,
) -> list[list[Scene]]:
    """Answers of a run's sampler, by room."""
    names = [f"complete_{k:02d}" for k in range(count)]
    coming = None if classes is None else class_rows(trained, classes)
    most = trained.config.model.max_objects
    fullest = int(given.is_object.sum(dim=1).max()) + len(classes or ())
    if fullest > most:
        raise InputError(
            f"Given and asked-for objects are {fullest} together, but rooms of this run hold at "
            f"most {most} (model.max_objects); ask for fewer."
        )
    answers = []
    for scene, one in zip(scenes, given.split(1), strict=True):
        frame = None if scene.floor_m is None else floor_rectangle(scene).expand(count, -1)
        whole = Given(
            repeated(one, count), frame, None if coming is None else coming.expand(count, -1)
        )
        rooms = sample_scenes(trained, names, seed, whole)
        answers.append([insert(room, scene, seed=seed) for room in rooms])
    return answers


def gather_given(trained: TrainedPrior, scenes: Sequence[Scene]) -> RoomBoxes:
    """Given objects as tensors.

    Raises:
        InputError: a class is not of the run's label set, a box is none, or they are too many.
    """
    config = trained.config
    names, most = label_set(config.label_set), config.model.max_objects
    counts = torch.tensor([len(scene.objects) for scene in scenes])
    is_object = torch.arange(max(1, int(counts.max()))) < counts[:, None]
    labels = torch.zeros(is_object.shape, dtype=torch.int64)
    boxes_m = torch.ones(*is_object.shape, 6, dtype=trained.logits.dtype)
    for row, scene in enumerate(scenes):
        if len(scene.objects) > most:
            raise InputError(
                f"{scene.name} gives {len(scene.objects)} objects, but rooms of this run hold at "
                f"most {most} (model.max_objects); give fewer, or train with more."
            )
        for column, item in enumerate(scene.objects):
            if item.label not in names or names.index(item.label) == VOID:
                raise InputError(
                    f"{scene.name}: object {column} is a '{item.label}', which this run does not "
                    f"know; its classes are {', '.join(names[1:])}."
                )
            box = np.array([*item.center_m, *item.size_m], dtype=np.float64)
            if not np.isfinite(box).all() or (box[3:] <= 0).any():
                raise InputError(
                    f"{scene.name}: the box of object {column} ({item.label}) is {box.tolist()}; "
                    "expected a finite centre and three sides above 0 (metres)."
                )
            labels[row, column] = names.index(item.label)
            boxes_m[row, column] = torch.from_numpy(box)
    return RoomBoxes(labels, is_object, boxes_m)


def repeated(rooms: RoomBoxes, times: int) -> RoomBoxes:
    """Every room so many times, one after the other."""
    return rooms.changed(lambda tensor: tensor.repeat_interleave(times, dim=0))


@torch.no_grad()
def _starts(
    trained: TrainedPrior, given: RoomBoxes, each: int, seed: int, distribution: str | None
) -> Float[Tensor, "starts dimension"]:
    """The `each` drawn latents for every room that come nearest to what is given, best first."""
    z, _ = draw_latents(trained, max(DRAWN, each), seed, distribution)
    decoded = trained.prior.decode(z, with_shape=False)
    target = trained.config.model.completeness_target
    losses = [given_loss(decoded, repeated(one, len(z)), target) for one in given.split(1)]
    return torch.cat([z[some.argsort(stable=True)[:each]] for some in losses])


def fit_latents(
    trained: TrainedPrior,
    starts: Float[Tensor, "rooms dimension"],
    given: RoomBoxes,
    steps: int = STEPS,
) -> tuple[Float[Tensor, "rooms dimension"], Float[Tensor, " rooms"]]:
    """Move latents until their rooms hold what is given; the latents, and what is left to win."""
    space, target = trained.prior.latent_space, trained.config.model.completeness_target
    free = starts.clone().requires_grad_()
    # Adam moves every coordinate by about its rate.
    optimizer = torch.optim.Adam([free], lr=RATE / math.sqrt(starts.shape[1]))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    def loss_of(points: Tensor) -> Float[Tensor, " rooms"]:
        decoded = trained.prior.decode(space.onto(points), with_shape=False)
        # Not from the sphere: put onto it again, a start may differ in its last bits, and Adam
        # would follow those.
        moved = (points - starts).square().sum(dim=-1)
        return given_loss(decoded, given, target) + START_WEIGHT / 2 * moved

    for _ in range(steps):
        optimizer.zero_grad()
        # Summed, not averaged: a room's steps do not depend on who else is in the batch.
        loss_of(free).sum().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return space.onto(free), loss_of(free)


def given_loss(
    decoded: DecodedScenes, given: RoomBoxes, completeness_target: str = "first_n"
) -> Float[Tensor, " rooms"]:
    """How far decoded rooms are from holding the given objects, mean over these; 0 without any.

    Cross entropy of the class + `BOX_WEIGHT` x mean distance in metres + minus the logarithm of
    the probability that the prediction is part of the room, of the predictions assigned at the
    least cost, which has the class's probability in place of its logarithm (as DETR).
    """
    boxes = torch.cat([decoded.centers_m, decoded.sizes_m], dim=-1)
    kept = -log_kept(decoded.completeness_logits, completeness_target)
    with torch.no_grad():
        predictions, objects = boxes.shape[1], given.object_class.shape[1]
        wanted = given.object_class.unsqueeze(1).expand(-1, predictions, -1)
        cost = -decoded.class_logits.softmax(dim=-1).gather(-1, wanted)
        for side in range(6):
            apart = boxes[..., side].unsqueeze(2) - given.boxes_m[..., side].unsqueeze(1)
            cost += BOX_WEIGHT / 6 * apart.abs()
        cost += kept.unsqueeze(-1)
        rows = assign(cost, [predictions] * len(cost), given.is_object.sum(dim=1).tolist())
    logits = take(decoded.class_logits, rows, dim=1)
    each = F.cross_entropy(logits.flatten(0, 1), given.object_class.flatten(), reduction="none")
    each = each.view(-1, objects) + take(kept, rows, dim=1)
    each = each + BOX_WEIGHT * (take(boxes, rows, dim=1) - given.boxes_m).abs().mean(dim=-1)
    # Padding is no class: where void is ruled out, its cross entropy has no end.
    each = each.where(given.is_object, 0.0)
    return each.sum(dim=1) / given.is_object.sum(dim=1).clamp(min=1)


def log_kept(
    completeness_logits: Float[Tensor, "rooms predictions"], completeness_target: str
) -> Float[Tensor, "rooms predictions"]:
    """Logarithm of the probability that each prediction belongs to the room: that no prediction up
    to it ended the room (`first_n`), or none before it (`stop`)."""
    if completeness_target == "stop":
        goes_on = F.logsigmoid(-completeness_logits)
        return goes_on.cumsum(dim=1) - goes_on
    return F.logsigmoid(completeness_logits).cumsum(dim=1)
