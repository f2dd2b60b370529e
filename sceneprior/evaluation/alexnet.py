"""The paper's classifier of generated and real pictures: a fine-tuned AlexNet."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor, nn

from sceneprior.core.errors import InputError

SIZE_PX = 224
EPOCHS = 10
LEARNING_RATE = 1e-4
BATCH = 256
ALEXNET: dict[str, Any] = {
    "name": "AlexNet, ImageNet weights of the user's file, convolutions and one new linear layer, "
    "all fine-tuned",
    "input": f"{SIZE_PX} x {SIZE_PX} RGB, bilinear with antialiasing, ImageNet mean and deviation",
    "epochs": EPOCHS,
    "learning_rate": LEARNING_RATE,
    "batch": BATCH,
}
"""Training settings of SCA with AlexNet, for the result file."""

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def check_alexnet(path: Path) -> None:
    """Raise InputError if the file is missing or does not hold AlexNet's weights."""
    _weights(path)


def classify_pictures(
    path: Path,
    pictures: UInt8[np.ndarray, "rooms 224 224 3"],
    labels: Int[np.ndarray, " rooms"],
    others: UInt8[np.ndarray, "others 224 224 3"],
    seed: int,
) -> Int[np.ndarray, " others"]:
    """Fine-tune AlexNet on labelled pictures and classify others, on a GPU if there is one.

    Weights differ between processors in their last digits, so a picture near the decision boundary
    may be classified differently on another machine. Labels are 1 for generated, 0 for real.

    Source:
        ATISS (Paschalidou et al., NeurIPS 2021), whose classifier the paper uses.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    # The random state is forked, so that the caller's random numbers do not depend on this call.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network(_weights(path)).to(device)
    order = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    for _ in range(EPOCHS):
        rows = order.permutation(len(pictures))
        for start in range(0, len(rows), BATCH):
            batch = rows[start : start + BATCH]
            target = torch.as_tensor(labels[batch], dtype=torch.float32, device=device)
            logits = network(_input(pictures[batch], device))[:, 0]
            loss = nn.functional.binary_cross_entropy_with_logits(logits, target)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    with torch.no_grad():
        answers = [
            network(_input(others[start : start + BATCH], device))[:, 0].cpu().numpy() > 0
            for start in range(0, len(others), BATCH)
        ]
    return np.concatenate(answers).astype(int)


def _input(pictures: np.ndarray, device: torch.device) -> Tensor:
    images = torch.from_numpy(pictures).to(device).permute(0, 3, 1, 2).float() / 255
    mean, deviation = torch.tensor((_MEAN, _DEVIATION), device=device)[..., None, None]
    return (images - mean) / deviation


def _convolutions() -> nn.Sequential:
    """torchvision's `features`; the layers' indices are the names in its state dict."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


def _network(weights: dict[str, Tensor]) -> nn.Sequential:
    convolutions = _convolutions()
    convolutions.load_state_dict(weights)
    return nn.Sequential(
        *convolutions, nn.AdaptiveAvgPool2d(6), nn.Flatten(), nn.Linear(256 * 36, 1)
    )


@lru_cache(maxsize=1)
def _weights(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise InputError(
            f"No AlexNet at {path}. The paper's SCA needs torchvision's file "
            "`alexnet-owt-7be5be79.pth`. If you do not have it, leave the option out: "
            "sca_effnet_lite0 needs no download."
        )
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        with torch.device("meta"):  # shapes alone, no random initialisation
            expected = _convolutions().state_dict()
        weights = {name: state[f"features.{name}"] for name in expected}
        for name, tensor in weights.items():
            if tensor.shape != expected[name].shape:
                raise ValueError(f"features.{name} has shape {tuple(tensor.shape)}")
    except Exception as error:  # a damaged file raises almost anything in torch.load
        reason = str(error).strip().splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(
            f"{path} is not the state dict of torchvision's AlexNet ({reason}); give "
            "`alexnet-owt-7be5be79.pth`, or leave the option out."
        ) from None
    return weights
