"""Reconstruct an image object by object: the prior's objects, placed so that they match the masks.

For each mask, candidates are the objects of its class in all training rooms, as the prior decodes
them, in all quarter turns. Each is moved until its outline fits the mask's. The remaining
difference gives its likelihood; the answer is the candidate whose box has the highest expected IoU.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS, box_iou_3d, turn_vectors
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.proxies import beveled_cube, icosphere
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import DecodedScenes, ObservedImage
from sceneprior.lifted.prototype_decoder import PosedScenes, PrototypeDecoder
from sceneprior.lifted.reconstruction.known_rooms import turn_object
from sceneprior.lifted.reconstruction.placing import Outlines, Placed, outlines_of, place_objects
from sceneprior.paper.losses import kept_objects
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import scene_of

OF_CLASS = 200
"""Number of candidates per class, chosen with a fixed seed."""
PROMISING = 64
"""Number of guesses per mask that are refined. All guesses are placed as beveled boxes in two
quarter turns; the best ones are then placed again with their decoded shapes, and also turned by 180
degrees."""
AT_ONCE = 16384
"""Objects placed at a time."""
ROOMS = 64
"""Rooms decoded at a time."""
POINTS_LEVEL = 1
"""Icosphere level of the 42 directions in which a shape's extreme points are compared."""

UNIT_BOX = np.array([0.0, 0, 0, 1, 1, 1])
"""Centre and extents of a cube at the origin, with sides of 1 m."""


class Candidates(NamedTuple):
    """Objects as the prior decodes them, one per row."""

    room: Int[Tensor, " objects"]
    """Index of the training room."""
    slot: Int[Tensor, " objects"]
    """Index of the object among the room's predictions."""
    object_class: Int[Tensor, " objects"]
    bottom_m: Float[Tensor, " objects"]
    sizes_m: Float[Tensor, "objects 3"]
    points: Float[Tensor, "objects points 3"]
    """Points on the surface, in the frame in which the object's box is [-0.5, 0.5]^3."""


class Guesses(NamedTuple):
    """Guesses of the object behind each mask: a candidate in a turn, one per row."""

    mask: Int[Tensor, " guesses"]
    """Index of the mask, counted over all images."""
    candidate: Int[Tensor, " guesses"]
    quarter: Int[Tensor, " guesses"]


class ObjectAnswer(NamedTuple):
    """The reconstruction of an image."""

    scene: Scene
    """One object per mask, in the order of the masks, with the image's classes."""
    energy: float
    """Mean of `Placed.energy` over the masks' best guesses; it ranks camera hypotheses of one
    image."""
    taken_for: dict[str, str]
    """Maps each class of the image that the run never generates to the class of the object used for
    it."""


_Columns = TypeVar("_Columns", Candidates, Guesses, Outlines, Placed)


def _rows(columns: _Columns, rows: Tensor) -> _Columns:
    """These rows of all columns."""
    return type(columns)(*(part[rows] for part in columns))


def _joined(tables: Sequence[_Columns]) -> _Columns:
    """Tables of the same columns, one after another."""
    return type(tables[0])(*(torch.cat(parts) for parts in zip(*tables, strict=True)))


