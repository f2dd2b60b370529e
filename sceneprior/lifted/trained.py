"""A trained prior of the lifted method."""

from dataclasses import dataclass

from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.paper.prior import TrainedPrior

SAMPLER = "sampler"
"""Name of the distribution that draws rooms object by object with the sampler, without a latent."""


@dataclass(frozen=True)
class TrainedLifted(TrainedPrior):
    """A prior whose shapes are looks, and the sampler of its run."""

    sampler: RoomSampler | None = None
    """None before the sampler's stage has begun, and in runs without a sampler."""

    @property
    def distribution(self) -> str:
        """`sampler` if the settings say so and the run has one; else the latents' distribution."""
        with_sampler = self.sampler is not None and self.config.distribution == SAMPLER
        return SAMPLER if with_sampler else self.latent_distribution
