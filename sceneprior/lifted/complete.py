"""Room completion: furnishes the rest of a room in which some objects are given.

A run's sampler draws the missing objects, given the others. Without a sampler, latents are fitted:

1. Latents are sampled from the run's distribution and decoded. Those whose rooms are most similar
   to the given objects become starting points, `RESTARTS` for each answer.
2. The network is frozen, and each latent is optimised until its room holds the given classes and
   boxes, with a penalty on its distance from the start. Predictions are matched to the given
   objects anew in each step, as in training, but in 3D.
3. For each answer, the fitted latent with the lowest loss is kept, and the given objects are
   inserted into its room (`sceneprior/lifted/insert.py`).
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.repeatable import check_seed
from sceneprior.core.scene import Scene
from sceneprior.core.scene_json import check_box
from sceneprior.core.views import DecodedScenes
from sceneprior.lifted.config import TrainedLifted
from sceneprior.lifted.insert import insert
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampled import class_rows, drawn_by_sampler, floor_rectangle, sample_scenes
from sceneprior.lifted.sampler.plan import Given
from sceneprior.paper.decode import decode_latents
from sceneprior.paper.losses import take
from sceneprior.paper.matching import assign
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import draw_latents

DRAWN = 256
"""Number of sampled latents, from which the starts are chosen."""
RESTARTS = 3
"""Starts per answer."""
STEPS = 150
"""Steps of the fit."""
RATE = 0.05
"""Length of an early step of Adam on the sphere of radius 1; it falls to 0 along a cosine."""
BOX_WEIGHT = 5.0
"""Weight of the mean distance of centres and sides in metres; the cross entropy of the class has
weight 1."""
START_WEIGHT = 2.0
"""Weight of half the squared distance from the start, which on a sphere is 1 - cosine. A larger
weight keeps rooms closer to the sampled ones; a smaller weight fits the given objects better."""


def complete(
    trained: TrainedPrior,
    scenes: Sequence[Scene],
    count: int = 4,
    seed: int = 0,
    distribution: str | None = None,
    steps: int = STEPS,
    classes: Sequence[str] | None = None,
) -> list[list[Scene]]:
    """Furnish the rest of each scene's room; all rooms and answers are computed in one batch.

    Given objects need no meshes. If a scene has no objects, its answers are rooms that the run
    generates. A sampler keeps to the bounding rectangle of the scene's floor, if it has one.

    Args:
        scenes: The given objects of each room.
        count: Number of answers per room.
        distribution: `sampler`, or the distribution of the latents from which answers start; None
            uses the run's default.
        steps: Steps of the fit of latents; 0 leaves the sampled latents unchanged.
        classes: Classes of the objects to add. None leaves the choice to the sampler.

    Returns:
        The answers of each room. Their `extra` is that of `insert`; if `classes` are given,
        `no_place` in it lists the classes for which the sampler found no free place.
    """
    check_seed(seed)
    names = [f"complete_{k:02d}" for k in range(count)]
    given = gather_given(trained, scenes)
    if (with_sampler := drawn_by_sampler(trained, distribution)) is not None:
        return _drawn(with_sampler, scenes, given, names, seed, classes)
    if classes is not None:
        raise InputError(
            "Only a sampler can add chosen classes, but these rooms come from latents; leave the "
            "classes out, or train with a section `sampler`."
        )
    starts = _starts(trained, given, count * RESTARTS, seed, distribution)
    z, loss = fit_latents_to_objects(trained, starts, repeated(given, count * RESTARTS), steps)
    # Starts are sorted, best first, and distributed in turn, so that every answer gets good ones.
    best = loss.view(len(scenes), RESTARTS, count).argmin(dim=1, keepdim=True)
    z = z.view(len(scenes), RESTARTS, count, -1).take_along_dim(best.unsqueeze(-1), dim=1)[:, 0]
    return [
        [insert(room, scene, seed=seed) for room in decode_latents(trained, own, names)]
        for scene, own in zip(scenes, z, strict=True)
    ]


def _drawn(
    trained: TrainedLifted,
    scenes: Sequence[Scene],
    given: PosedRooms,
    names: Sequence[str],
    seed: int,
    classes: Sequence[str] | None,
) -> list[list[Scene]]:
    """Complete each scene with the sampler, once for each of `names`: sample a room given the
    scene's objects, and insert these objects into it."""
    count = len(names)
    coming = None if classes is None else class_rows(trained, classes)
    most = trained.config.model.max_objects
    fullest = int(given.is_object.sum(dim=1).max()) + len(classes or ())
    if fullest > most:
        raise InputError(
            f"The given and the requested objects are {fullest} together, but rooms of this run "
            f"hold at most {most} (model.max_objects); request fewer."
        )
    answers = []
    for scene, one in zip(scenes, given.split(1), strict=True):
        frame = None if scene.floor_m is None else floor_rectangle(scene).expand(count, -1)
        wanted = None if coming is None else coming.expand(count, -1)
        rooms = sample_scenes(trained, names, seed, Given(repeated(one, count), frame, wanted))
        assert trained.sampler is not None, "drawn_by_sampler has asked"
        may_meet = trained.sampler.may_meet.cpu().numpy()
        made = [insert(room, scene, may_meet, seed=seed) for room in rooms]
        if classes is not None:
            made = [_with_no_place(room, classes) for room in made]
        answers.append(made)
    return answers


