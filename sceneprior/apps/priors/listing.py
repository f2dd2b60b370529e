"""The list of the shipped priors: what each draws, learnt from and scores, from its file."""

import re
from pathlib import Path

import numpy as np

from sceneprior.apps.priors.packed import PackedPrior, drawn_classes, read_packed

SCORES = {
    "rooms_without_fault": "rooms without a fault of function",
    "layout_classifier_accuracy": "layout classifier, 0.5 is best",
    "near_copy_share": "near copies",
}
"""Metrics of the list, with their names there."""
RANGE = 0.05, 0.95
"""Quantiles of the floors that the list names."""


def listing(name: str, path: Path) -> str:
    """A few lines on a packed prior with a sampler."""
    packed = read_packed(path)
    low, high = np.quantile(floor_areas_m2(packed), RANGE)
    room_type = packed.said.settings["label_set"].removeprefix("front3d_")
    lines = {
        "rooms": f"{room_type}; floors of {low:.0f} to {high:.0f} square metres",
        "trained on": f"{packed.said.training_rooms:,} rooms",
        "classes": ", ".join(drawn_classes(packed)),
        "scores": "; ".join(scores_of(packed.card)) or "not measured",
        "licence": licence_of(packed.card),
    }
    told = "".join(f"\n  {key}: {value}" for key, value in lines.items())
    return f"{name} ({path.stat().st_size / 1e6:.1f} MB){told}"


def floor_areas_m2(packed: PackedPrior, count: int = 4000) -> np.ndarray:
    """Areas of floors drawn from the sampler's mixture of rectangles; their logarithms are normal
    within a component."""
    logits, means, factors = (
        packed.tensors[f"sampler.rectangle_{name}"].double().numpy()
        for name in ("logits", "means", "factors")
    )
    generator = np.random.default_rng(0)
    shares = np.exp(logits - logits.max())
    which = generator.choice(len(shares), size=count, p=shares / shares.sum())
    deviations = np.linalg.norm(factors[:, 2:].sum(axis=1), axis=1)
    drawn = generator.standard_normal(count)
    return np.exp(means[which, 2:].sum(axis=1) + deviations[which] * drawn)


def scores_of(card: str) -> list[str]:
    """The values of `SCORES` in a card's table, with their intervals."""
    from sceneprior.evaluation.metrics import METRICS  # its networks take seconds to import

    found = []
    for metric in METRICS:
        title = re.escape(metric.title)
        row = re.search(rf"(?m)^\| {title} \([^|]*\| ([^|,]+)(?:, ([^|]+))? \|", card)
        if metric.key in SCORES and row:
            interval = f" ({row[2].strip()})" if row[2] else ""
            found.append(f"{SCORES[metric.key]} {row[1].strip()}{interval}")
    return found


def licence_of(card: str) -> str:
    """The sentence of a card on the licence of the file."""
    section = card.partition("## Data, authors and licence")[2].partition("\n## ")[0]
    for sentence in re.split(r"(?<=\.)\s|\n- ", section):
        if "this file" in sentence and re.search("licence|CC-", sentence):
            return " ".join(sentence.replace("**", "").removeprefix("- ").split())
    return "see the card"