@torch.no_grad()
def answer_images(trained: TrainedPrior, images: Sequence[ObservedImage]) -> list[ObjectAnswer]:
    """Reconstruct images of the run's label set in one batch; answers do not depend on each other.

    For a class that the run never generates, objects of all classes are tried.
    """
    masks = _joined([outlines_of(image) for image in images])
    classes = torch.from_numpy(np.concatenate([image.object_class for image in images]))
    rough = candidates_of(trained)
    first = _of_classes(rough, classes)
    second = _promising(first, _placed(rough, first, masks).energy, len(classes))
    used, numbered = second.candidate.unique(return_inverse=True)
    shaped = _with_shapes(trained, _rows(rough, used))
    second = second._replace(candidate=numbered)
    placed = _placed(shaped, second, masks)
    picks, energies = [], []
    for mask in range(len(classes)):
        rows = (second.mask == mask).nonzero()[:, 0]
        sizes_m = _turned_sizes(shaped, _rows(second, rows))
        picks.append(rows[likeliest_box(_rows(placed, rows), sizes_m)])
        energies.append(placed.energy[rows].min())
    chosen, best = torch.stack(picks), torch.stack(energies)
    objects = _objects(trained, shaped, _rows(second, chosen), placed.centers_m[chosen])
    names = label_set(trained.config.label_set)
    known = {names[index] for index in rough.object_class.unique().tolist()}
    answers, at = [], 0
    for image in images:
        own = slice(at, at + len(image.object_class))
        labels = [names[index] for index in image.object_class]
        pairs = list(zip(labels, objects[own], strict=True))
        found = tuple(SceneObject(label, o.center_m, o.size_m, o.mesh) for label, o in pairs)
        scene = Scene(image.name, image.label_set, found)
        taken_for = {label: o.label for label, o in pairs if label not in known}
        answers.append(ObjectAnswer(scene, float(best[own].mean()), taken_for))
        at = own.stop
    return answers


def _of_classes(candidates: Candidates, classes: Int[Tensor, " masks"]) -> Guesses:
    """For each mask, `OF_CLASS` candidates of its class, in quarter turns 0 and 1."""
    generator = torch.Generator().manual_seed(0)
    shuffled = torch.randperm(len(candidates.room), generator=generator)
    parts = []
    for mask, index in enumerate(classes.tolist()):
        rows = shuffled[candidates.object_class[shuffled] == index][:OF_CLASS]
        rows = rows if len(rows) else shuffled[:OF_CLASS]
        parts.append(Guesses(torch.full_like(rows, mask), rows, torch.zeros_like(rows)))
    level = _joined(parts)
    return _joined([level, level._replace(quarter=level.quarter + 1)])


