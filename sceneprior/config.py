"""The registry of methods, and the loading of configs and runs.

A method is listed in `METHODS`, a decoder of object features in `Model`. Each section is defined
beside what it configures; `training/method.py` says what a method's config has to offer.
"""

import pkgutil
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from sceneprior.baselines.atiss2d import Atiss2dConfig
from sceneprior.baselines.lstm import LstmConfig
from sceneprior.errors import ConfigError, InputError
from sceneprior.models.prior import ModelConfig
from sceneprior.models.transformer import TransformerConfig
from sceneprior.priors.packed import is_packed, read_packed, unpack
from sceneprior.priors.where import find_prior
from sceneprior.settings import check_settings, read_settings
from sceneprior.training.checkpoints import find_checkpoint
from sceneprior.training.method import (
    RunConfig,
    Trained,
    TrainedPrior,
    TrainedReconstructor,
)
from sceneprior.training.ours import PaperConfig


class Model(ModelConfig):
    """The network, with any decoder: the paper's, or a baseline's in its place."""

    decoder: Annotated[TransformerConfig | LstmConfig | Atiss2dConfig, Field(discriminator="name")]


class OursConfig(PaperConfig):
    """A run of the paper's method, whatever decodes object features."""

    model: Model


METHODS = {
    "ours": "sceneprior.config:OursConfig",
    "gan": "sceneprior.baselines.gan.stage:GanConfig",
    "atiss": "sceneprior.baselines.atiss.stage:AtissConfig",
    "sync2gen": "sceneprior.baselines.sync2gen.stage:Sync2genConfig",
    "usl": "sceneprior.baselines.single_view.usl:UslConfig",
    "total3d": "sceneprior.baselines.single_view.total3d:Total3dConfig",
    "im3d": "sceneprior.baselines.single_view.im3d:Im3dConfig",
}
"""Where the config of each method is, by the value of its key `method`. It is imported when it is
asked for: a baseline stands beside its stage, and Lightning takes seconds to import."""


def load_config(name: str, overrides: tuple[str, ...] = ()) -> RunConfig:
    """Read a config and apply `section.key=value` overrides.

    Raises:
        ConfigError: not found, not YAML, an unknown key or a wrong value; the message names the
            file, the key and, for a typo, the nearest key.
    """
    path, data = read_settings(name, overrides)
    return check_config(data, str(path))


def check_config(data: dict[str, Any], source: str) -> RunConfig:
    """Turn plain data into the config of its method, or say in one sentence what is wrong."""
    if "method" not in data and "stages" in data:
        raise ConfigError(
            f"{source} was written before methods had names (it says `stages`), and cannot be read "
            "any more; train it again with a config of today, such as demo.yaml."
        )
    method = data.get("method", "ours")
    if not isinstance(method, str) or method not in METHODS:
        raise ConfigError(
            f"{source}: no method is called '{method}'; choose from {', '.join(METHODS)}."
        )
    config: type[RunConfig] = pkgutil.resolve_name(METHODS[method])
    return check_settings(config, data, source)


def load_any_run(run: Path | str, checkpoint: str = "final") -> Trained:
    """What a run of any method trained, in evaluation mode.

    For tasks that do with less than a latent space: they ask what kind of `Trained` it is.

    Args:
        run: As `find_prior` finds it: a run's folder, a packed prior, its name, or one on the Hub.
        checkpoint: Of a run's folder, as in `find_checkpoint`.

    Raises:
        InputError: there is nothing of the kind, or its checkpoint is missing or damaged.
    """
    path = find_prior(run)
    if is_packed(path):
        if checkpoint != "final":
            raise InputError(
                f"{run} is a packed prior, which holds one checkpoint; leave out --checkpoint."
            )
        packed = read_packed(path)
        return unpack(packed, check_config(packed.said.settings, str(run)), str(run))
    config = run_config(path)
    return config.load(*find_checkpoint(path, config.stage_names, checkpoint))


def load_run(run: Path | str, checkpoint: str = "final") -> TrainedPrior:
    """The trained prior of a run, in evaluation mode: for tasks that need its latent space.

    Raises:
        InputError: the folder is no run, its checkpoint is missing or damaged, or it is the run of
            a baseline without a latent space.
    """
    return with_latents(load_any_run(run, checkpoint), run)


def with_latents(trained: Trained, run: Path | str) -> TrainedPrior:
    """The same; an InputError where it is a baseline's, which has no latent space."""
    if not isinstance(trained, TrainedPrior):
        works = "synthesize`, `eval-fid` and `report"
        if isinstance(trained, TrainedReconstructor):
            works = "reconstruct` and `eval-svr"
        raise InputError(
            f"{run} is a run of `method: {trained.config.method}`, which has no latent space of "
            "rooms, and this needs one. Take a run of `method: ours`; with this one, `sceneprior "
            f"{works}` work."
        )
    return trained


def run_config(run: Path | str) -> RunConfig:
    """The config that a run was trained with; InputError if the folder is no run."""
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise InputError(
            f"{run} is not a run folder (no config.yaml in it); train one with "
            "`sceneprior fit --config demo.yaml --run RUN`."
        )
    return load_config(str(path))
