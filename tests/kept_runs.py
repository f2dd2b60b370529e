"""Runs of toy rooms, trained once and kept in `golden/runs/`, so that tests do not train.

`TAKE=runs pytest tests` trains them anew and writes the files, after a change of what is
trained. A kept run has the weights that commands load, and no states of optimisers.
"""

import hashlib
import io
import shutil
import zipfile
from pathlib import Path

import torch
from golden_values import FOLDER, TAKE_RUNS

GOLDEN = FOLDER / "runs"
TAKEN_ON = (2026, 1, 1, 0, 0, 0)
"""Date of all files in the archives, so that the same run gives the same archive."""
LIFTED = GOLDEN / "lifted_toy_shards.zip"
"""Parts fitted to the toy shards. They are found again where the shards differ."""
_RESUMED = ("optimizer_states", "lr_schedulers", "callbacks", "loops")


def write_kept_run(name: str, config, run: Path) -> None:
    """Write the folder of the run `name` on the toy rooms, as `fit` does.

    Raises:
        AssertionError: the kept run was trained with another config.
    """
    from sceneprior.core.settings import dump_settings
    from sceneprior.training.fit import fit

    archive = GOLDEN / f"{name}.zip"
    changed = config.model_dump_json(exclude_defaults=True)  # new settings change no kept run
    plain = changed.replace(config.data.shards, "SHARDS")
    key = hashlib.sha256(plain.encode()).hexdigest()
    if TAKE_RUNS:
        fit(config, run, trainer_options={"accelerator": "cpu"})
        files = {"key": key.encode()}
        for path in sorted(run.rglob("*")):
            if path.suffix == ".csv" or path.name == "final.ckpt":
                files[path.relative_to(run).as_posix()] = _without_optimizers(path)
        _write(archive, files)
        return
    with zipfile.ZipFile(archive) as kept:
        assert kept.read("key").decode() == key, f"{archive.name} is of another config: TAKE=runs"
        kept.extractall(run)
    (run / "key").unlink()
    dump_settings(config, run / "config.yaml")
    for path in list(run.rglob("final.ckpt")):
        shutil.copyfile(path, path.with_name("last.ckpt"))


def _without_optimizers(path: Path) -> bytes:
    if path.suffix == ".csv":
        return path.read_bytes()
    saved = torch.load(path, weights_only=True)
    if (
        "learner.look_shown" in saved["state_dict"]
    ):  # the sampler in training; commands load its mean
        saved["state_dict"] = {
            name: value
            for name, value in saved["state_dict"].items()
            if not name.startswith("learner.")
        }
    for name in _RESUMED:
        saved.pop(name, None)
    data = io.BytesIO()
    torch.save(saved, data)
    return data.getvalue()


def add_lifted(shards: Path) -> None:
    """Put the parts fitted to the toy shards beside them, as training does."""
    with zipfile.ZipFile(LIFTED) as kept:
        kept.extractall(shards)


def take_lifted(shards: Path) -> None:
    """Keep the parts that training has fitted; all else is lifted fast."""
    found = sorted(shards.glob("lifted_parts_*.npz"))
    _write(LIFTED, {path.name: path.read_bytes() for path in found})


def _write(archive: Path, files: dict[str, bytes]) -> None:
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as kept:
        for name, data in files.items():
            kept.writestr(zipfile.ZipInfo(name, TAKEN_ON), data, zipfile.ZIP_DEFLATED)
