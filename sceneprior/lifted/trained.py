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
        """Default distribution of new rooms: `sampler` if the settings say so and the run has a
        sampler; else the distribution of latents."""
        with_sampler = self.sampler is not None and self.config.distribution == SAMPLER
        return SAMPLER if with_sampler else self.latent_distribution

    @property
    def latent_distribution(self) -> str:
        """Distribution of new latents, for tasks that need a latent."""
        own = self.config.distribution
        return own if self.remembers_rooms and own != SAMPLER else "paper"
