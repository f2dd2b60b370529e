"""Batches of rooms (their views, decoded scenes, labelled boxes), and single images of rooms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int64, Integer
from torch import Tensor
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence

from sceneprior.core.cameras import camera_centers
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.observations import RoomViews, thinned
from sceneprior.core.repeatable import constants
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shards import iterate_rooms, splits_of

_B = TypeVar("_B", bound="Batch")
_Rooms = TypeVar("_Rooms", bound="RoomBoxes")


@dataclass(frozen=True)
class Batch:
    """Tensors that are moved and sliced together."""

    def changed(self: _B, change: Callable[[Tensor], Tensor]) -> _B:
        """Copy of the batch with `change` applied to every tensor."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(
            self, **{key: change(v) for key, v in values.items() if isinstance(v, Tensor)}
        )

    def to(self: _B, device: torch.device | str) -> _B:
        """Copy of the batch on `device` (called by Lightning)."""
        return self.changed(lambda tensor: tensor.to(device))


@dataclass(frozen=True)
class SceneViews(Batch):
    """Views of a batch of rooms; objects are padded to the largest room's count.

    Cameras are OpenCV pinholes (x right, y down, z forward); see docs/conventions.md.
    """

    room_index: Int[Tensor, " rooms"]
    """Row of each room in the data set, which is also the row of its latent vector; -1 for rooms
    that `padded` adds."""
    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding. The first n entries of a room with n tracked objects are true."""
    world_to_camera: Float[Tensor, "rooms views 4 4"]
    intrinsics: Float[Tensor, "rooms views 3 3"]
    """Intrinsics in pixels of an image of `image_size`."""
    boxes: Float[Tensor, "rooms views objects 4"]
    """2D boxes x1, y1, x2, y2 of the visible masks, relative to the image size, in [0, 1]."""
    visible: Bool[Tensor, "rooms views objects"]
    sides_clear: Bool[Tensor, "rooms views objects 4"]
    """Sides of the 2D boxes at which no other object touches the mask (x1, y1, x2, y2)."""
    image_size: tuple[int, int]
    """Height and width in pixels that `intrinsics` refer to."""
    instance_ids: Integer[Tensor, "rooms views height width"] | None = None
    """Downsampled images of ids: 0 for background, k + 1 for object k, n + 1 for void in a room of
    n objects. None except in the shape stage."""
    mask_step: int = 1
    """Step of `thinned` by which `instance_ids` are downsampled."""
    room_ids: tuple[str, ...] = ()

    @cached_property
    def object_counts(self) -> list[int]:
        """Number of tracked objects of each room."""
        return self.is_object.sum(dim=-1).tolist()

    @cached_property
    def object_places(self) -> tuple[Int[Tensor, " all"], Int[Tensor, " all"]]:
        """Indices (room, object) of all tracked objects."""
        room, item = self.is_object.nonzero(as_tuple=True)
        return room, item

    @cached_property
    def seen_places(self) -> tuple[Int[Tensor, " all"], Int[Tensor, " all"], Int[Tensor, " all"]]:
        """Indices (room, view, object) of all objects in the views in which they are visible."""
        seen = self.visible & self.is_object.unsqueeze(1)
        room, view, item = seen.nonzero(as_tuple=True)
        return room, view, item

    def to(self, device: torch.device | str) -> "SceneViews":
        """Copy of the batch on `device`, with the counts and places that are known already.

        A GPU waits for these copies, but the program does not; it would wait for a GPU to count.
        """
        device = torch.device(device)

        def moved(tensor: Tensor) -> Tensor:
            if device.type == "cuda" and tensor.device.type == "cpu":
                return tensor.pin_memory().to(device, non_blocking=True)
            return tensor.to(device)

        views, known = self.changed(moved), self.__dict__
        for name in ("object_places", "seen_places"):
            if name in known:
                views.__dict__[name] = tuple(map(moved, known[name]))
        if "object_counts" in known:
            views.__dict__["object_counts"] = known["object_counts"]
        return views

    def padded(self, rooms: int, objects: int) -> "SceneViews":
        """The batch with this number of rooms, and of objects per room.

        Rooms that are added have the views of the first room, without objects.
        """
        more_rooms, more = rooms - len(self.room_index), objects - self.is_object.shape[1]

        def filled(tensor: Tensor) -> Tensor:
            if not more_rooms:
                return tensor
            return torch.cat([tensor, tensor[:1].expand(more_rooms, *tensor.shape[1:])])

        return replace(
            self.changed(filled),
            room_index=F.pad(self.room_index, (0, more_rooms), value=-1),
            object_class=F.pad(self.object_class, (0, more, 0, more_rooms)),
            is_object=F.pad(self.is_object, (0, more, 0, more_rooms)),
            boxes=F.pad(self.boxes, (0, 0, 0, more, 0, 0, 0, more_rooms)),
            visible=F.pad(self.visible, (0, more, 0, 0, 0, more_rooms)),
            sides_clear=F.pad(self.sides_clear, (0, 0, 0, more, 0, 0, 0, more_rooms)),
        )

    @property
    def observed_ids(self) -> Integer[Tensor, "rooms views height width"]:
        """Instance-id images, for callers that need them."""
        if self.instance_ids is None:
            raise ValueError("These views have no instance ids; load the data with a mask_step.")
        return self.instance_ids

    @property
    def known_pixels(self) -> Bool[Tensor, "rooms views height width"]:
        """Pixels of the instance-id images that are not void."""
        objects = self.is_object.sum(dim=-1)
        return self.observed_ids <= objects[:, None, None, None]

    def mask_intrinsics(self, pooling: int = 1) -> Float[Tensor, "rooms views 3 3"]:
        """Intrinsics in pixels of the instance-id images (as `thinned_intrinsics`), or of images
        in which squares of `pooling` of these pixels are one."""
        step = self.mask_step
        shift = step / 2 - step // 2 - 0.5
        shifted = self.intrinsics + F.pad(
            constants(self.intrinsics, shift, shift, 0)[:, None], (2, 0)
        )
        return shifted / constants(self.intrinsics, step * pooling, step * pooling, 1)[:, None]


@dataclass(frozen=True)
class DecodedScenes:
    """A batch of decoded latents: N objects per room, in the order of generation."""

    class_logits: Float[Tensor, "rooms objects classes"]
    centers_m: Float[Tensor, "rooms objects 3"]
    """Box centres in the room frame; y already includes half the height."""
    sizes_m: Float[Tensor, "rooms objects 3"]
    """Full extents of the axis-aligned boxes."""
    completeness_logits: Float[Tensor, "rooms objects"]
    """Completeness before the sigmoid; see `kept_objects` in `paper/losses.py`."""
    bevels: Float[Tensor, "rooms objects 2"] | None = None
    """Bevels of the proxy `beveled_box` (`beveled_cube` in `core/proxies.py`); None for
    rooms that were not decoded by a prior."""
    vertices_m: Float[Tensor, "rooms objects vertices 3"] | None = None
    """Mesh vertices in the room frame; None before the shape decoder has run, and for
    methods without meshes."""


@dataclass(frozen=True)
class RoomBoxes(Batch):
    """A batch of rooms as labelled 3D boxes: the supervision and the output of methods that learn
    from boxes.

    Each room is padded to the batch's highest number of objects. The order of objects has no
    meaning.
    """

    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding; the first n entries of a room with n objects are true."""
    boxes_m: Float[Tensor, "rooms objects 6"]
    """Axis-aligned boxes in the room frame: centre x, y, z, then full extents along x, y, z."""
    room_ids: tuple[str, ...] = ()
    yaw_rad: Float[Tensor, "rooms objects"] | None = None
    """Rotation about +y that takes +z to each piece's front, in [-pi, pi]; None if unknown."""

    def split(self: _Rooms, rooms: int) -> list[_Rooms]:
        """Split into batches of at most `rooms` rooms, without ids."""

        def batch(start: int) -> _Rooms:
            part = self.changed(lambda tensor: tensor[start : start + rooms])
            return replace(part, room_ids=())

        return [batch(start) for start in range(0, len(self.is_object), rooms)]

    def only(self: _Rooms, here: Bool[Tensor, "rooms objects"]) -> _Rooms:
        """Copy that keeps the objects where `here` is true; the other slots become padding."""
        return replace(self, object_class=self.object_class * here, is_object=self.is_object & here)

    def take(self: _Rooms, order: Int[Tensor, "rooms slots"]) -> _Rooms:
        """Gather the slots of each room in the order of the indices `order`."""

        def taken(tensor: Tensor) -> Tensor:
            rows = order if tensor.ndim == 2 else order.unsqueeze(-1)
            return torch.take_along_dim(tensor, rows, dim=1)

        return self.changed(taken)

    def to_scenes(self, label_set_name: str, names: Sequence[str], first: int = 0) -> list[Scene]:
        """Scenes of boxes without meshes, from row `first` on; `extra` holds the objects' yaws, if
        they are known."""
        classes = label_set(label_set_name)
        scenes = []
        for row, name in enumerate(names, first):
            real = self.is_object[row]
            labels, boxes = self.object_class[row, real].tolist(), self.boxes_m[row, real].tolist()
            objects = tuple(
                SceneObject(classes[label], tuple(box[:3]), tuple(box[3:]))
                for label, box in zip(labels, boxes, strict=True)
            )
            yaw_rad = self.yaw_rad
            extra = {} if yaw_rad is None else {"yaw_rad": yaw_rad[row, real].tolist()}
            scenes.append(Scene(name, label_set_name, objects, extra=extra))
        return scenes


