"""Renders top-down pictures of rooms, and computes network features of the pictures."""

import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sceneprior.core.classes import class_colors, label_set
from sceneprior.core.scene import Scene
from sceneprior.evaluation.alexnet import SIZE_PX
from sceneprior.evaluation.networks import (
    EFFNET_LITE0,
    INCEPTION,
    efficientnet_lite0,
    efficientnet_lite0_features,
    file_digest,
    inception_features,
    single_threaded,
)
from sceneprior.render.offscreen import SoftwareRenderer
from sceneprior.render.topdown import topdown, topdown_protocol

_DRAWN_AT_ONCE = 8

Features = dict[str, np.ndarray]
"""Features of a set of rooms' pictures, one row per room.

`effnet_lite0`: (rooms, 1280) float32; `inception`: (rooms, 2048) float32, if the user gave the
network; `small`: (rooms, 224, 224, 3) uint8 pictures, if AlexNet needs them; `picture_sha256`:
(rooms, 32) uint8, digest of the bytes of each (height, width, 3) uint8 picture. The full pictures
are not kept: 1,000 rooms would take 0.8 GB.
"""


@dataclass(frozen=True)
class Drawing:
    """Settings for rendering pictures and computing features, the same for every set of rooms."""

    label_set: str
    inception: Path | None = None
    """NVIDIA's TorchScript file."""
    small: bool = False
    """Keep 224-pixel copies of the pictures too, for AlexNet."""

    @cached_property
    def protocol(self) -> dict[str, Any]:
        """The drawing settings, for the result file."""
        return {
            **topdown_protocol(self.label_set).as_dict(),
            "projection": "orthographic, straight down; one flat colour per class; no floor",
            "class_colors": class_colors(len(label_set(self.label_set))).tolist(),
            "renderer": SoftwareRenderer.name,
        }

    @cached_property
    def networks(self) -> dict[str, Any]:
        """The feature networks, by the metric's key in the result."""
        fid = {} if self.inception is None else {"fid": INCEPTION | file_digest(self.inception)}
        return {"fd_effnet_lite0": EFFNET_LITE0, **fid}

    def features(
        self, scenes: Iterable[Scene], on_progress: Callable[[int], object] = lambda _: None
    ) -> Features:
        """Draw scenes from above, a few at a time, and compute the networks' features.

        The calling thread draws, and one thread per processor runs the networks; the features are
        bitwise the same for any number of threads. `on_progress` is called with the number of
        scenes just done.
        """
        protocol, stream = topdown_protocol(self.label_set), iter(scenes)
        parts: list[Features] = []
        waiting: deque[Future[Features]] = deque()
        # Count the processors that this process may use, not all of the machine's.
        known = hasattr(os, "sched_getaffinity")
        processors = len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1
        efficientnet_lite0()  # loaded once, before the threads start
        with single_threaded(), ThreadPoolExecutor(processors) as pool:
            while (batch := list(islice(stream, _DRAWN_AT_ONCE))) or waiting:
                if batch:
                    images = np.stack([topdown(scene, protocol) for scene in batch])
                    waiting.append(pool.submit(self._read, images))
                # The queue is bounded, so that few pictures are in memory at a time.
                if not batch or len(waiting) > processors + 1:
                    parts.append(waiting.popleft().result())
                    on_progress(len(parts[-1]["picture_sha256"]))
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _read(self, images: UInt8[np.ndarray, "n height width 3"]) -> Features:
        features = {"effnet_lite0": efficientnet_lite0_features(images)}
        if self.inception is not None:
            features["inception"] = inception_features(images, self.inception)
        if self.small:
            size, triangle = (SIZE_PX, SIZE_PX), Image.Resampling.BILINEAR  # antialiased
            small = [Image.fromarray(image).resize(size, triangle) for image in images]
            features["small"] = np.stack([np.asarray(image) for image in small])
        digests = b"".join(hashlib.sha256(image.tobytes()).digest() for image in images)
        return features | {"picture_sha256": np.frombuffer(digests, np.uint8).reshape(-1, 32)}
