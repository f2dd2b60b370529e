"""Damaged configs, checkpoints and packed priors: read, or refused in one sentence."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from mutating import MUTATIONS, assert_one_sentence, damaged_bytes
from tiny_runs import write_tiny_config

from sceneprior.apps.config import load_any_run
from sceneprior.apps.priors.packed import pack, write_packed

pytestmark = pytest.mark.slow

ODD_YAML = (
    "*a", "&a [*a]", "[[[[", "{a: {b: {c: 1}}}", "!!set {1, 2}", "!!binary aGVsbG8=", ".nan", "-1",
    "99999999999999999999999", "2001-99-99", "~", "'", '"\\x0', "? [1]",
    "[" * 3000, "x" * 5000, "1e400", "!!python/object:os.system 1", "<<: *a",
)  # fmt: skip


def read_config(path: Path) -> None:
    from sceneprior.apps.config import load_config

    load_config(str(path))


def read_checkpoint(path: Path) -> None:
    from sceneprior.apps.config import load_any_run

    load_any_run(path.parent.parent)


def read_prior(path: Path) -> None:
    from sceneprior.apps.config import load_any_run

    load_any_run(path)


def _damaged_text(text: str, rng: np.random.Generator) -> bytes:
    """With some values exchanged for odd ones, some lines moved, or bytes damaged."""
    lines = text.splitlines()
    for _ in range(int(rng.integers(1, 4))):
        at, other = rng.integers(0, len(lines), 2)
        key, colon, _ = lines[at].partition(":")
        match int(rng.integers(4)):
            case 0:
                lines[at], lines[other] = lines[other], lines[at]
            case 1:
                lines[at] = "  " + lines[at]
            case _:
                lines[at] = f"{key}{colon} {ODD_YAML[rng.integers(len(ODD_YAML))]}"
    data = "\n".join(lines).encode()
    return damaged_bytes(data, rng) if rng.random() < 0.3 else data


def test_damaged_configs(toy_shards, tmp_path):
    text = write_tiny_config(tmp_path / "tiny.yaml", toy_shards).read_text()
    rng = np.random.default_rng(2)
    paths = [tmp_path / f"{number}.yaml" for number in range(MUTATIONS)]
    for path in paths:
        path.write_bytes(_damaged_text(text, rng))
    said = assert_one_sentence(__file__, "read_config", paths)
    refused = [sentence for sentence in said if sentence]
    assert all(sentence.startswith("ConfigError: ") for sentence in refused)
    assert all(str(tmp_path) in sentence for sentence in refused)
    assert len(refused) > MUTATIONS / 2


def _odd_checkpoint(saved: dict, rng: np.random.Generator) -> object:
    """Other contents than `fit` writes, in a file that torch reads."""
    odd: list[object] = [None, 3, [1, 2], "text", {}, {1: 2}, torch.zeros(2), torch.zeros(())]
    value = odd[rng.integers(len(odd))]
    if rng.random() < 0.1:
        return value
    changed = {key: dict(part) if isinstance(part, dict) else part for key, part in saved.items()}
    place = rng.random()
    if place < 0.4:
        changed[str(rng.choice(["state_dict", "sceneprior"]))] = value
    elif place < 0.7:
        changed["state_dict"][str(rng.choice(list(changed["state_dict"])))] = value
    else:
        changed["sceneprior"][str(rng.choice(list(changed["sceneprior"])))] = value
    return changed


def test_damaged_checkpoints(toy_run, tmp_path):
    data = (toy_run / "shape" / "final.ckpt").read_bytes()
    saved = torch.load(io.BytesIO(data), weights_only=True)
    rng = np.random.default_rng(3)
    paths = []
    for number in range(MUTATIONS):
        path = tmp_path / f"{number}" / "shape" / "final.ckpt"
        path.parent.mkdir(parents=True)
        (path.parent.parent / "config.yaml").write_bytes((toy_run / "config.yaml").read_bytes())
        if number % 2:
            path.write_bytes(damaged_bytes(data, rng))
        else:
            torch.save(_odd_checkpoint(saved, rng), path)
        paths.append(path)
    said = assert_one_sentence(__file__, "read_checkpoint", paths)
    for path, sentence in zip(paths, said, strict=True):
        assert not sentence or str(path) in sentence, sentence
    assert sum(bool(sentence) for sentence in said) > MUTATIONS / 3


def _odd_prior(data: bytes, rng: np.random.Generator) -> bytes:
    """A zip of the same names, one of whose files is damaged."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(list(files)))
    if name.endswith(".json") and rng.random() < 0.7:
        described = json.loads(files[name])
        odd = [None, -1, "text", [], {}, ["a"] * 9, 1e308, 2**70, "../../x"]
        described[str(rng.choice(list(described)))] = odd[rng.integers(len(odd))]
        files[name] = json.dumps(described).encode()
    else:
        files[name] = damaged_bytes(files[name], rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def test_damaged_packed_priors(toy_run, tmp_path):
    trained = load_any_run(toy_run)
    write_packed(pack(trained, "A card.\n", latents=True), tmp_path / "whole.prior")
    data = (tmp_path / "whole.prior").read_bytes()
    rng = np.random.default_rng(4)
    paths = [tmp_path / f"{number}.prior" for number in range(MUTATIONS)]
    for number, path in enumerate(paths):
        path.write_bytes(damaged_bytes(data, rng) if number % 2 else _odd_prior(data, rng))
    said = assert_one_sentence(__file__, "read_prior", paths)
    for path, sentence in zip(paths, said, strict=True):
        assert not sentence or str(path) in sentence, sentence
    assert sum(bool(sentence) for sentence in said) > MUTATIONS / 3