@dataclass(frozen=True)
class ObservedImage:
    """Camera and instance masks of one image with n visible objects; arrays as in `RoomViews`."""

    name: str
    """Stem of the names of output files for this image."""
    label_set: str
    object_class: Int64[np.ndarray, " n"]
    instance_ids: Integer[np.ndarray, "height width"]
    boxes: Float32[np.ndarray, "n 4"]
    sides_clear: Bool[np.ndarray, "n 4"]
    world_to_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    room_id: str = ""
    view: int = 0
    rows: tuple[int, ...] = ()
    """Indices of the objects among the room's tracked objects; () if there is no room."""

    @property
    def eye_m(self) -> Float[np.ndarray, "3"]:
        """Camera centre in the room frame."""
        return camera_centers(self.world_to_camera)

    def sampled_ids(self, step: int) -> Integer[np.ndarray, "rows columns"]:
        """Instance ids downsampled by `step`, as in training (`thinned`)."""
        return self.instance_ids[thinned(step)]


def image_of_room(room: RoomViews, view: int, label_set: str) -> ObservedImage:
    """Extract one view of a room, with only the objects that are visible in it.

    `room` must have been read with its images.
    """
    if not 0 <= view < (count := len(room.visible)):
        raise InputError(
            f"Room {room.room_id} has no view {view}; its {count} views are 0 to {count - 1}."
        )
    rows = np.flatnonzero(room.visible[view])
    if not len(rows):
        raise InputError(
            f"View {view} of room {room.room_id} shows no object, so there is nothing to "
            "reconstruct from; choose a view that does (`sceneprior inspect` shows them)."
        )
    assert room.instance_ids is not None, "read_room(images=True)"
    number = np.zeros(len(room.object_class) + 2, dtype=np.int32)
    number[rows + 1] = np.arange(1, len(rows) + 1)
    number[-1] = len(rows) + 1  # void
    return ObservedImage(
        name=f"{room.room_id.replace('/', '_')}_view{view}",
        label_set=label_set,
        object_class=room.object_class[rows].astype(np.int64),
        instance_ids=number[room.instance_ids[view]],
        boxes=room.boxes[view, rows],
        sides_clear=room.sides_clear[view, rows],
        world_to_camera=room.world_to_camera[view],
        intrinsics=room.intrinsics[view],
        room_id=room.room_id,
        view=view,
        rows=tuple(rows.tolist()),
    )


