"""Draw a set of rooms and keep what scores need: `Scene`s in, features and a hash out."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprior.evaluation.image_metrics import efficientnet_lite0_features, inception_features
from sceneprior.evaluation.topdown import TopDownProtocol, topdown
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene

_DRAWN_AT_ONCE = 16


@dataclass(frozen=True)
class SceneFeatures:
    """What is kept of a set of rooms' pictures; the pictures of 1,000 rooms would be 0.8 GB."""

    effnet_lite0: np.ndarray
    """(scenes, 1280) float32."""
    inception: np.ndarray | None
    """(scenes, 2048) float32, where the user gave the network."""
    sha256: str
    """Over the pictures' bytes, (height, width, 3) uint8 each, in the order of the scenes."""


def scene_features(
    scenes: Sequence[Scene],
    renderer: Renderer,
    protocol: TopDownProtocol,
    inception: Path | None = None,
    on_progress: Callable[[int], object] | None = None,
) -> SceneFeatures:
    """Draw scenes from above, a few at a time, and read each picture with the feature networks.

    Args:
        scenes: At least one.
        renderer: From `sceneprior.offscreen.open_renderer`.
        protocol: What a picture shows.
        inception: NVIDIA's TorchScript file, or None.
        on_progress: Called with the number of scenes just done.

    Raises:
        InputError: the Inception file is missing or something else.
    """
    digest = hashlib.sha256()
    effnet, other = [], []
    for start in range(0, len(scenes), _DRAWN_AT_ONCE):
        batch = scenes[start : start + _DRAWN_AT_ONCE]
        images = np.stack([topdown(scene, renderer, protocol) for scene in batch])
        digest.update(images.tobytes())
        effnet.append(efficientnet_lite0_features(images))
        if inception is not None:
            other.append(inception_features(images, inception))
        if on_progress is not None:
            on_progress(len(batch))
    return SceneFeatures(
        effnet_lite0=np.concatenate(effnet),
        inception=np.concatenate(other) if other else None,
        sha256=digest.hexdigest(),
    )
