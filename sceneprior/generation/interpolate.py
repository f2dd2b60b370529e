"""Two latents in, the rooms on the geodesic between them out: scenes, a strip, an animation."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from sceneprior.classes import VOID, class_colors, label_set
from sceneprior.errors import InputError
from sceneprior.evaluation.topdown import CornerView, corner_view, perspective
from sceneprior.files import write_whole
from sceneprior.generation.decode import BATCH, furnished_slots, to_scenes
from sceneprior.generation.latents import read_latent
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene
from sceneprior.training.method import TrainedPrior

TILE = (240, 320)
"""Height and width of a step in the strip and of the animation, in pixels."""
STRIP_COLUMNS = 9
BETWEEN = 4
"""Pictures of the animation from one step to the next."""
FRAME_MS = 70
PAUSE_MS = 700
"""At both ends, where the animation turns round."""


@dataclass(frozen=True)
class PathRoom:
    """A room on the way, its objects known by the prediction they come from."""

    scene: Scene
    slots: tuple[int, ...]
    """Which of the N predictions each object is: the same object in the next room."""
    colors: UInt8[np.ndarray, "objects 3"]
    """The classes' colours, mixed by their probabilities: they change as gradually as the room."""


def interpolate(
    trained: TrainedPrior, start: str, end: str, steps: int
) -> tuple[Float[Tensor, "steps dimension"], list[Scene]]:
    """Latents from one end to the other, and their rooms `step_00`, `step_01`, ...

    `extra` says how far along a room is, and in `slots` which prediction each object comes from:
    what has the same slot in two rooms is the same object, moved.

    Args:
        trained: The run's prior.
        start, end: As `read_latent` reads them.
        steps: Rooms, both ends included; at least 2.

    Raises:
        InputError: an end is unknown, or the two are opposite.
    """
    z = path_latents(trained, read_latent(trained, start), read_latent(trained, end), steps)
    scenes = []
    for step, room in enumerate(decode_path(trained, z, [f"step_{k:02d}" for k in range(steps)])):
        along = round(step / (steps - 1), 6)
        extra = {"from": start, "to": end, "along": along, "slots": list(room.slots)}
        scenes.append(replace(room.scene, extra=extra))
    return z, scenes


def path_latents(
    trained: TrainedPrior,
    start: Float[Tensor, " dimension"],
    end: Float[Tensor, " dimension"],
    steps: int,
) -> Float[Tensor, "steps dimension"]:
    """Points evenly along the geodesic (in a cube: the straight line), both ends included.

    Raises:
        InputError: the ends are opposite points of the sphere.
    """
    along = torch.linspace(0, 1, steps, dtype=start.dtype)
    try:
        space = trained.prior.latent_space
        return space.between(start.expand(steps, -1), end.expand(steps, -1), along)
    except ValueError:
        raise InputError(
            "The two ends are opposite points of the sphere, and every great circle leads from "
            "one to the other; choose another end, or go by way of a third room."
        ) from None


@torch.no_grad()
def decode_path(
    trained: TrainedPrior, z: Float[Tensor, "steps dimension"], names: list[str]
) -> list[PathRoom]:
    """The rooms of latents on a path, with each object's prediction and mixed colour."""
    config, target = trained.config, trained.config.model.completeness_target
    palette = class_colors(len(label_set(config.label_set))).astype(np.float64)
    rooms: list[PathRoom] = []
    for start in range(0, len(z), BATCH):
        part = slice(start, start + BATCH)
        decoded = trained.prior.decode(z[part], with_shape=trained.stage != "layout")
        scenes = to_scenes(
            decoded, trained.prior.shape.faces, config.label_set, names[part], target
        )
        share = decoded.class_logits.softmax(dim=-1).double().numpy()
        share[..., VOID] = 0
        for row, slots in enumerate(furnished_slots(decoded, target)):
            # An object's likeliest class is not void, so something is left to divide by.
            mixed = share[row, slots] @ palette / share[row, slots].sum(axis=-1, keepdims=True)
            colors = np.rint(mixed).astype(np.uint8)
            rooms.append(PathRoom(scenes[row], tuple(slots), colors))
    return rooms


def strip(
    rooms: Sequence[PathRoom], view: CornerView, renderer: Renderer
) -> UInt8[np.ndarray, "height width 3"]:
    """The rooms side by side from one view, in rows of nine."""
    height, width = view.image_size
    columns = min(STRIP_COLUMNS, len(rooms))
    lines = -(-len(rooms) // columns)
    sheet = np.full((lines * height, columns * width, 3), 255, dtype=np.uint8)
    for index, room in enumerate(rooms):
        line, column = divmod(index, columns)
        tile = perspective(room.scene, renderer, view=view, colors=room.colors)
        sheet[line * height :, column * width :][:height, :width] = tile
    return sheet


def animation(rooms: Sequence[PathRoom], view: CornerView, renderer: Renderer) -> bytes:
    """A GIF that goes along the rooms and back, for ever, from one view."""
    pictures = [
        Image.fromarray(perspective(room.scene, renderer, view=view, colors=room.colors))
        for room in rooms
    ]
    # One palette for all pictures: with one each, plain areas would shimmer.
    samples = Image.fromarray(np.concatenate([np.asarray(image) for image in pictures]))
    palette = samples.quantize(255, dither=Image.Dither.NONE)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in pictures]
    times = [FRAME_MS] * len(frames)
    times[0] = times[-1] = PAUSE_MS
    frames, times = frames + frames[-2:0:-1], times + times[-2:0:-1]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, format="GIF", save_all=True, append_images=frames[1:], duration=times, loop=0,
        optimize=False,
    )  # fmt: skip
    return buffer.getvalue()


def write_pictures(
    trained: TrainedPrior,
    path: Float[Tensor, "steps dimension"],
    folder: Path,
    renderer: Renderer,
) -> None:
    """Write `strip.png` of the steps and `animation.gif`, which has pictures between them, too."""
    many = (len(path) - 1) * BETWEEN + 1
    z = path_latents(trained, path[0], path[-1], many)
    rooms = decode_path(trained, z, [f"frame_{k:03d}" for k in range(many)])
    view = corner_view([room.scene for room in rooms], TILE)
    buffer = io.BytesIO()
    Image.fromarray(strip(rooms[::BETWEEN], view, renderer)).save(buffer, format="PNG")
    write_whole(folder / "strip.png", buffer.getvalue())
    write_whole(folder / "animation.gif", animation(rooms, view, renderer))