def image_from_shards(folder: Path, room_id: str, view: int) -> ObservedImage:
    """Read one view of a room, of any split."""
    found: list[str] = []
    for split in reversed(splits_of(folder)):
        for shard, name in iterate_rooms(folder, split):
            if name == room_id:
                return image_of_room(shard.read_room(name, images=True), view, shard.label_set)
            found.append(name)
    raise InputError(
        f"{folder} holds no room '{room_id}'; it has {len(found)} rooms"
        + (f", such as {', '.join(found[:3])}." if found else ".")
    )


def images_of_split(
    folder: Path, split: str, seed: int = 0, limit: int | None = None, views: int = 1
) -> tuple[list[ObservedImage], list[str]]:
    """Sample views of each room of a split from those that show an object.

    The sampled views of a room depend only on the seed and on the room's id. A larger `views` (the
    number of views per room) keeps these views and adds more.

    Returns:
        The images, and the ids of rooms left out because none of their views shows an object.
    """
    images: list[ObservedImage] = []
    blank: list[str] = []
    for shard, room_id in islice(iterate_rooms(folder, split), limit):
        useful = np.flatnonzero(shard.read_room(room_id).visible.any(axis=1))
        if not len(useful):
            blank.append(room_id)
            continue
        rng = np.random.default_rng([seed, *room_id.encode()])
        first = rng.choice(useful)
        drawn = [first, *rng.permutation(useful[useful != first])][:views]
        room = shard.read_room(room_id, images=True)
        images += [image_of_room(room, int(view), shard.label_set) for view in drawn]
    if not images:
        raise InputError(f"No view of the '{split}' rooms of {folder} shows an object.")
    return images, blank


