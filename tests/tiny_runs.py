"""Settings of a run small enough to train both stages in seconds on a CPU."""

from pathlib import Path
from typing import Any

import yaml

from sceneprior.config import RunConfig, check_config


def tiny_settings(shards: Path, **changes: Any) -> dict[str, Any]:
    """Plain data for a config; changes are written `layout__epochs=2`."""
    data = {
        "label_set": "front3d_bedroom",
        "seed": 3,
        "data": {
            "shards": str(shards),
            "views_per_room": 4,
            "augment_rotations": False,
            "mask_step": 4,
        },
        "model": {
            "max_objects": 6,
            "width": 16,
            "anchors": 10,
            "heads": 2,
            "hidden": 24,
            "dropout": 0.0,
            "shape_width": 8,
            "shape_level": 1,
            "template": "box",
            "fit_box": True,
        },
        "loss": {},
        "layout": {
            "epochs": 6,
            "batch_size": 5,
            "learning_rate": 5e-3,
            "latent_learning_rate": 5e-2,
            "milestones": [4],
            "proxy": "box",
        },
        "shape": {
            "epochs": 3,
            "batch_size": 6,
            "learning_rate": 2e-3,
            "latent_learning_rate": 2e-3,
            "views_per_room": 3,
            "proxy": "box",
            "compositing": "layered",
            "sigma_px2": 0.3,
        },
    }
    for key, value in changes.items():
        *sections, name = key.split("__")
        node = data
        for section in sections:
            node = node[section]
        node[name] = value
    return data


def tiny_config(shards: Path, **changes: Any) -> RunConfig:
    """The same, checked."""
    return check_config(tiny_settings(shards, **changes), "tiny")


def write_tiny_config(path: Path, shards: Path, **changes: Any) -> Path:
    """The same, as a YAML file."""
    path.write_text(yaml.safe_dump(tiny_settings(shards, **changes), sort_keys=False))
    return path
