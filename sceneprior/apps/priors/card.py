"""The card of a packed prior: training data, scores and limitations."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from sceneprior import __version__
from sceneprior.apps.priors.packed import shared_settings
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.shards import INDEX_NAME, read_index
from sceneprior.evaluation.score_table import headings, score_rows
from sceneprior.lifted.trained import TrainedLifted
from sceneprior.paper.prior import TrainedPrior
from sceneprior.training.method import Trained

UNSTATED = (
    "The origin and licence of the training data were not stated when this file was packed. Find "
    "them out before you redistribute it."
)
SHOWN = ("generated", "real training", "independent")
"""Columns of the score table, besides the column of the test rooms."""


def model_card(
    trained: Trained,
    name: str,
    about: str | None = None,
    scores: dict[str, Any] | None = None,
    latents: bool = False,
    half: bool = False,
) -> str:
    """The card as Markdown. `about` is the user's text on the data, `scores` a result of
    `eval-fid`."""
    config = trained.config
    packed = trained
    if isinstance(trained, TrainedPrior) and not latents:
        packed = replace(trained, logits=trained.logits[:0])
    shards = Path(config.data.shards)
    parts = [
        # Metadata for the Hugging Face Hub.
        "---\nlibrary_name: sceneprior\ntags: [3d, scene-synthesis, indoor-scenes]\n---",
        f"# {name}",
        f"A generative prior of rooms, trained by `sceneprior` {__version__} on "
        f"{len(trained.room_ids)} rooms. Rooms are sampled from: {packed.distribution}.",
        f'```python\nimport sceneprior\n\nprior = sceneprior.load("{name}.prior")\n'
        'sceneprior.save(prior.sample(4, seed=0)[0], "room.glb")\n```',
        _classes(trained),
        "Boxes and meshes are in metres, with y up and the floor at y = 0.",
        "## Data, authors and licence",
        (about or UNSTATED).strip(),
        *_splits(shards),
        "## Scores",
        *_scores(scores),
        "## Limits",
        *_limits(trained, latents, half),
        "## Settings",
        f"```json\n{json.dumps(shared_settings(config), indent=1)}\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _classes(trained: Trained) -> str:
    """A sentence on the classes that the prior generates, and on those that it never does."""
    name = trained.config.label_set
    names = label_set(name)
    sampler = trained.sampler if isinstance(trained, TrainedLifted) else None
    made = names[VOID + 1 :] if sampler is None else [names[row] for row in sampler.drawn_classes]
    lacking = [label for label in names[VOID + 1 :] if label not in made]
    said = f"Classes of generated objects (label set {name}): {', '.join(made)}."
    if lacking:
        said += f" The label set's other classes are never generated: {', '.join(lacking)}."
    return said


def _splits(shards: Path) -> list[str]:
    """Table of the shards' splits, if the shards are available."""
    if not (shards / INDEX_NAME).is_file():
        return []
    index = read_index(shards)
    rows = [
        f"| {split} | {counts['rooms']} | {counts['views']} | {counts['objects']} |"
        for split, counts in index.get("counts", {}).items()
    ]
    return ["\n".join(["| split | rooms | views | objects |", "| --- | --- | --- | --- |", *rows])]


def _scores(scores: dict[str, Any] | None) -> list[str]:
    if scores is None:
        return ["Not measured when this was packed (`sceneprior pack --scores` adds them)."]
    protocol = scores.get("protocol", {})
    found = headings(scores)
    chosen = [k for k, (title, _) in enumerate(found) if title in SHOWN or k == len(found) - 1]
    columns = [" (".join(found[k]) + ")" for k in chosen]
    table = [
        "| " + " | ".join(["", *columns]) + " |",
        "|" + " --- |" * (len(columns) + 1),
        *(
            f"| {title} ({unit}) | "
            + " | ".join(cells[k].replace("\n", ", ") for k in chosen)
            + " |"
            for title, unit, *cells in score_rows(scores)
        ),
    ]
    return [
        f"`sceneprior eval-fid`, seed {protocol.get('seed')}, against {protocol.get('split')} "
        "rooms, which were not used in training. Each value is followed by its 95% confidence "
        f"interval, from {protocol.get('resamples')} bootstrap resamples. Definitions: "
        "docs/evaluation.md of the package.",
        "\n".join(table),
    ]


def _limits(trained: Trained, latents: bool, half: bool) -> list[str]:
    limits = ["Rooms are similar to the training rooms, and contain only the classes listed above."]
    if isinstance(trained, TrainedPrior):
        limits.append(
            "The file contains the latents and ids of the training rooms, so these rooms can be "
            "decoded from it."
            if latents
            else "The file does not contain the latents of the training rooms, so rooms cannot be "
            "sampled from the distribution `kernel`, nor reconstructed from single images."
        )
        if isinstance(trained, TrainedLifted) and trained.sampler is not None:
            limits.append(
                "The shape of an object is one of a few hundred, which were found in training "
                "masks and are part of the weights. Objects are turned by multiples of 90 degrees."
            )
    if half:
        limits.append(
            "Large tensors are stored in half precision, so rooms differ slightly from those of "
            "the run."
        )
    return ["\n".join(f"- {limit}" for limit in limits)]
