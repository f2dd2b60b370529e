"""Network inputs for each mask of an image, in the image's frame.

That frame is the room's, moved to the camera and turned by quarters until the camera looks along +z
to within 45 degrees. So inputs and predictions do not change if the room is moved or turned by
quarters, and boxes stay axis-aligned.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS, turn_vectors
from sceneprior.core.cameras import camera_centers
from sceneprior.core.views import SceneViews

CROP = 32
"""Pixels along each side of a crop."""
MARGIN = 0.25
"""Border of a crop on each side of its 2D box, as a share of the box's width or height."""
CHANNELS = 6
"""Channels of a crop: the mask, all other masks (including void), whether the pixel is inside the
image, and the pixel's ray (3)."""
NUMBERS = 26
"""Number of inputs per mask in addition to its crop and class; see `Detections.numbers`."""
NEAR_M = 0.1
"""Minimum depth of a centre that is projected into the image."""


@dataclass(frozen=True)
class Detections:
    """The visible masks of a batch of images, one per row, image after image.

    Every view of every room is an image.
    """

    views: SceneViews
    image: Int[Tensor, " masks"]
    slot: Int[Tensor, " masks"]
    """Index of the mask within its image."""
    room: Int[Tensor, " masks"]
    view: Int[Tensor, " masks"]
    item: Int[Tensor, " masks"]
    """Index of the mask's object in the room."""
    object_class: Int[Tensor, " masks"]
    boxes: Float[Tensor, "masks 4"]
    """2D boxes in the format of `SceneViews`, relative to the image."""
    quarter: Int[Tensor, " masks"]
    """Number of quarter turns from the room into the image's frame."""
    eye_m: Float[Tensor, "masks 3"]
    """Camera position in the room."""
    frame_to_camera: Float[Tensor, "masks 3 3"]
    intrinsics: Float[Tensor, "masks 3 3"]
    """Intrinsics in units of the image's width and height."""

    def __len__(self) -> int:
        return len(self.image)

    @property
    def numbers(self) -> Float[Tensor, "masks numbers"]:
        """The 2D box (4), the logs of its width and height (2), its sides that no other object
        touches (4), the rays through its centre and corners (15), and the camera's height (1)."""
        x1, y1, x2, y2 = self.boxes.unbind(dim=-1)
        corners = [((x1 + x2) / 2, (y1 + y2) / 2), (x1, y1), (x2, y1), (x1, y2), (x2, y2)]
        rays = self.rays(torch.stack([torch.stack(place, dim=-1) for place in corners], dim=1))
        sides = (self.boxes[:, 2:] - self.boxes[:, :2]).clamp(min=1e-3).log()
        clear = self.views.sides_clear[self.room, self.view, self.item].to(sides)
        return torch.cat([self.boxes, sides, clear, rays.flatten(1), self.eye_m[:, 1:2]], dim=-1)

    @property
    def crops(self) -> Float[Tensor, "masks channels rows columns"]:
        """Each 2D box with its border, stretched to a square of `CROP` pixels; see `CHANNELS`."""
        ids = self.views.observed_ids[self.room, self.view]
        steps = (torch.arange(CROP, device=ids.device) + 0.5) / CROP
        steps = steps * (1 + 2 * MARGIN) - MARGIN
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 2:]
        place = low + steps[:, None] * (high - low)  # masks, steps, (u, v)
        u, v = (
            part.expand(-1, CROP, CROP) for part in (place[:, None, :, 0], place[:, :, None, 1])
        )
        inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        height, width = ids.shape[1:]
        column = (u * width).long().clamp(0, width - 1)
        row = (v * height).long().clamp(0, height - 1)
        seen = ids[torch.arange(len(ids), device=ids.device)[:, None, None], row, column].long()
        seen = seen * inside
        own = seen == self.item[:, None, None] + 1
        rays = self.rays(torch.stack([u, v], dim=-1).flatten(1, 2)).unflatten(1, (CROP, CROP))
        masks = torch.stack([own, (seen > 0) & ~own, inside], dim=1).to(rays)
        return torch.cat([masks, rays.movedim(-1, 1)], dim=1)

    def rays(self, places: Float[Tensor, "masks points 2"]) -> Float[Tensor, "masks points 3"]:
        """Unit vectors from the camera through places (u, v), in the image's frame."""
        focal = self.intrinsics[:, None, (0, 1), (0, 1)]
        middle = self.intrinsics[:, None, :2, 2]
        on_plane = (places - middle) / focal
        rays = torch.cat([on_plane, torch.ones_like(on_plane[..., :1])], dim=-1)
        return torch.nn.functional.normalize(rays @ self.frame_to_camera, dim=-1)

    def centers_at(
        self, offsets: Float[Tensor, "masks 2"], distances_m: Float[Tensor, " masks"]
    ) -> Float[Tensor, "masks 3"]:
        """Centres in the room, from their distances to the camera, and the offsets from the middle
        of the 2D box to the projected centre in units of the 2D box's width and height."""
        low, high = self.boxes.split(2, dim=-1)
        place = (low + high) / 2 + offsets * (high - low)
        away = self.rays(place.unsqueeze(1))[:, 0] * distances_m.unsqueeze(-1)
        return self.to_room(away) + self.eye_m

    def offsets_and_distances(
        self, centers_m: Float[Tensor, "masks 3"]
    ) -> tuple[Float[Tensor, "masks 2"], Float[Tensor, " masks"], Bool[Tensor, " masks"]]:
        """The inverse of `centers_at`; the third result is True for centres in front of the camera.

        The offsets of centres behind the camera are 0.
        """
        away = self.to_frame(centers_m - self.eye_m)
        seen = (self.frame_to_camera @ away.unsqueeze(-1))[..., 0]
        ahead = seen[:, 2] > NEAR_M
        scaled = (self.intrinsics @ seen.unsqueeze(-1))[..., 0]
        place = scaled[:, :2] / scaled[:, 2:].clamp(min=NEAR_M)
        low, high = self.boxes.split(2, dim=-1)
        offsets = (place - (low + high) / 2) / (high - low).clamp(min=1e-3)
        return offsets * ahead.unsqueeze(-1), away.norm(dim=-1), ahead

    def to_frame(self, vectors: Float[Tensor, "masks *many 3"]) -> Float[Tensor, "masks *many 3"]:
        """Rotate directions from the room frame into the images' frames."""
        return turn_vectors(vectors, self.quarter)

    def to_room(self, vectors: Float[Tensor, "masks *many 3"]) -> Float[Tensor, "masks *many 3"]:
        """Rotate directions from the images' frames into the room frame."""
        return turn_vectors(vectors, (QUARTERS - self.quarter) % QUARTERS)

    def padded(self, values: Float[Tensor, "masks width"]) -> Float[Tensor, "images most width"]:
        """Values by image and mask, padded with zeros to the largest number of masks."""
        images = int(self.image.max()) + 1 if len(self) else 0
        most = int(self.slot.max()) + 1 if len(self) else 0
        empty = values.new_zeros(images, most, values.shape[-1])
        return empty.index_put((self.image, self.slot), values)

    def of_objects(self, values: Tensor, rooms: int, objects: int) -> Tensor:
        """Values by room and object, (rooms, objects, ...), for a single view per room; 0 for
        objects without a mask."""
        empty = values.new_zeros(rooms, objects, *values.shape[1:])
        return empty.index_put((self.room, self.item), values)


