"""The Python API: load a trained prior, and make rooms with it. The commands stand on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from sceneprior.classes import label_set
from sceneprior.config import load_any_run, with_latents
from sceneprior.generation.complete import complete
from sceneprior.generation.decode import synthesize
from sceneprior.generation.interpolate import interpolate
from sceneprior.generation.sample import Point, latent_of
from sceneprior.reconstruction.image import ObservedImage
from sceneprior.reconstruction.reconstruct import FitOptions, Reconstruction, reconstruct
from sceneprior.scene import Scene
from sceneprior.training.method import Trained, TrainedPrior
from sceneprior.views import DecodedScenes


def load(where: str | Path, checkpoint: str = "final") -> "Prior":
    """Load a trained prior, on the CPU.

    Args:
        where: The folder of a run that `sceneprior fit` made; a file that `sceneprior pack` made;
            the name of a prior of the package (`sceneprior priors` lists them); or
            `hf://OWNER/NAME`, on the Hugging Face Hub.
        checkpoint: Of a run: `final`, or `best`: what generated best while training.

    Raises:
        InputError: there is no prior, or it is damaged; one sentence says what to do.

    Examples:
        >>> load("procthor-bedroom")
        Prior('procthor-bedroom', front3d_bedroom, rooms from: sampler)
    """
    return Prior(load_any_run(where, checkpoint), str(where))


@dataclass(frozen=True, repr=False)
class Prior:
    """A trained prior of rooms. Rooms are `Scene`s: classes, boxes and meshes in metres, y up.

    Runs of methods without a latent space (`atiss`, `sync2gen`) sample, and that is all they do.
    """

    trained: Trained
    """The networks, on which the functions of `sceneprior.generation` work."""
    where: str
    """What it was loaded from."""

    def __repr__(self) -> str:
        return f"Prior({self.where!r}, {self.label_set}, rooms from: {self.distribution})"

    @property
    def label_set(self) -> str:
        """The name of its classes' label set."""
        return self.trained.config.label_set

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of its classes; the first, `void`, is no furniture."""
        return tuple(label_set(self.label_set))

    @property
    def distribution(self) -> str:
        """Where `sample` takes rooms from unless told otherwise."""
        return self.trained.distribution

    def sample(self, count: int = 1, seed: int = 0, distribution: str | None = None) -> list[Scene]:
        """New rooms; the same seed, the same rooms.

        Args:
            distribution: `sampler`, or of latents: `kernel`, `geodesic`, `gaussian`, `paper`.

        Raises:
            InputError: the prior has no such distribution.

        Examples:
            >>> rooms = load("procthor-bedroom").sample(2, seed=1)
            >>> [room.name for room in rooms]
            ['seed1_0000', 'seed1_0001']
        """
        return synthesize(self.trained, count, seed, distribution)

    def interpolate(self, start: Point, end: Point, steps: int = 9) -> list[Scene]:
        """Rooms on the geodesic between two latents, both ends included.

        Args:
            start, end: A room with a latent, `"seed:7"`, a training room's id, a file of latents,
                or a vector.

        Raises:
            InputError: an end is no latent of this prior, or the two are opposite.

        Examples:
            >>> way = load("procthor-bedroom").interpolate("seed:1", "seed:2", steps=3)
            >>> [room.extra["along"] for room in way]
            [0.0, 0.5, 1.0]
        """
        return interpolate(self.with_latents, start, end, steps)

    def complete(
        self,
        scene: Scene,
        count: int = 4,
        seed: int = 0,
        distribution: str | None = None,
        classes: Sequence[str] | None = None,
    ) -> list[Scene]:
        """Furnish the rest of a room; what is given stays as it is.

        Args:
            scene: Its objects, and perhaps its floor, are given.
            count: Answers.
            classes: What to add, and nothing else; priors with a sampler alone.

        Raises:
            InputError: an object cannot be used, or there are more than rooms of the prior hold.

        Examples:
            >>> from sceneprior.scene import SceneObject
            >>> bed = SceneObject("double_bed", (0.0, 0.3, -1.0), (1.8, 0.6, 2.0))
            >>> given = Scene("mine", "front3d_bedroom", (bed,))
            >>> (room,) = load("procthor-bedroom").complete(given, count=1, classes=["nightstand"])
            >>> [item.label for item in room.objects]
            ['double_bed', 'nightstand']
        """
        return complete(self.with_latents, [scene], count, seed, distribution, classes=classes)[0]

    def reconstruct(
        self, images: Sequence[ObservedImage], fit: str = "objects", restarts: int = 1
    ) -> list[Reconstruction]:
        """Rooms (`.scene`) from the instance masks of single images.

        Args:
            images: From shards (`image_from_shards`) or files (`read_own_image`).
            fit: `objects`, one by one; or `paper` or `released`, which fit a latent to an image.
            restarts: Latents fitted to each image.

        Only priors with latents of their training rooms can: a run, or packed with `--latents`.

        Raises:
            InputError: other classes than the prior's, or it keeps no latents of training rooms.
        """
        return reconstruct(self.trained, images, FitOptions(fit, restarts))

    def latent(self, point: Point) -> Float[Tensor, " dimension"]:
        """The latent that an end of `interpolate` is; an `InputError` where it is none.

        Examples:
            >>> load("procthor-bedroom").latent("seed:1").shape
            torch.Size([128])
        """
        return latent_of(self.with_latents, point)

    def decode(self, z: Float[Tensor, "rooms dimension"]) -> DecodedScenes:
        """Decode latents to tensors (N predictions a room); gradients flow back to `z`.

        Raises:
            InputError: the prior has no latent space.

        Examples:
            >>> prior = load("procthor-bedroom")
            >>> z = prior.latent("seed:1").unsqueeze(0).requires_grad_()
            >>> prior.decode(z).sizes_m.sum().backward()
            >>> bool(z.grad.abs().max() > 0)
            True
        """
        trained = self.with_latents
        z = z.to(trained.logits.dtype)
        return trained.prior.decode(z, with_shape=trained.stage != "layout")

    @property
    def with_latents(self) -> TrainedPrior:
        """`trained`, where it has a latent space; else an `InputError`."""
        return with_latents(self.trained, self.where)