def _promising(guesses: Guesses, energy: Float[Tensor, " guesses"], masks: int) -> Guesses:
    """The guesses of least energy for each mask, and the same guesses turned by 180 degrees."""
    order = energy.argsort(stable=True)
    best = [order[guesses.mask[order] == mask][:PROMISING] for mask in range(masks)]
    level = _rows(guesses, torch.cat(best))
    return _joined([level, level._replace(quarter=level.quarter + QUARTERS // 2)])


def _turned_sizes(candidates: Candidates, guesses: Guesses) -> Float[Tensor, "guesses 3"]:
    return turn_vectors(candidates.sizes_m[guesses.candidate], guesses.quarter).abs()


def _placed(candidates: Candidates, guesses: Guesses, masks: Outlines) -> Placed:
    parts = []
    for rows in torch.arange(len(guesses.mask)).split(AT_ONCE):
        part = _rows(guesses, rows)
        points = turn_vectors(candidates.points[part.candidate], part.quarter)
        sizes_m, bottom_m = _turned_sizes(candidates, part), candidates.bottom_m[part.candidate]
        parts.append(place_objects(points, sizes_m, bottom_m, _rows(masks, part.mask)))
    return _joined(parts)


def likeliest_box(placed: Placed, sizes_m: Float[Tensor, "guesses 3"]) -> int:
    """Index of the guess whose box has the highest expected IoU with the true box."""
    likely = (-placed.energy).double().softmax(dim=0).numpy()
    centers_m, sizes = (part.double().numpy() for part in (placed.centers_m, sizes_m))
    return int((box_iou_3d(centers_m, sizes, centers_m, sizes) @ likely).argmax())


def _objects(
    trained: TrainedPrior,
    candidates: Candidates,
    chosen: Guesses,
    centers_m: Float[Tensor, "masks 3"],
) -> list[SceneObject]:
    """The chosen candidates, decoded, turned and moved to their centres."""
    objects: dict[tuple[int, int], SceneObject] = {}
    rooms, slots = candidates.room[chosen.candidate], candidates.slot[chosen.candidate]
    for room in rooms.unique():
        mine = slots[rooms == room].unique()
        decoded = _decode_some(trained, room[None], torch.zeros_like(mine), mine)
        scene = scene_of(trained, decoded, 0, mine.tolist(), "")
        pairs = zip(mine.tolist(), scene.objects, strict=True)
        objects |= {(int(room), slot): item for slot, item in pairs}
    found = []
    for room, slot, quarter, center_m in zip(
        rooms.tolist(), slots.tolist(), chosen.quarter.tolist(), centers_m.tolist(), strict=True
    ):
        item = turn_object(objects[room, slot], quarter)
        found.append(item.in_box(center_m, item.size_m))
    return found


def candidates_of(trained: TrainedPrior) -> Candidates:
    """All objects of the decoded training rooms, with beveled boxes as their shapes.

    Raises:
        InputError: all training rooms decode into empty rooms.
    """
    parts = []
    for rows in torch.arange(len(trained.logits)).split(ROOMS):
        decoded = trained.prior(trained.logits[rows], with_shape=False)
        object_class = decoded.class_logits.argmax(dim=-1)
        kept = kept_objects(decoded.completeness_logits, trained.config.model.completeness_target)
        room, slot = at = (kept & (object_class != VOID)).nonzero(as_tuple=True)
        sizes_m = decoded.sizes_m[at]
        bottom_m = decoded.centers_m[at][:, 1] - sizes_m[:, 1] / 2
        assert decoded.bevels is not None, "decode() gives every object bevels"
        points = beveled_cube(decoded.bevels[at]) / 2
        parts.append(Candidates(rows[room], slot, object_class[at], bottom_m, sizes_m, points))
    found = _joined(parts)
    if not len(found.room):
        raise InputError(
            f"The run decodes all its {len(trained.logits)} training rooms as empty rooms, so "
            "there are no objects to place where the masks are; train it longer, or fit a latent "
            "instead (--fit paper)."
        )
    return found


def _with_shapes(trained: TrainedPrior, candidates: Candidates) -> Candidates:
    """The candidates with points of their decoded shapes, the furthest in each of a few directions;
    unchanged before the shape stage."""
    if trained.stage == "layout" or not len(candidates.room):
        return candidates
    directions = icosphere(POINTS_LEVEL)[0].to(candidates.points)
    points = candidates.points.new_empty(len(candidates.room), len(directions), 3)
    for rooms in candidates.room.unique().split(ROOMS):
        mine = torch.isin(candidates.room, rooms).nonzero()[:, 0]
        at = torch.searchsorted(rooms, candidates.room[mine]), candidates.slot[mine]
        decoded = _decode_some(trained, rooms, *at)
        if decoded.vertices_m is not None:
            away = decoded.vertices_m[at] - decoded.centers_m[at].unsqueeze(1)
            surfaces = list(away / decoded.sizes_m[at].clamp(min=1e-6).unsqueeze(1))
        else:
            assert isinstance(decoded, PosedScenes) and decoded.looks is not None
            shapes = trained.prior.shape
            assert isinstance(shapes, PrototypeDecoder)
            meshes = [shapes.mesh(look, UNIT_BOX) for look in decoded.looks[at].tolist()]
            surfaces = [torch.from_numpy(mesh.vertices_m).to(directions) for mesh in meshes]
        points[mine] = torch.stack([s[(s @ directions.T).argmax(dim=0)] for s in surfaces])
    return candidates._replace(points=points)


def _decode_some(
    trained: TrainedPrior,
    rooms: Int[Tensor, " rooms"],
    row: Int[Tensor, " objects"],
    slot: Int[Tensor, " objects"],
) -> DecodedScenes:
    """Training rooms decoded with the shapes of some of their objects, once the shape stage has
    begun."""
    wanted = torch.zeros(len(rooms), int(slot.max()) + 1, dtype=torch.bool)
    wanted[row, slot] = True
    z = trained.prior.latent_space(trained.logits[rooms])
    return trained.prior.decode(z, trained.stage != "layout", wanted)