def _with_no_place(room: Scene, classes: Sequence[str]) -> Scene:
    """An answer with `extra["no_place"]`: the classes of the requested objects that it lacks."""
    added = Counter(item.label for item in room.objects[len(room.extra["given"]) :])
    lacking = sorted((Counter(classes) - added).elements())
    return replace(room, extra={**room.extra, "no_place": lacking})


def gather_given(trained: TrainedPrior, scenes: Sequence[Scene]) -> PosedRooms:
    """Given objects as tensors.

    Raises:
        InputError: the run cannot use an object, or there are too many.
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
            check_box(scene.name, item.label, item.center_m, item.size_m)
            labels[row, column] = names.index(item.label)
            boxes_m[row, column] = torch.tensor([*item.center_m, *item.size_m])
    return PosedRooms(labels, is_object, boxes_m)


def repeated(rooms: PosedRooms, times: int) -> PosedRooms:
    """Each room repeated `times` times in a row."""
    return rooms.changed(lambda tensor: tensor.repeat_interleave(times, dim=0))


@torch.no_grad()
def _starts(
    trained: TrainedPrior, given: PosedRooms, each: int, seed: int, distribution: str | None
) -> Float[Tensor, "starts dimension"]:
    """Choose `each` starting latents for every room, best first: the sampled latents whose decoded
    rooms have the lowest `given_loss`."""
    z, _ = draw_latents(trained, max(DRAWN, each), seed, distribution)
    decoded = trained.prior.decode(z, with_shape=False)
    target = trained.config.model.completeness_target
    losses = [given_loss(decoded, repeated(one, len(z)), target) for one in given.split(1)]
    return torch.cat([z[some.argsort(stable=True)[:each]] for some in losses])


def fit_latents_to_objects(
    trained: TrainedPrior,
    starts: Float[Tensor, "rooms dimension"],
    given: PosedRooms,
    steps: int = STEPS,
) -> tuple[Float[Tensor, "rooms dimension"], Float[Tensor, " rooms"]]:
    """Optimise latents until their rooms hold the given objects; return them and their final
    losses."""
    space, target = trained.prior.latent_space, trained.config.model.completeness_target
    free = starts.clone().requires_grad_()
    # Adam moves every coordinate by about its rate, hence the division.
    optimizer = torch.optim.Adam([free], lr=RATE / math.sqrt(starts.shape[1]))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    def loss_of(points: Tensor) -> Float[Tensor, " rooms"]:
        decoded = trained.prior.decode(space.onto(points), with_shape=False)
        # Measured before the projection onto the sphere: projecting a start again may change its
        # last bits, and Adam would follow that difference.
        moved = (points - starts).square().sum(dim=-1)
        return given_loss(decoded, given, target) + START_WEIGHT / 2 * moved

    for _ in range(steps):
        optimizer.zero_grad()
        # Summed, not averaged, so that a room's steps do not depend on the rest of the batch.
        loss_of(free).sum().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return space.onto(free), loss_of(free)


def given_loss(
    decoded: DecodedScenes, given: PosedRooms, completeness_target: str = "first_n"
) -> Float[Tensor, " rooms"]:
    """Loss of decoded rooms, averaged over the given objects; 0 if there are none.

        L = cross entropy of the class + `BOX_WEIGHT` * mean |b - b_given| - log p(part of the room)

    with b centre and size in metres, for the prediction matched to each given object. In the
    matching cost, minus the class's probability replaces its cross entropy, as in DETR.
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
    # Padding has class void; where void is ruled out, its cross entropy is infinite.
    each = each.where(given.is_object, 0.0)
    return each.sum(dim=1) / given.is_object.sum(dim=1).clamp(min=1)


def log_kept(
    completeness_logits: Float[Tensor, "rooms predictions"], completeness_target: str
) -> Float[Tensor, "rooms predictions"]:
    """Log-probability that each prediction belongs to the room: that no prediction up to and
    including it (`first_n`), or none before it (`stop`), ended the room."""
    if completeness_target == "stop":
        goes_on = F.logsigmoid(-completeness_logits)
        return goes_on.cumsum(dim=1) - goes_on
    return F.logsigmoid(completeness_logits).cumsum(dim=1)
