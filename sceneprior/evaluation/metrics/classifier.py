"""Scene classification accuracy (SCA) of a classifier that separates generated from real rooms.

It is 0.5 if the two sets are indistinguishable, and 1 if every room is classified correctly.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Int, Shaped
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import StratifiedKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from sceneprior.evaluation.alexnet import classify_pictures
from sceneprior.evaluation.bootstrap import Estimate, ratio
from sceneprior.evaluation.metric import PICTURED, Comparison, Metric, RoomSet, TableColumn

FOLDS = 5
REPEATS = 5
"""Repetitions, each with new folds and a new subset of the larger set, as large as the smaller
set."""
INVERSE_PENALTY = 0.01
"""scikit-learn's C of the linear classifier, on standardized features. A small C means strong
regularisation, which is needed because there are often fewer rooms than features."""

Classify = Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray]
"""(training inputs, their 0/1 labels, inputs to classify, seed) -> 0/1 answers."""


@dataclass(frozen=True)
class CrossValidated:
    """Numbers of all and of correct predictions for each room while it was held out."""

    right_generated: Int[np.ndarray, " n"]
    asked_generated: Int[np.ndarray, " n"]
    right_real: Int[np.ndarray, " m"]
    asked_real: Int[np.ndarray, " m"]

    def accuracy(self, counts_generated: np.ndarray, counts_real: np.ndarray) -> Estimate:
        """Share of correct predictions; both sets have the same weight."""
        generated = ratio(self.right_generated, self.asked_generated, counts_generated)
        return generated.mean_with(ratio(self.right_real, self.asked_real, counts_real))


def linear(
    features: Float[np.ndarray, "rooms dimensions"],
    labels: Int[np.ndarray, " rooms"],
    others: Float[np.ndarray, "others dimensions"],
    seed: int,
) -> Int[np.ndarray, " others"]:
    """Logistic regression on standardized features; `seed` is unused."""
    model = make_pipeline(StandardScaler(), LogisticRegression(C=INVERSE_PENALTY, max_iter=300))
    model.fit(features.astype(np.float64), labels)
    return np.asarray(model.predict(others.astype(np.float64)), dtype=int)


def cross_validated_predictions(
    generated: Shaped[np.ndarray, "n ..."],
    real: Shaped[np.ndarray, "m ..."],
    seed: int,
    classify: Classify = linear,
    repeats: int = REPEATS,
) -> CrossValidated:
    """Classify each room with a classifier trained on the other folds.

    The sets are features or small pictures, at least two rows each. Both contribute the same number
    of rooms to every training, so that a constant prediction has accuracy 0.5.
    """
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
    return CrossValidated(right[:n], asked[:n], right[n:], asked[n:])


def _accuracy(
    kind: str, rooms: RoomSet, comparison: Comparison, classify: Classify, repeats: int
) -> Estimate:
    test = comparison.test
    told = cross_validated_predictions(
        rooms.features(kind), test.features(kind), comparison.seed, classify, repeats
    )
    return told.accuracy(rooms.counts, test.counts)


def _linear(rooms: RoomSet, comparison: Comparison) -> Estimate:
    return _accuracy("effnet_lite0", rooms, comparison, linear, REPEATS)


def _alexnet(rooms: RoomSet, comparison: Comparison) -> Estimate:
    assert comparison.alexnet is not None  # the metric is computed only with `--alexnet`
    classify = partial(classify_pictures, comparison.alexnet)
    # One repetition, since each trains AlexNet five times for ten epochs, which takes minutes.
    return _accuracy("small", rooms, comparison, classify, repeats=1)


METRICS = (
    Metric("sca", "SCA (AlexNet)", "", "half", _alexnet, PICTURED, "alexnet"),
    Metric(
        "sca_effnet_lite0", "Classifier accuracy, EfficientNet-Lite0", "", "half", _linear,
        PICTURED, "effnet_lite0",
        protocol={
            "sca_effnet_lite0": f"logistic regression (L2, C = {INVERSE_PENALTY}) on standardized "
            f"features, {FOLDS}-fold, {REPEATS} repetitions with new folds and as many rooms of "
            "the larger set as the smaller one has; interval: over rooms, classifiers not retrained"
        },
        column=TableColumn(
            "SCA", 2, "SCA: accuracy of a classifier that separates generated and test rooms"
        ),
    ),
)  # fmt: skip
