"""Comparisons of tiny configs, with made-up result files of `eval-fid` and `eval-svr`."""

from pathlib import Path
from typing import Any

import yaml
from tiny_runs import tiny_baseline_settings, tiny_lifted_settings, write_tiny_config

from sceneprior.apps.experiments.rows import NEW_ROOMS
from sceneprior.core.files import write_json
from sceneprior.evaluation.score_table import FORMAT
from sceneprior.evaluation.synthesis import VERSION

SAMPLER = {"epochs": 3, "width": 16, "layers": 1, "heads": 2, "val_every": 1}
KEYS = [*NEW_ROOMS.columns]
METHODS = {
    "paper": {},
    "lstm": {
        "title": "LSTM",
        "set": {"every": ["model.decoder={name: lstm}"], "toy": ["model.width=8"]},
    },
}


def write_comparison(folder: Path, shards: Path, **changes: Any) -> str:
    """A comparison's YAML of one kind of rooms and two methods."""
    config = folder / "tiny.yaml"
    if not config.is_file():
        write_tiny_config(config, shards, layout__epochs=1, shape__epochs=1)
        for name in ("gan", "usl"):
            own = tiny_baseline_settings(Path("elsewhere"), name)
            (folder / f"{name}.yaml").write_text(yaml.safe_dump(own))
        lifted = tiny_lifted_settings(shards, sampler=SAMPLER, sampling={"distribution": "sampler"})
        (folder / "lifted.yaml").write_text(yaml.safe_dump(lifted))
    data = {
        "seeds": [0],
        "count": 4,
        "rooms": {"toy": {"title": "Toys", "config": str(config)}},
        "methods": METHODS,
    }
    if changes.get("task") == "single_views":
        data |= {"views": 2, "cad_models": "shards"}
    path = folder / "compare.yaml"
    path.write_text(yaml.safe_dump(data | changes, sort_keys=False))
    return str(path)


def made_columns(start: float, keys: list[str] = KEYS) -> dict[str, Any]:
    """A value for each key, of all sizes; the third key is unknown."""
    values = {key: round(start * (1 + 0.37 * k), 4) for k, key in enumerate(keys)}
    return values | {keys[2]: None}


def write_new_rooms(path: Path, number: int, latents: str, remembers: bool) -> None:
    """A result of `eval-fid`."""
    scores = made_columns(1.25 + number)
    ends = {key: [0.9 * value, 1.1 * value] for key, value in scores.items() if value}
    counts = {"n_generated": 4, "n_test": 3, "n_train_rooms": 12}
    scores |= {
        "format": FORMAT,
        "version": VERSION,
        "intervals": {"generated": ends, "train_rooms": {KEYS[0]: [0.4, 0.6]}},
        "note": "4 of 4 generated rooms are empty: train longer." if number == 10 else "",
        "protocol": {**counts, "label_set": "toys", "shards": "front", "latents": latents},
        "independent": made_columns(9.5, KEYS[:6]),
        "independent_meshes": made_columns(7.5, KEYS[:4]),
        "shuffled": made_columns(5.5, KEYS[3:]),
        "train_rooms": made_columns(0.5),
    }
    if remembers:
        scores["decoded_rooms"] = made_columns(0.75 + number)
    write_json(path, scores)


def write_views(path: Path, number: int, cad: bool) -> None:
    """A result of `eval-svr`."""
    keys = ["box_iou_3d", "chamfer_l2_m", "chamfer_squared_m2", "f_score", "class_accuracy"]

    def row(start: float) -> dict[str, Any]:
        scores = made_columns(start, keys)
        ends = {key: [0.9 * value, 1.1 * value] for key, value in scores.items() if value}
        counts = {"rooms": 2, "images": 4, "objects": 9, "unmatched": 1, "with_surface": 8}
        return {"summary": scores | counts, "intervals": ends, "classes": {}}

    names = ["fit", "fit_boxes", *["fit_cad"] * cad, "nearest_room", "random_room"]
    write_json(
        path,
        {
            "rows": {name: row(0.125 * (k + 1) + 0.01 * number) for k, name in enumerate(names)},
            "cpu_seconds_an_image": 0.5 + number,
            "protocol": {"shards": "data/rooms", "known_model_share": 0.875},
        },
    )
