"""The registry of methods, and the loading of configs and runs.

`METHODS` lists the methods; `decoders.py` lists the baselines' decoders of object features. Each
section of a config is defined in the module that it configures; `training/method.py` defines the
interface of a method's config.
"""

import pkgutil
from pathlib import Path
from typing import Any

from sceneprior.apps.priors.packed import find_prior, is_packed, read_packed, unpack
from sceneprior.core.errors import ConfigError, InputError, shortened
from sceneprior.core.settings import check_settings, read_settings
from sceneprior.training.method import RunConfig, Trained, find_checkpoint, without_samples

METHODS = {
    "paper": "sceneprior.paper.config:PaperConfig",
    "lifted": "sceneprior.lifted.config:LiftedConfig",
    "gan": "sceneprior.baselines.gan:GanConfig",
    "atiss": "sceneprior.baselines.atiss:AtissConfig",
    "sync2gen": "sceneprior.baselines.sync2gen:Sync2genConfig",
    "set_flow": "sceneprior.baselines.set_flow:SetFlowConfig",
    "usl": "sceneprior.baselines.single_view.usl:UslConfig",
    "total3d": "sceneprior.baselines.single_view.total3d:Total3dConfig",
    "im3d": "sceneprior.baselines.single_view.im3d:Im3dConfig",
}
"""Import path of each method's config, by the value of the key `method`. Configs are imported on
demand: a baseline's config is defined beside its stage, which imports Lightning, and that takes
seconds."""
WITH_BASELINE_DECODERS = {
    "paper": "sceneprior.apps.decoders:PaperRun",
    "lifted": "sceneprior.apps.decoders:LiftedRun",
}
"""Import paths of the configs of our two methods that also accept a baseline's decoder as
`model.decoder`."""


def load_config(name: str, overrides: tuple[str, ...] = ()) -> RunConfig:
    """Read a config and apply `section.key=value` overrides."""
    path, data = read_settings(name, overrides)
    changed = f" with {', '.join(map(shortened, overrides))}" if overrides else ""
    return check_config(data, f"{path}{changed}")


def check_config(data: dict[str, Any], source: str) -> RunConfig:
    """Turn plain data into the config of its method; an error is a ConfigError of one sentence.

    Runs and packed priors of earlier versions have a section `samples`, which chose checkpoints.
    The section is dropped if it has no effect (`every` is 0 or missing), and refused otherwise.
    """
    data = without_samples(data, source)
    method = data.get("method")
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


def weights_of(run: Path | str) -> Path:
    """The packed prior (a file or a folder) or the checkpoint that `load_any_run` reads."""
    path = find_prior(run)
    return path if is_packed(path) else find_checkpoint(path, run_config(path).stage_names)[1]


def load_any_run(run: Path | str) -> Trained:
    """Load the networks of a run of any method, which `find_prior` finds, in evaluation mode."""
    path = find_prior(run)
    if is_packed(path):
        packed = read_packed(path)
        return unpack(packed, check_config(packed.said.settings, str(run)), str(run))
    config = run_config(path)
    return config.load(*find_checkpoint(path, config.stage_names))


def run_config(run: Path | str) -> RunConfig:
    """The config that a run was trained with; InputError if the folder is not a run."""
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise InputError(
            f"{run} is not a run folder: it has no config.yaml (packed priors are not run "
            "folders); train a run with `sceneprior fit --config demo.yaml --run RUN`."
        )
    return load_config(str(path))
