"""Accuracy of classifiers that separate pictures of generated and of real rooms (SCA): logistic
regression on features, and the paper's fine-tuned AlexNet.

It is 0.5 if the two sets are indistinguishable, and 1 if every room is classified correctly.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor, nn

from sceneprior.core.errors import InputError, cause_of
from sceneprior.evaluation.features import SIZE_PX
from sceneprior.evaluation.metric import (
    PICTURED,
    Comparison,
    Estimate,
    RoomSet,
    TableColumn,
    mean_of_shares,
    metric,
    ratio,
)

FOLDS = 5
REPEATS = 5
"""Repetitions, each with new folds and a new subset of the larger set, as large as the smaller
set."""
INVERSE_PENALTY = 0.01
"""scikit-learn's C of the linear classifier, on standardized features. A small C means strong
regularisation, which is needed because there are often fewer rooms than features."""

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

Classify = Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray]
"""(training inputs, their 0/1 labels, inputs to classify, seed) -> 0/1 answers."""


def linear(
    features: Float[np.ndarray, "rooms dimensions"],
    labels: Int[np.ndarray, " rooms"],
    others: Float[np.ndarray, "others dimensions"],
    seed: int,
) -> Int[np.ndarray, " others"]:
    """Logistic regression on standardized features; `seed` is unused."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    model = make_pipeline(StandardScaler(), LogisticRegression(C=INVERSE_PENALTY, max_iter=300))
    model.fit(features.astype(np.float64), labels)
    return np.asarray(model.predict(others.astype(np.float64)), dtype=int)


def cross_validated_predictions(
    generated: Shaped[np.ndarray, "n ..."],
    real: Shaped[np.ndarray, "m ..."],
    seed: int,
    classify: Classify,
    repeats: int,
) -> tuple[Int[np.ndarray, " rooms"], Int[np.ndarray, " rooms"]]:
    """Numbers of correct and of all predictions for each room, generated rooms first, by
    classifiers trained on the other folds.

    The sets are features or small pictures, at least two rows each. Both contribute the same number
    of rooms to every training, so that a constant prediction has accuracy 0.5.
    """
    from sklearn.model_selection import StratifiedKFold

    n, smaller = len(generated), min(len(generated), len(real))
    inputs = np.concatenate([generated, real])
    right, asked = np.zeros(len(inputs), dtype=int), np.zeros(len(inputs), dtype=int)
    labels = np.repeat([1, 0], smaller)
    for repeat in range(repeats):
        rng = np.random.default_rng([seed, repeat])
        chosen = [rng.permutation(len(group))[:smaller] for group in (generated, real)]
        rows = np.concatenate([chosen[0], n + chosen[1]])
        folds = StratifiedKFold(
            min(FOLDS, smaller), shuffle=True, random_state=int(rng.integers(2**31))
        )
        for number, (train, held_out) in enumerate(folds.split(rows, labels)):
            others = rows[held_out]
            fold_seed = seed + FOLDS * repeat + number
            answers = classify(inputs[rows[train]], labels[train], inputs[others], fold_seed)
            right[others] += answers == labels[held_out]
            asked[others] += 1
    return right, asked


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
        weights, convolutions = alexnet_weights(path), _convolutions()
        convolutions.load_state_dict(weights)
        parts = *convolutions, nn.AdaptiveAvgPool2d(6), nn.Flatten(), nn.Linear(256 * 36, 1)
        network = nn.Sequential(*parts).to(device)
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


@lru_cache(maxsize=1)
def alexnet_weights(path: Path) -> dict[str, Tensor]:
    """The weights of AlexNet's convolutions in a file of torchvision's, refused if it is another
    file."""
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
        raise InputError(
            f"{path} is not the state dict of torchvision's AlexNet ({cause_of(error)}); give "
            "`alexnet-owt-7be5be79.pth`, or leave the option out."
        ) from None
    return weights


def _accuracy(
    kind: str, rooms: RoomSet, comparison: Comparison, classify: Classify, repeats: int
) -> Estimate:
    test = comparison.test
    right, asked = cross_validated_predictions(
        rooms.pictures[kind], test.pictures[kind], comparison.seed, classify, repeats
    )
    n = len(rooms.scenes)
    # Both sets have the same weight.
    generated = ratio(right[:n], asked[:n], rooms.counts)
    return mean_of_shares(generated, ratio(right[n:], asked[n:], test.counts))


@metric("sca", "SCA (AlexNet)", "", "half", PICTURED, "alexnet")
def _alexnet(rooms: RoomSet, comparison: Comparison) -> Estimate:
    assert comparison.alexnet is not None  # the metric is computed only with `--alexnet`
    classify = partial(classify_pictures, comparison.alexnet)
    # One repetition, since each trains AlexNet five times for ten epochs, which takes minutes.
    return _accuracy("small", rooms, comparison, classify, repeats=1)


@metric(
    "sca_effnet_lite0", "Classifier accuracy, EfficientNet-Lite0", "", "half", PICTURED,
    "effnet_lite0",
    protocol=f"logistic regression (L2, C = {INVERSE_PENALTY}) on standardized "
    f"features, {FOLDS}-fold, {REPEATS} repetitions with new folds and as many rooms of "
    "the larger set as the smaller one has; interval: over rooms, classifiers not retrained",
    column=TableColumn(
        "SCA", 2, "SCA: accuracy of a classifier that separates generated and test rooms"
    ),
)  # fmt: skip
def _linear(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return _accuracy("effnet_lite0", rooms, comparison, linear, REPEATS)