def as_views(images: Sequence[ObservedImage], mask_step: int) -> SceneViews:
    """Stack images of one size into a batch: one room with one view each, padded to the largest
    object count."""
    sizes = sorted({image.instance_ids.shape for image in images})
    if len(sizes) > 1:
        raise InputError(
            f"Images that are fitted together must have one size, but these have {sizes[0]} and "
            f"{sizes[1]} pixels (height, width); reconstruct each size on its own."
        )

    def padded(rows: Sequence[np.ndarray]) -> Tensor:
        return pad_sequence([torch.from_numpy(row) for row in rows], batch_first=True)

    def stacked(matrices: Sequence[np.ndarray], dtype: type) -> Tensor:
        return torch.from_numpy(np.stack(matrices).astype(dtype)[:, None])

    is_object = padded([np.ones(len(image.object_class), bool) for image in images])
    return SceneViews(
        room_index=torch.arange(len(images)),
        object_class=padded([image.object_class for image in images]),
        is_object=is_object,
        world_to_camera=stacked([image.world_to_camera for image in images], np.float32),
        intrinsics=stacked([image.intrinsics for image in images], np.float32),
        boxes=padded([image.boxes for image in images])[:, None],
        visible=is_object[:, None],
        sides_clear=padded([image.sides_clear for image in images])[:, None],
        image_size=sizes[0],
        instance_ids=stacked([image.sampled_ids(mask_step) for image in images], np.int32),
        mask_step=mask_step,
        room_ids=tuple(image.name for image in images),
    )


def rows_of(
    views: SceneViews, rows: Integer[Tensor, " rows"] | Bool[Tensor, " rows"]
) -> SceneViews:
    """Select rooms of a batch, and trim the padding to the largest object count among them."""
    chosen = views.changed(lambda tensor: tensor[rows])
    most = max(int(chosen.is_object.sum(dim=-1).max()), 1)
    return replace(
        chosen,
        object_class=chosen.object_class[:, :most],
        is_object=chosen.is_object[:, :most],
        boxes=chosen.boxes[:, :, :most],
        visible=chosen.visible[:, :, :most],
        sides_clear=chosen.sides_clear[:, :, :most],
        room_ids=tuple(np.array(views.room_ids)[rows.numpy()]) if views.room_ids else (),
    )
