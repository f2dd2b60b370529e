"""Names what made rooms or reconstructions, from the settings of the run: the paper's method, its
network taught by lifted boxes, the lifted method, a baseline, or somebody else's scenes."""

from dataclasses import dataclass

from sceneprior.apps.reconstruction.reconstruct import OBJECTS
from sceneprior.lifted.config import LiftedConfig
from sceneprior.lifted.trained import SAMPLER
from sceneprior.paper.config import PaperConfig
from sceneprior.training.method import RunConfig


@dataclass(frozen=True)
class Maker:
    """The method that made rooms or reconstructions, as result tables name it."""

    title: str
    """Title of a row whose method has none of its own."""
    detail: str
    """Text that follows a method's own title, such as that of another decoder."""
    said: str
    """Such rows, in a caption."""

    def named(self, title: str | None) -> str:
        """The title of a row, from that of its method, if any."""
        if title is None:
            return self.title
        return f"{title}, {self.detail}" if self.detail else title


LIFTED = "the lifted method"
PAPER = Maker("Paper's method", "", "the paper's method and variations of it")
TAUGHT = Maker(
    "Paper's sphere, taught by lifted boxes",
    "taught by lifted boxes",
    "the paper's network and latents taught by lifted boxes",
)
SAMPLED = Maker("Lifted method: sampler", "sampler of the lifted method", LIFTED)
FITTED = Maker("Paper: fit of a latent", "fit of a latent", PAPER.said)
FITTED_TAUGHT = Maker(
    "Fit of a latent, taught by lifted boxes",
    "fit of a latent, taught by lifted boxes",
    TAUGHT.said,
)
ONE_BY_ONE = Maker("Object by object", "object by object", LIFTED)
ONE_BY_ONE_PAPER = Maker("Object by object, by the paper's prior", "object by object", LIFTED)
BASELINE = Maker("", "", "baselines")
GIVEN = Maker("", "", "scenes as given, which were made elsewhere")


def maker_of_rooms(config: RunConfig, distribution: str | None) -> Maker:
    """Maker of a run's new rooms, drawn by a distribution; None is the run's own."""
    if not isinstance(config, PaperConfig | LiftedConfig):
        return BASELINE
    if (distribution or config.distribution) == SAMPLER:
        return SAMPLED
    return TAUGHT if isinstance(config, LiftedConfig) else PAPER


def maker_of_answers(config: RunConfig, fit: str = OBJECTS) -> Maker:
    """Maker of a run's reconstructions, by a fit of `eval-svr`."""
    if not isinstance(config, PaperConfig | LiftedConfig):
        return BASELINE
    if fit == OBJECTS:
        return ONE_BY_ONE if isinstance(config, LiftedConfig) else ONE_BY_ONE_PAPER
    return FITTED_TAUGHT if isinstance(config, LiftedConfig) else FITTED
