"""Settings of a run small enough to train both stages in seconds on a CPU."""

import copy
from pathlib import Path
from typing import Any

import yaml

from sceneprior.apps.config import RunConfig, check_config


def tiny_model() -> dict[str, Any]:
    """Plain data of the network."""
    return {
        "max_objects": 6,
        "width": 16,
        "latent_space": {"name": "sphere", "anchors": 10},
        "decoder": {"name": "transformer", "heads": 2, "hidden": 24, "dropout": 0.0},
        "shape": {"width": 8, "level": 1, "template": "box", "fit_box": True},
    }


def tiny_settings(shards: Path, **changes: Any) -> dict[str, Any]:
    """Plain data for a config; changes are written `layout__epochs=2`."""
    data = {
        "method": "paper",
        "label_set": "front3d_bedroom",
        "seed": 3,
        "data": {
            "shards": str(shards),
            "views_per_room": 4,
            "augment_rotations": False,
            "mask_step": 4,
        },
        "model": tiny_model(),
        "loss": {},
        "layout": {
            "epochs": 6,
            "batch_size": 5,
            "learning_rate": 5e-3,
            "latent_learning_rate": 5e-2,
            "schedule": {"name": "steps", "milestones": [4]},
            "proxy": "beveled_box",
        },
        "shape": {
            "epochs": 3,
            "batch_size": 6,
            "learning_rate": 2e-3,
            "latent_learning_rate": 2e-3,
            "views_per_room": 3,
            "proxy": "beveled_box",
            "compositing": "layered",
            "sigma_px2": 0.3,
        },
    }
    return _changed(data, changes)


def tiny_lifted_settings(shards: Path, **changes: Any) -> dict[str, Any]:
    """Plain data for a run of the lifted method, without a sampler."""
    paper = tiny_settings(shards)
    data = {
        "method": "lifted",
        "label_set": "front3d_bedroom",
        "seed": 3,
        "data": {key: value for key, value in paper["data"].items() if key != "views_per_room"},
        "model": tiny_model() | {"shape": {"prototypes": 20, "codes": 6, "width": 8, "cells": 8}},
        "loss": {},
        "shape": {
            "epochs": 3,
            "batch_size": 6,
            "learning_rate": 2e-3,
            "latent_learning_rate": 2e-3,
        },
    }
    return _changed(data, changes)


def tiny_lifted(shards: Path, **changes: Any) -> RunConfig:
    """The same, checked."""
    return check_config(tiny_lifted_settings(shards, **changes), "tiny")


VIEWLESS = ("gan", "atiss", "sync2gen", "set_flow")
"""Baselines that draw no views by `data.views_per_room`."""
TINY_BASELINES: dict[str, dict[str, Any]] = {
    "gan": {
        "model": {
            **tiny_model(),
            "decoder": {**tiny_model()["decoder"], "step_mlps": True, "dropout": 0.1},
        },
        "training": {"epochs": 4, "batch_size": 5, "views_per_room": 3},
    },
    "atiss": {
        "model": {
            "max_objects": 6,
            "width": 16,
            "layers": 1,
            "heads": 2,
            "hidden": 16,
            "mixtures": 3,
        },
        "training": {"epochs": 6, "batch_size": 5, "learning_rate": 2e-3, "schedule": "cosine"},
    },
    "sync2gen": {
        "model": {"width": 32, "latent": 8, "slots": 2, "refine_steps": 5},
        "training": {"epochs": 6, "batch_size": 5, "learning_rate": 3e-3},
    },
    "set_flow": {
        "model": {
            "max_objects": 6,
            "width": 16,
            "layers": 1,
            "heads": 2,
            "hidden": 16,
            "dropout": 0.0,
            "steps": 4,
        },
        "training": {"epochs": 6, "batch_size": 5, "learning_rate": 5e-3},
    },
    "usl": {
        "model": {
            "width": 16,
            "shape": {"width": 8, "level": 1, "template": "box", "fit_box": True},
        },
        "training": {"epochs": 2, "batch_size": 6},
    },
    "total3d": {
        "model": {"width": 16, "heads": 2, "shape": {"width": 8, "level": 1}},
        "training": {"epochs": 2, "batch_size": 6},
    },
    "im3d": {
        "model": {"width": 16, "heads": 2, "rounds": 2, "blobs": 8},
        "training": {"epochs": 2, "batch_size": 6, "points": 32},
    },
}


def tiny_baseline_settings(shards: Path, method: str, **changes: Any) -> dict[str, Any]:
    """Plain data for a baseline's config; changes are written `training__epochs=2`."""
    whose = tiny_lifted_settings if method in VIEWLESS else tiny_settings
    shared = {key: whose(shards)[key] for key in ("label_set", "seed", "data")}
    data = {"method": method, **shared, **copy.deepcopy(TINY_BASELINES[method])}
    return _changed(data, changes)


def tiny_baseline(shards: Path, method: str, **changes: Any) -> RunConfig:
    """The same, checked."""
    return check_config(tiny_baseline_settings(shards, method, **changes), "tiny")


def _changed(data: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
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


def tiny_sampler_config(shards: Path, **changes: Any) -> RunConfig:
    """A run of the lifted method with a sampler; `changes` are the sampler's."""
    sampler = {"epochs": 3, "width": 16, "layers": 1, "heads": 2, "val_every": 1, **changes}
    return tiny_lifted(shards, sampler=sampler, sampling={"distribution": "sampler"})


def write_tiny_config(path: Path, shards: Path, **changes: Any) -> Path:
    """The same, as a YAML file."""
    path.write_text(yaml.safe_dump(tiny_settings(shards, **changes), sort_keys=False))
    return path
