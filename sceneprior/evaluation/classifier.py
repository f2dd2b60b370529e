"""Can a small classifier tell real rooms from generated ones? Features in, who was found out, out.

Scene classification accuracy (SCA): 0.5 where nobody can tell them apart, 1 where anybody can.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped

from sceneprior.evaluation.bootstrap import Figure, ratio

FOLDS = 5
REPEATS = 5
"""Times that folds are drawn, and as many rooms of the larger set as the smaller one has."""
INVERSE_PENALTY = 0.01
"""scikit-learn's C of the linear classifier, on standardized features: strong, because there are
often fewer rooms than features."""

Classify = Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray]
"""(training inputs, their 0/1 labels, inputs to judge, seed) -> 0/1 answers."""

SCA_LINEAR = (
    f"logistic regression (L2, C = {INVERSE_PENALTY}) on standardized features, {FOLDS}-fold, "
    f"{REPEATS} draws of folds and of as many rooms of the larger set as the smaller one has; "
    "interval: over rooms, the classifiers as they are"
)


@dataclass(frozen=True)
class FoundOut:
    """How often each room was judged, and rightly, by classifiers that never saw it."""

    right_generated: Int[np.ndarray, " n"]
    judged_generated: Int[np.ndarray, " n"]
    right_real: Int[np.ndarray, " m"]
    judged_real: Int[np.ndarray, " m"]

    def accuracy(self, counts_generated: np.ndarray, counts_real: np.ndarray) -> Figure:
        """The share of right answers, both sets with the same weight."""
        generated = ratio(self.right_generated, self.judged_generated, counts_generated)
        real = ratio(self.right_real, self.judged_real, counts_real)
        if generated.value is None or real.value is None:
            return Figure(None, np.zeros(0))
        both = min(len(generated.draws), len(real.draws))
        draws = (generated.draws[:both] + real.draws[:both]) / 2
        return Figure((generated.value + real.value) / 2, draws, 0.0, 1.0)


def found_out(
    generated: Shaped[np.ndarray, "n ..."],
    real: Shaped[np.ndarray, "m ..."],
    seed: int,
    classify: Classify | None = None,
    repeats: int = REPEATS,
) -> FoundOut:
    """Judge rooms by classifiers trained on the other folds.

    Both sets enter every training with the same number of rooms, so that always giving one answer
    is right half of the time.

    Args:
        generated: What is known of each generated room: features, or small pictures.
        real: The same of real rooms. At least two rows on either side.
        seed: Of the draws and folds.
        classify: None takes `linear`.
        repeats: How many times.
    """
    from sklearn.model_selection import StratifiedKFold

    classify = classify or linear
    smaller = min(len(generated), len(real))
    inputs = np.concatenate([generated, real])
    right, judged = np.zeros(len(inputs), dtype=int), np.zeros(len(inputs), dtype=int)
    for repeat in range(repeats):
        rng = np.random.default_rng([seed, repeat])
        rows = np.concatenate(
            [
                rng.permutation(len(generated))[:smaller],
                len(generated) + rng.permutation(len(real))[:smaller],
            ]
        )
        labels = np.repeat([1, 0], smaller)
        folds = StratifiedKFold(
            min(FOLDS, smaller), shuffle=True, random_state=int(rng.integers(2**31))
        )
        for number, (fit, judge) in enumerate(folds.split(rows, labels)):
            answers = classify(
                inputs[rows[fit]], labels[fit], inputs[rows[judge]], seed + FOLDS * repeat + number
            )
            right[rows[judge]] += answers == labels[judge]
            judged[rows[judge]] += 1
    n = len(generated)
    return FoundOut(right[:n], judged[:n], right[n:], judged[n:])


def linear(
    features: Float[np.ndarray, "rooms dimensions"],
    labels: Int[np.ndarray, " rooms"],
    judged: Float[np.ndarray, "others dimensions"],
    seed: int,
) -> Int[np.ndarray, " others"]:
    """Logistic regression on standardized features; `seed` changes nothing."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    model = make_pipeline(StandardScaler(), LogisticRegression(C=INVERSE_PENALTY, max_iter=300))
    model.fit(features.astype(np.float64), labels)
    return np.asarray(model.predict(judged.astype(np.float64)), dtype=int)
