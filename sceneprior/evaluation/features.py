"""Features and digests of the top-down pictures of a set of rooms."""

import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sceneprior.errors import InputError
from sceneprior.evaluation.networks import (
    efficientnet_lite0_features,
    inception_features,
    single_threaded,
)
from sceneprior.evaluation.topdown import TopDownProtocol, topdown
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene

_DRAWN_AT_ONCE = 8
SMALL_PX = 224
"""Side of the pictures that a classifier of pictures sees."""


@dataclass(frozen=True)
class SceneFeatures:
    """What is kept of a set of rooms' pictures; the pictures of 1,000 rooms would be 0.8 GB."""

    effnet_lite0: np.ndarray
    """(scenes, 1280) float32."""
    inception: np.ndarray | None
    """(scenes, 2048) float32, where the user gave the network."""
    small: np.ndarray | None
    """(scenes, 224, 224, 3) uint8 pictures, where a classifier wants them."""
    picture_sha256: np.ndarray
    """(scenes, 32) uint8: of the bytes of each (height, width, 3) uint8 picture."""

    @property
    def sha256(self) -> str:
        """Of the pictures' own digests, one after the other in the order of the scenes."""
        return hashlib.sha256(self.picture_sha256.tobytes()).hexdigest()

    def of(self, rows: Sequence[int]) -> "SceneFeatures":
        """The same of some of the rooms."""
        chosen = np.asarray(rows, dtype=np.int64)
        return _combine([self], lambda parts: parts[0][chosen])


def _combine(
    parts: Sequence[SceneFeatures], merge: Callable[[list[np.ndarray]], np.ndarray]
) -> SceneFeatures:
    """One array of each kind from those of the parts; what the parts lack stays None."""
    arrays: dict[str, Any] = {}
    for kind in fields(SceneFeatures):
        known = [getattr(part, kind.name) for part in parts]
        arrays[kind.name] = None if known[0] is None else merge(known)
    return SceneFeatures(**arrays)


def scene_features(
    scenes: Iterable[Scene],
    renderer: Renderer,
    protocol: TopDownProtocol,
    inception: Path | None = None,
    small: bool = False,
    on_progress: Callable[[int], object] | None = None,
) -> SceneFeatures:
    """Draw scenes from above, a few at a time, and read each picture with the feature networks.

    This thread draws, one thread for every processor reads; the bits do not depend on how many.

    Args:
        scenes: At least one; a stream is never held as a whole.
        inception: NVIDIA's TorchScript file, or None.
        small: Keep small pictures, too.
        on_progress: Called with the number of scenes just done.

    Raises:
        InputError: no scenes, or the Inception file is missing or something else.
    """
    parts: list[SceneFeatures] = []
    waiting: deque[Future[SceneFeatures]] = deque()
    stream = iter(scenes)

    def finish_first() -> None:
        parts.append(waiting.popleft().result())
        if on_progress is not None:
            on_progress(len(parts[-1].picture_sha256))

    with single_threaded(), ThreadPoolExecutor(_processors()) as pool:
        while batch := list(islice(stream, _DRAWN_AT_ONCE)):
            images = np.stack([topdown(scene, renderer, protocol) for scene in batch])
            waiting.append(pool.submit(_read, images, inception, small))
            if len(waiting) > _processors() + 1:  # pictures in memory, however many rooms
                finish_first()
        while waiting:
            finish_first()
    if not parts:
        raise InputError("There is no scene to draw; give at least one.")
    return _combine(parts, np.concatenate)


def _processors() -> int:
    # What this process may use, not what the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _read(
    images: UInt8[np.ndarray, "n height width 3"], inception: Path | None, small: bool
) -> SceneFeatures:
    digests = b"".join(hashlib.sha256(image.tobytes()).digest() for image in images)
    return SceneFeatures(
        effnet_lite0=efficientnet_lite0_features(images),
        inception=None if inception is None else inception_features(images, inception),
        small=np.stack([shrink(image) for image in images]) if small else None,
        picture_sha256=np.frombuffer(digests, dtype=np.uint8).reshape(-1, 32),
    )


def shrink(image: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "224 224 3"]:
    """A picture at `SMALL_PX`, with Pillow's antialiased triangle filter."""
    small = Image.fromarray(image).resize((SMALL_PX, SMALL_PX), Image.Resampling.BILINEAR)
    return np.asarray(small)
