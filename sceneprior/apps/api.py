"""The Python API, used by the commands: load a trained prior and generate rooms with it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sceneprior import __version__
from sceneprior.apps.config import load_any_run, weights_of
from sceneprior.apps.priors.packed import name_of, version_of
from sceneprior.apps.sample import Then, request_of, sample_rooms
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.parallel import map_blocks, once
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import DecodedScenes, ObservedImage
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import BATCH, Point, latent_of
from sceneprior.training.method import Trained, TrainedReconstructor

if TYPE_CHECKING:
    from sceneprior.apps.reconstruction.reconstruct import Reconstruction


def load(where: str | Path) -> "Prior":
    """Load a trained prior, on the CPU.

    Args:
        where: The folder of a run that `sceneprior fit` made; a file that `sceneprior pack` made;
            the name of a prior of the package (`sceneprior priors` lists them); or
            `hf://OWNER/NAME`, on the Hugging Face Hub.

    Raises:
        InputError: there is no prior, or it is damaged.

    Examples:
        >>> load("procthor-bedroom")
        Prior('procthor-bedroom', front3d_bedroom, rooms from: sampler)
    """
    return Prior(load_any_run(where), str(where))


@dataclass(frozen=True, repr=False)
class Prior:
    """A trained prior of rooms. Rooms are `Scene`s: classes, boxes and meshes in metres, y up.

    Runs of methods without a latent space (`atiss`, `sync2gen`, `set_flow`) can only `sample`.
    """

    trained: Trained
    """The trained networks, with their configuration."""
    where: str
    """The path or name from which the prior was loaded."""

    @cached_property
    def origin(self) -> dict[str, str]:
        """The provenance that rooms carry in `extra`: the prior's name (`prior`), the prior's
        version (`prior_version`, if its file exists; see `version_of`) and the package's
        (`sceneprior`).

        Examples:
            >>> origin = load("procthor-bedroom").origin
            >>> origin["prior"], len(origin["prior_version"])
            ('procthor-bedroom', 12)
        """
        try:
            version = {"prior_version": version_of(weights_of(self.where))}
        except (InputError, OSError):  # the file was deleted, or there was none
            version = {}
        return {"prior": name_of(self.where), **version, "sceneprior": __version__}

    def __reduce__(self) -> tuple[Any, ...]:
        return once, (load, self.where)  # each worker reads the weights itself

    def _drawn(self, given: dict[str, Any], then: Then | None, **told: Any) -> list[Scene]:
        """Rooms of `sample_rooms`, drawn in tasks of `BATCH` rooms; an error if all of them lack
        something that the request requires."""
        count = given["count"]
        # Other methods draw all their rooms at once.
        size = BATCH if isinstance(self.trained, TrainedPrior) else max(count, 1)
        title = "" if then is None else f"drawing rooms ({size} at a time)"
        draw = partial(_draw, self, given, told, then)
        rooms = map_blocks(draw, range(count), size, title)
        lacks = [room.extra["lacks"] for room in rooms if "lacks" in room.extra]
        if lacks and len(lacks) == len(rooms):
            said = f"No room holds the request: {lacks[0]}"
            raise InputError(f"{said} Ask for less, or for a larger floor.")
        return rooms

    def _told(self, rooms: Sequence[Scene], **more: Any) -> list[Scene]:
        """Rooms with `origin` and `more` added at the start of `extra`."""
        return [replace(room, extra={**self.origin, **more, **room.extra}) for room in rooms]

    def __repr__(self) -> str:
        return f"Prior({self.where!r}, {self.label_set}, rooms from: {self.distribution})"

    @property
    def label_set(self) -> str:
        """The name of the label set of the prior's classes."""
        return self.trained.config.label_set

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the prior's classes; the first, `void`, stands for unlabelled objects."""
        return tuple(label_set(self.label_set))

    @property
    def distribution(self) -> str:
        """The default distribution of `sample`."""
        return self.trained.distribution

    def sample(
        self,
        count: int = 1,
        seed: int = 0,
        distribution: str | None = None,
        floor: str | Sequence[Any] | np.ndarray | None = None,
        openings: str | Sequence[Any] | None = None,
        ceiling_m: float | None = None,
        want: str | Mapping[str, Any] | None = None,
        objects: Sequence[SceneObject] | None = None,
        cad: bool = False,
        then: Then | None = None,
    ) -> list[Scene]:
        """Sample new rooms; the same seed gives the same rooms.

        Args:
            distribution: `sampler`, or a distribution of latents: `paper` or `kernel`.
            floor: Requested floor: `"4x3"` (metres along x and z), a list of corners [x, z], or
                a file with a floor.
            openings: Requested doors and windows, such as `"door,window@north"`, or a list.
            ceiling_m: Requested height of the ceiling.
            want: Wishes: a sentence, or numbers of objects by class, such as
                `{"nightstand": 2, "desk": 0}`.
            objects: Objects that are already in the room, in the coordinates of the floor.
            cad: Replace decoded meshes by the most similar models of the package's own furniture
                (docs/uses.md); given objects with a mesh keep it.
            then: Function of some rooms and the number of the first, which is called in the
                processes that draw them (docs/cluster.md); its results are returned instead.

        Requests need a prior with a sampler; see docs/requests.md. `extra["wishes"]` of a room
        lists each wish, the floor, openings and ceiling, and whether they hold.

        Raises:
            InputError: the prior has no such distribution, or no room can satisfy the request.

        Examples:
            >>> prior = load("procthor-bedroom")
            >>> [room.name for room in prior.sample(2, seed=1)]
            ['seed1_0000', 'seed1_0001']
            >>> (room,) = prior.sample(floor="4x3", want={"nightstand": 2})
            >>> [item.label for item in room.objects].count("nightstand"), room.floor_m.shape
            (2, (4, 2))
            >>> (room,) = prior.sample(seed=1, cad=True)
            >>> room.objects[0].label, room.extra["retrieval"][0]["model_id"][:11]
            ('double_bed', 'double_bed_')
        """
        asked = {
            "floor": floor, "openings": openings, "ceiling_m": ceiling_m, "want": want,
            "objects": objects,
        }  # fmt: skip
        models, request = _models(objects or ()) if cad else None, request_of(asked)
        given = {
            "count": count, "seed": seed, "distribution": distribution, "request": request,
            "with_models": models,
        }  # fmt: skip
        return self._drawn(given, then, seed=seed, distribution=distribution or self.distribution)

    def interpolate(self, start: Point, end: Point, steps: int = 9) -> list[Scene]:
        """Rooms on the geodesic between two latents, both ends included.

        Args:
            start, end: A room with a latent, `"seed:7"`, a training room's id, a file of latents,
                or a vector.

        Raises:
            InputError: an end is not a latent of this prior, or the two ends are antipodal.

        Examples:
            >>> way = load("procthor-bedroom").interpolate("seed:1", "seed:2", steps=3)
            >>> [room.extra["along"] for room in way]
            [0.0, 0.5, 1.0]
        """
        from sceneprior.paper.interpolate import interpolate

        return self._told(interpolate(self.with_latents, start, end, steps))

    def complete(
        self,
        scene: Scene,
        count: int = 4,
        seed: int = 0,
        classes: Sequence[str] | None = None,
        want: str | Mapping[str, Any] | None = None,
        floor: str | Sequence[Any] | np.ndarray | None = None,
        openings: str | Sequence[Any] | None = None,
        ceiling_m: float | None = None,
        cad: bool = False,
        then: Then | None = None,
    ) -> list[Scene]:
        """Complete a partly furnished room by the prior's sampler; given objects stay unchanged.

        Args:
            scene: The given objects and, optionally, the floor, doors, windows and ceiling.
            count: Number of completions.
            classes: Classes of the objects to add, and no others.
            want: Wishes for the whole room, as in `sample`.
            floor: Requested floor, as in `sample`, in the coordinates of the given objects. It
                replaces the scene's floor with its doors, windows and ceiling.
            openings: Requested doors and windows, in place of the scene's.
            ceiling_m: Requested height of the ceiling, in place of the scene's.
            cad: Replace decoded meshes by models of the package's own furniture, as in `sample`.
            then: As in `sample`.

        Raises:
            InputError: an object cannot be used, there are more objects than the prior generates,
                or the prior has no sampler.

        Examples:
            >>> from sceneprior.core.scene import SceneObject
            >>> bed = SceneObject("double_bed", (0.0, 0.3, -1.0), (1.8, 0.6, 2.0))
            >>> given = Scene("mine", "front3d_bedroom", (bed,))
            >>> (room,) = load("procthor-bedroom").complete(given, count=1, classes=["nightstand"])
            >>> [item.label for item in room.objects]
            ['double_bed', 'nightstand']
        """
        asked = {"want": want, "floor": floor, "openings": openings, "ceiling_m": ceiling_m}
        asked = {key: value for key, value in asked.items() if value is not None}
        if asked and classes is not None:
            raise InputError(
                "`classes` lists the classes to add, but the request also has "
                f"{', '.join(sorted(asked))}; name the classes in its wishes (want) instead."
            )
        own: dict[str, Any] = {"objects": scene.objects}
        if floor is None:
            own |= {"floor": scene.floor_m, "openings": scene.openings or None}
            own |= {"ceiling_m": scene.ceiling_m}
        request = request_of({**own, **asked})
        models = _models(scene.objects) if cad else None
        given = {
            "count": count, "seed": seed, "request": request, "completes": True,
            "classes": classes, "with_models": models,
        }  # fmt: skip
        return self._drawn(given, then, seed=seed)

    def reconstruct(
        self, images: Sequence[ObservedImage], fit: str = "objects", restarts: int = 1
    ) -> "list[Reconstruction]":
        """Reconstruct rooms (`.scene`) from the instance masks of single images.

        The prior needs the latents of its training rooms: it must be a run, or packed with
        `--latents`.

        Args:
            images: Images from shards (`image_from_shards`) or files (`read_own_image`).
            fit: `objects` fits object by object; `paper` fits a latent to each image.
            restarts: Number of latents fitted to each image.

        Raises:
            InputError: the images have another label set, or the prior lacks the latents.
        """
        from sceneprior.apps.reconstruction.reconstruct import reconstruct

        return reconstruct(self, images, fit, restarts)

    def latent(self, point: Point) -> Float[Tensor, " dimension"]:
        """The latent of a room, given like an end of `interpolate`.

        Raises:
            InputError: the point is not a latent of this prior.

        Examples:
            >>> load("procthor-bedroom").latent("seed:1").shape
            torch.Size([128])
        """
        return latent_of(self.with_latents, point)

    def decode(self, z: Float[Tensor, "rooms dimension"]) -> DecodedScenes:
        """Decode latents to tensors (N predictions per room), differentiable in `z`.

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
        """Return `trained`; raise InputError if, as those of baselines, it has no latent space."""
        if isinstance(self.trained, TrainedPrior):
            return self.trained
        works = "synthesize`, `eval-fid` and `report"
        if isinstance(self.trained, TrainedReconstructor):
            works = "reconstruct` and `eval-svr"
        raise InputError(
            f"{self.where} is a run of `method: {self.trained.config.method}`, which has no latent "
            "space of rooms, and this command needs one. Use a run of `method: paper` or `lifted`; "
            f"this run works with `sceneprior {works}`."
        )


def _draw(
    prior: Prior, given: Any, told: Any, then: Then | None, rows: range, first: int
) -> list[Scene]:
    rooms = prior._told(sample_rooms(prior.trained, rows=rows, **given), **told)
    return rooms if then is None else then(rooms, first)


def _models(given: Sequence[SceneObject]) -> Callable[[list[Scene]], list[Scene]]:
    from sceneprior.apps.retrieval.retrieve import with_models

    return partial(with_models, given=given)