def some_views(views: SceneViews, part: slice) -> SceneViews:
    """The batch, reduced to the views `part` of each room."""
    return replace(
        views,
        world_to_camera=views.world_to_camera[:, part],
        intrinsics=views.intrinsics[:, part],
        boxes=views.boxes[:, part],
        visible=views.visible[:, part],
        sides_clear=views.sides_clear[:, part],
        instance_ids=views.observed_ids[:, part],
    )


def detections_of(views: SceneViews) -> Detections:
    """The visible masks of all views."""
    room, view, item = views.visible.nonzero(as_tuple=True)
    image = room * views.visible.shape[1] + view
    counts = image.bincount(minlength=1)
    slot = torch.arange(len(image), device=image.device) - (counts.cumsum(0) - counts)[image]
    poses = views.world_to_camera[room, view]
    forward = poses[:, 2, :3]
    yaw = torch.atan2(forward[:, 0], forward[:, 2])
    quarter = torch.remainder(-torch.round(yaw / (math.pi / 2)).long(), QUARTERS)
    height, width = views.image_size
    scale = views.intrinsics.new_tensor([[1 / width], [1 / height], [1.0]])
    return Detections(
        views=views,
        image=image,
        slot=slot,
        room=room,
        view=view,
        item=item,
        object_class=views.object_class[room, item],
        boxes=views.boxes[room, view, item],
        quarter=quarter,
        eye_m=camera_centers(poses),
        frame_to_camera=turn_vectors(poses[:, :3, :3], quarter),
        intrinsics=views.intrinsics[room, view] * scale,
    )
