"""Names of the methods that made rooms or reconstructions, from the settings of a run: the paper's
method, its network trained on lifted boxes, the lifted method, a baseline, or existing scenes."""

from typing import NamedTuple

from sceneprior.apps.reconstruction.reconstruct import OBJECTS
from sceneprior.lifted.config import LiftedConfig
from sceneprior.lifted.trained import SAMPLER
from sceneprior.paper.config import PaperConfig
from sceneprior.training.method import RunConfig


class Maker(NamedTuple):
    """The method that made rooms or reconstructions, as result tables name it."""

    title: str
    """Title of a row if the comparison gives its method no title."""
    said: str
    """Name of the method in a caption."""
    detail: str = ""
    """Text appended to the title that the comparison gives, such as the kind of supervision."""

    def named(self, title: str | None) -> str:
        """The title of a row; `title` is the method's title in the comparison, if it has one."""
        if title is None:
            return self.title
        return f"{title}, {self.detail}" if self.detail else title


LIFTED = "the lifted method"
PAPER = Maker("Paper's method", "the paper's method and variations of it")
TAUGHT = Maker(
    "Paper's sphere, trained on lifted boxes",
    "the paper's network and latents trained on lifted boxes",
    "trained on lifted boxes",
)
SAMPLED = Maker("Lifted method: sampler", LIFTED, "sampler of the lifted method")
FITTED = Maker("Paper: fit of a latent", PAPER.said, "fit of a latent")
FITTED_TAUGHT = Maker(
    "Fit of a latent, trained on lifted boxes",
    TAUGHT.said,
    "fit of a latent, trained on lifted boxes",
)
ONE_BY_ONE = Maker("Object by object", LIFTED, "object by object")
ONE_BY_ONE_PAPER = ONE_BY_ONE._replace(title="Object by object, by the paper's prior")
BASELINE = Maker("", "baselines")
GIVEN = Maker("", "scenes as given, which were made elsewhere")


def maker_of_rooms(config: RunConfig, distribution: str | None) -> Maker:
    """Name the method with which a run draws new rooms; if `distribution` is None, it is the run's
    default."""
    if not isinstance(config, PaperConfig | LiftedConfig):
        return BASELINE
    if (distribution or config.distribution) == SAMPLER:
        return SAMPLED
    return TAUGHT if isinstance(config, LiftedConfig) else PAPER


def maker_of_answers(config: RunConfig, fit: str = OBJECTS) -> Maker:
    """Name the method with which a run reconstructs rooms; `fit` is the option of `eval-svr`."""
    if not isinstance(config, PaperConfig | LiftedConfig):
        return BASELINE
    if isinstance(config, LiftedConfig):
        return ONE_BY_ONE if fit == OBJECTS else FITTED_TAUGHT
    return ONE_BY_ONE_PAPER if fit == OBJECTS else FITTED
