"""The registry of methods, and the loading of configs and runs.

A method is listed in `METHODS`, a baseline's decoder of object features in `decoders.py`. Each
section is defined beside what it configures; `training/method.py` says what a method's config has
to offer.
"""

import pkgutil
from pathlib import Path
from typing import Any

from sceneprior.apps.priors.packed import is_packed, read_packed, unpack
from sceneprior.apps.priors.where import find_prior
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.settings import check_settings, read_settings, shortened
from sceneprior.paper.trained import TrainedPrior
from sceneprior.training.checkpoints import find_checkpoint
from sceneprior.training.method import RunConfig, Trained, TrainedReconstructor
from sceneprior.training.settings import without_samples

METHODS = {
    "paper": "sceneprior.paper.config:PaperConfig",
    "lifted": "sceneprior.lifted.config:LiftedConfig",
    "gan": "sceneprior.baselines.gan.stage:GanConfig",
    "atiss": "sceneprior.baselines.atiss.stage:AtissConfig",
    "sync2gen": "sceneprior.baselines.sync2gen.stage:Sync2genConfig",
    "set_flow": "sceneprior.baselines.set_flow.stage:SetFlowConfig",
    "usl": "sceneprior.baselines.single_view.usl:UslConfig",
    "total3d": "sceneprior.baselines.single_view.total3d:Total3dConfig",
    "im3d": "sceneprior.baselines.single_view.im3d:Im3dConfig",
}
"""Import path of each method's config, by the value of its key `method`. Configs are imported when
they are asked for: a baseline's stands beside its stage, and Lightning takes seconds to import."""
WITH_BASELINE_DECODERS = {
    "paper": "sceneprior.apps.decoders:PaperRun",
    "lifted": "sceneprior.apps.decoders:LiftedRun",
}
"""Configs of the same methods whose `model.decoder` may be a baseline's."""


def load_config(name: str, overrides: tuple[str, ...] = ()) -> RunConfig:
    """Read a config and apply `section.key=value` overrides."""
    path, data = read_settings(name, overrides)
    return check_config(data, str(path))


def check_config(data: dict[str, Any], source: str) -> RunConfig:
    """Turn plain data into the config of its method, or say in one sentence what is wrong.

    Runs and packed priors of earlier versions have a section `samples`, by which checkpoints were
    chosen. It is dropped where it asks for nothing (`every` is 0 or missing), and else refused.
    """
    if "method" not in data and "stages" in data:
        raise ConfigError(
            f"{source} was written before methods had names (it says `stages`), and cannot be read "
            "any more; train it again with a config of today, such as demo.yaml."
        )
    data = without_samples(data, source)
    method = data.get("method")
    if method == "ours":
        raise ConfigError(
            f"{source} was written when `method: ours` stood for two methods; they are `paper` and "
            "`lifted` now, with sections of their own. Train it again with a config of today."
        )
    if not isinstance(method, str) or method not in METHODS:
        raise ConfigError(
            f"{source}: no method is called '{shortened(method)}'; choose from "
            f"{', '.join(METHODS)}."
        )
    model = data.get("model")
    decoder = model.get("decoder") if isinstance(model, dict) else None
    own = isinstance(decoder, dict) and decoder.get("name") == "transformer"
    where = METHODS[method] if own else WITH_BASELINE_DECODERS.get(method, METHODS[method])
    config: type[RunConfig] = pkgutil.resolve_name(where)
    return check_settings(config, data, source)


def load_any_run(run: Path | str) -> Trained:
    """Load the networks of a run of any method, which `find_prior` finds, in evaluation mode."""
    path = find_prior(run)
    if is_packed(path):
        packed = read_packed(path)
        return unpack(packed, check_config(packed.said.settings, str(run)), str(run))
    config = run_config(path)
    return config.load(*find_checkpoint(path, config.stage_names))


def load_run(run: Path | str) -> TrainedPrior:
    """The trained prior of a run, in evaluation mode: for tasks that need its latent space."""
    return with_latents(load_any_run(run), run)


def with_latents(trained: Trained, run: Path | str) -> TrainedPrior:
    """The run, if it is a prior; else an InputError: baselines have no latent space."""
    if not isinstance(trained, TrainedPrior):
        works = "synthesize`, `eval-fid` and `report"
        if isinstance(trained, TrainedReconstructor):
            works = "reconstruct` and `eval-svr"
        raise InputError(
            f"{run} is a run of `method: {trained.config.method}`, which has no latent space of "
            "rooms, and this needs one. Take a run of `method: paper` or `lifted`; with this one, "
            f"`sceneprior {works}` work."
        )
    return trained


def run_config(run: Path | str) -> RunConfig:
    """The config that a run was trained with; InputError if the folder is no run."""
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise InputError(
            f"{run} is not a run folder: there is no config.yaml in it, and a packed prior is "
            "none; train one with `sceneprior fit --config demo.yaml --run RUN`."
        )
    return load_config(str(path))
