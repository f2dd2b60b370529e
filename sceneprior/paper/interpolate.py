"""Interpolation between two latents (section 5.3): as scenes, a strip of pictures and an
animation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from sceneprior.core.classes import VOID, label_set
from sceneprior.core.files import write_whole
from sceneprior.core.repeatable import single_threaded
from sceneprior.core.scene import Scene
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import (
    DecodedRoom,
    Point,
    decode_rooms,
    kept_predictions,
    latent_of,
)
from sceneprior.render.appearance import contact_sheet, gif_bytes, png_bytes, quiet_colors
from sceneprior.render.topdown import corner_view, perspective

STEPS = 129
"""Number of points on a path at which shapes are decoded, to find the range in which each holds."""
TILE = (240, 320)
"""Height and width in pixels of a picture in the strip, and of the animation."""
STRIP_COLUMNS = 9
"""Pictures in a row of the strip."""
BETWEEN = 4
"""Number of pictures that the animation shows per step."""
FRAME_MS = 70
"""Duration of a picture of the animation in milliseconds."""
PAUSE_MS = 700
"""Pause of the animation at the first and the last picture, in milliseconds."""


@dataclass(frozen=True)
class RoomPath:
    """A path between two latents, and the rooms on it.

    The path is the geodesic on the sphere, or the straight line in the cube (`LatentCube`). Places
    on it are numbers from 0 to 1. At 0 and 1, the rooms are those that the two latents decode to.
    In between, shapes change gradually (`ShapeModule.along_path`). A room depends only on its
    place, not on how many rooms of the path are computed.
    """

    trained: TrainedPrior
    start: Float[Tensor, " dimension"]
    end: Float[Tensor, " dimension"]

    def latents(self, places: Float[Tensor, " rooms"]) -> Float[Tensor, "rooms dimension"]:
        """The latents at these places.

        Raises:
            InputError: the two ends are antipodal.
        """
        space = self.trained.prior.latent_space
        return space.between(self.start, self.end, places.to(self.start.dtype))

    def rooms(self, places: Float[Tensor, " rooms"], names: Sequence[str]) -> list[DecodedRoom]:
        """The rooms at these places."""

        def reshaped(decoded: DecodedScenes, rows: slice) -> DecodedScenes:
            return self.trained.prior.shape.along_path(decoded, places[rows], *self._decoded)

        return decode_rooms(self.trained, self.latents(places), names, reshaped)

    @cached_property
    def _decoded(self) -> tuple[DecodedScenes, Bool[Tensor, "steps objects"]]:
        """The path at `STEPS` equal steps, and which predictions are objects."""
        z = self.latents(even_places(STEPS))
        with torch.no_grad(), single_threaded():
            path = self.trained.prior.decode(z, with_shape=self.trained.stage != "layout")
        return path, kept_predictions(self.trained, path)


def even_places(steps: int) -> Float[Tensor, " steps"]:
    """Evenly spaced places on a path, including both ends."""
    return torch.linspace(0, 1, steps, dtype=torch.float64)


def interpolate(trained: TrainedPrior, start: Point, end: Point, steps: int) -> list[Scene]:
    """Rooms `step_00`, `step_01`, ... on the path from one latent to another.

    A room's `extra` holds `along`, its place from 0 to 1, and `slots`, the index of each object's
    prediction. Objects with the same slot in two rooms are the same object. `steps` includes both
    ends; `start` and `end` are anything that `latent_of` accepts.
    """
    path = RoomPath(trained, latent_of(trained, start), latent_of(trained, end))
    places = even_places(steps)
    ends = {
        key: point if isinstance(point, str) else getattr(point, "name", None) or "a latent"
        for key, point in (("from", start), ("to", end))
    }
    scenes = []
    rooms = path.rooms(places, [f"step_{k:02d}" for k in range(steps)])
    for along, room in zip(places.tolist(), rooms, strict=True):
        extra = {**ends, "along": round(along, 6), "slots": room.predictions}
        scenes.append(replace(room.scene, extra=extra))
    return scenes


def mixed_colors(room: DecodedRoom) -> UInt8[np.ndarray, "objects 3"]:
    """One colour per object: the mean of all class colours, weighted by the object's class
    probabilities, so that colours change as gradually as the room does."""
    share = room.class_logits.softmax(dim=-1).double().numpy()
    share[:, VOID] = 0
    # The most likely class of a decoded object is not void, so the sum is not 0.
    mixed = share @ quiet_colors(label_set(room.scene.label_set)).astype(np.float64)
    return np.rint(mixed / share.sum(axis=-1, keepdims=True)).astype(np.uint8)


def write_pictures(trained: TrainedPrior, scenes: Sequence[Scene], folder: Path) -> None:
    """Write `strip.png`, which shows `scenes` (the rooms of `interpolate`), and `animation.gif`,
    which has `BETWEEN` pictures per step and plays forwards and backwards in an endless loop."""
    start, end = (latent_of(trained, scene) for scene in (scenes[0], scenes[-1]))
    places = even_places((len(scenes) - 1) * BETWEEN + 1)
    rooms = RoomPath(trained, start, end).rooms(places, [""] * len(places))
    view = corner_view([room.scene for room in rooms], TILE)
    pictures = [perspective(room.scene, view=view, colors=mixed_colors(room)) for room in rooms]
    stills = pictures[::BETWEEN]
    sheet = contact_sheet(stills, min(STRIP_COLUMNS, len(stills)))
    write_whole(folder / "strip.png", png_bytes(sheet))
    times = [FRAME_MS] * len(pictures)
    times[0] = times[-1] = PAUSE_MS
    there_and_back = [*pictures, *pictures[-2:0:-1]]
    gif = gif_bytes(there_and_back, times + times[-2:0:-1])
    write_whole(folder / "animation.gif", gif)
