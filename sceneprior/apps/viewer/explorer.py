"""The viewer's rooms, without a page: those of a trained prior, with a map of its latent space, or
those of a folder of scenes, and their files for download."""

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.apps.api import Prior
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import ShellName
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.interchange.export import SIMULATORS, export_scenes
from sceneprior.lifted.config import SAMPLER, TrainedLifted
from sceneprior.paper.interpolate import RoomPath, even_places
from sceneprior.paper.prior import LatentSpace, LatentSphere, TrainedPrior
from sceneprior.paper.sampling import (
    DISTRIBUTIONS,
    decode_latents,
    named_latent,
    with_training_latents,
)
from sceneprior.render.scene_files import check_names, save

FORMATS = {
    "GLB": ".glb", "JSON": ".json", "OBJ": "obj", "USD": "usd", "MuJoCo (MJCF)": "mujoco",
    "Habitat": "habitat", "SceneEval": "sceneeval", "ATISS": "atiss", "3D-FRONT": "threed-front",
}  # fmt: skip
"""Formats of downloads: endings for `save`, or formats of `export_scenes`."""
PATH_STEPS = 49
"""Number of rooms of a path with both ends; neighbours are rarely more than 4 degrees apart."""
HERE = "here"
"""Text that names the shown room as an end of a path."""
NOTHING_ASKED: Mapping[str, Any] = MappingProxyType({})
MARGIN = 0.12
"""Margin around the outermost training rooms, as a share of the map's side."""
RIM = 0.999
"""Largest distance from the origin on the map of a sphere. At the rim, distance 1, the latent's
other coordinates would all become 0."""
SNAP = 0.02
"""Distance within which a click selects a training room, as a share of the map's side."""


@dataclass(frozen=True)
class LatentMap:
    """Orthographic projection of the latent space: latent z is at the point (a_1 . z, a_2 . z).

    The orthonormal axes a_1 and a_2 are the first two principal components of the training rooms'
    latents, so no other plane shows more of their variance. A great circle projects to an arc of an
    ellipse. Moving over the map changes two coordinates and keeps the others in proportion. A click
    on a training room's dot gives that room itself.
    """

    space: LatentSpace
    axes: Float[Tensor, "2 dimension"]
    rooms: Float[Tensor, "rooms 2"]
    """Map points of the training rooms."""
    share: float
    """Explained variance: the share of the latents' variance along the two axes, 0 to 1."""
    middle: tuple[float, float]
    side: float
    """Side of the square that the map shows, which contains all training rooms."""

    def place(self, z: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms 2"]:
        """Map points of latents."""
        return z @ self.axes.T

    def moved(
        self, z: Float[Tensor, " dimension"], point: tuple[float, float]
    ) -> Float[Tensor, " dimension"]:
        """Move latent z to a point of the map, keeping its other coordinates.

        On the sphere the other coordinates are scaled so that the length stays 1, and a point
        beyond the rim is moved to it.
        """
        here = torch.tensor(point, dtype=z.dtype)
        rest = z - self.axes.T @ (self.axes @ z)
        if isinstance(self.space, LatentSphere):
            here = here * (RIM / here.norm().clamp(min=RIM))
            rest = rest * ((1 - here.square().sum()).sqrt() / rest.norm().clamp(min=1e-6))
        return self.space.onto((rest + self.axes.T @ here).unsqueeze(0))[0]

    def room_at(self, point: tuple[float, float]) -> int | None:
        """The training room that a click at a point selects; None if no dot is near."""
        apart = (self.rooms - torch.tensor(point, dtype=self.rooms.dtype)).norm(dim=1)
        row = int(apart.argmin())
        return row if float(apart[row]) <= SNAP * self.side else None


def make_map(space: LatentSpace, z: Float[Tensor, "rooms dimension"]) -> LatentMap:
    """Make the map of a latent space from the training rooms' latents z.

    Example: on the sphere in three dimensions, rooms differ most along x, then along y.

        >>> space = LatentSphere(4, 3)
        >>> z = [[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.3, 0.954], [0.0, -0.3, 0.954]]
        >>> latent_map = make_map(space, torch.tensor(z))
        >>> latent_map.rooms[0].abs().tolist()
        [0.6000000238418579, 0.0]
        >>> latent_map.moved(torch.tensor(z[0]), (0.0, 0.0)).tolist()
        [0.0, 0.0, 1.0]
    """
    if len(z) < 3:
        raise InputError(
            f"A map of the latent space needs at least 3 training rooms, and this prior knows "
            f"{len(z)}; sample rooms instead."
        )
    _, scale, directions = torch.linalg.svd(z - z.mean(dim=0), full_matrices=False)
    # The signs of singular vectors are arbitrary: the largest entry becomes positive.
    largest: Int[Tensor, "2 1"] = directions[:2].abs().argmax(dim=1, keepdim=True)
    axes = directions[:2] * directions.gather(1, largest).sign()
    rooms = z @ axes.T
    low, high = rooms.amin(dim=0), rooms.amax(dim=0)
    side = max(float((high - low).max()), 1e-3) * (1 + 2 * MARGIN)
    share = float(scale[:2].square().sum() / scale.square().sum().clamp(min=1e-12))
    x, y = ((low + high) / 2).tolist()
    return LatentMap(space, axes, rooms, share, (x, y), side)


def name_and_size(item: SceneObject) -> str:
    """Text of an object's label: class name, and width, height and depth in metres.

    >>> name_and_size(SceneObject("double_bed", (0.0, 0.5, 0.0), (1.8, 1.0, 2.1)))
    'double bed 1.80 x 1.00 x 2.10 m'
    """
    return item.label.replace("_", " ") + " {:.2f} x {:.2f} x {:.2f} m".format(*item.size_m)


@dataclass
class Display:
    """Choices of what is shown with a room."""

    shell: ShellName
    """Parts of the room itself. If neither floor nor walls are shown, a grid is."""
    names: bool = False
    """Names and sizes of all objects."""
    boxes: bool = False
    models: bool = False
    """CAD models in place of the meshes of the prior or of the scene files."""


@dataclass(frozen=True)
class Shown:
    """The shown room."""

    scene: Scene
    origin: str
    """Origin of the room, in words."""
    kept: frozenset[int] = frozenset()
    """Indices of the objects that the next completion keeps."""

    def toggled(self, item: int) -> "Shown":
        """The same room with `kept` toggled for an object."""
        return replace(self, kept=self.kept ^ {item})

    def given(self) -> Scene:
        """The scene of the kept objects alone."""
        objects = tuple(self.scene.objects[item] for item in sorted(self.kept))
        return replace(self.scene, objects=objects, extra={}, latent=None)


class Folder:
    """A folder of scenes, made by any method."""

    def __init__(self, scenes: Sequence[Scene]):
        self.scenes = tuple(scenes)

    @property
    def label_set(self) -> str:
        """The label set of all scenes; several are an InputError."""
        return common_label_set(self.scenes)

    def room(self, row: int) -> Shown:
        """The scene at an index."""
        scene = self.scenes[row]
        return Shown(scene, f"{scene.name}, {row + 1} of {len(self.scenes)}")


class Explorer:
    """Rooms of a trained prior: sampled, at a map point, along a path, or completed."""

    def __init__(self, prior: Prior):
        self.prior = prior
        self.label_set = prior.label_set
        self.map: LatentMap | None = None
        self.without_map = ""
        """The reason if there is no map, else empty."""
        try:
            self.map = make_map(prior.with_latents.prior.latent_space, self._training_z)
        except InputError as error:
            self.without_map = str(error)
        self.path: RoomPath | None = None

    @property
    def has_latents(self) -> bool:
        """True if rooms are decoded from latents, as paths need."""
        return isinstance(self.prior.trained, TrainedPrior)

    @cached_property
    def _training_z(self) -> Float[Tensor, "rooms dimension"]:
        trained = with_training_latents(self.prior.with_latents, "The map")
        return trained.prior.latent_space(trained.logits)

    @property
    def distributions(self) -> tuple[str, ...]:
        """Distributions of latents for new rooms, the default first; empty without latents."""
        trained = self.prior.trained
        if not isinstance(trained, TrainedPrior):
            return ()
        known = DISTRIBUTIONS if len(trained.logits) > 1 else ("paper",)
        if isinstance(trained, TrainedLifted) and trained.sampler is not None:
            known = (SAMPLER, *known)
        own = trained.distribution if trained.distribution in known else known[0]
        return (own, *(name for name in known if name != own))

    @property
    def takes_requests(self) -> bool:
        """True if a sampler draws rooms, as requests and completion need."""
        return SAMPLER in self.distributions

    def sample(
        self,
        seed: int,
        distribution: str | None = None,
        asked: Mapping[str, Any] = NOTHING_ASKED,
    ) -> Shown:
        """Sample a new room, by default from the first of `distributions`.

        It equals the room of `sceneprior synthesize -n 1 --seed SEED` with the same request.

        Args:
            asked: Arguments of `Prior.sample` for a requested room.
        """
        distribution = distribution or next(iter(self.distributions), None)
        if asked and distribution != SAMPLER:
            raise InputError(
                f"Rooms from {distribution} answer no requests; choose {SAMPLER} under From, or "
                "clear the request."
            )
        origin = distribution or self.prior.trained.config.method
        scene = self.prior.sample(1, seed, distribution, **asked)[0]
        return Shown(scene, f"seed {seed}, from: {origin}{', as requested' if asked else ''}")

    def complete(self, shown: Shown, seed: int, want: str = "") -> Shown:
        """Complete the room around the kept objects, with wishes if there are any.

        The shown room's floor, doors, windows and ceiling also stay.
        """
        room = self.prior.complete(shown.given(), 1, seed, want=want or None)[0]
        kept = frozenset(range(len(shown.kept)))
        return Shown(room, f"completed around {len(kept)} kept objects, seed {seed}", kept)

    def training_room(self, row: int) -> Shown:
        """A training room as the prior decodes it."""
        room_id = self.prior.trained.room_ids[row]
        return self._decoded(self._training_z[row], room_id, f"training room {room_id}, decoded")

    def at(self, shown: Shown, point: tuple[float, float], click: bool = False) -> Shown:
        """The room at a map point, which keeps the shown room's other latent coordinates.

        A click on a training room's dot gives that room.
        """
        assert self.map is not None, "there is a map to point at"
        if click and (row := self.map.room_at(point)) is not None:
            return self.training_room(row)
        latent = shown.scene.latent
        start = self._training_z[0] if latent is None else self.prior.latent(latent)
        z = self.map.moved(start, point)
        x, y = self.map.place(z.unsqueeze(0))[0].tolist()
        return self._decoded(z, "from_the_map", f"map {x:+.3f}, {y:+.3f}")

    def _decoded(self, z: Float[Tensor, " dimension"], name: str, origin: str) -> Shown:
        rooms = decode_latents(self.prior.with_latents, z.unsqueeze(0), [name])
        return Shown(rooms[0], origin)

    def draw_path(self, shown: Shown, start: str, end: str) -> Float[Tensor, "steps dimension"]:
        """Set the path of `step`, and return its latents from start to end.

        An end is a training room's id, `paper:7` (New room's seed 7 from `paper`) or `HERE`. Files
        are not accepted, since the text comes from a browser, which may run on another machine.
        """
        ends = [
            self.prior.latent(shown.scene)
            if text.strip() == HERE
            else named_latent(self.prior.with_latents, text.strip(), f"{HERE}, the shown room")
            for text in (start, end)
        ]
        path = RoomPath(self.prior.with_latents, ends[0], ends[1])
        z = path.latents(even_places(PATH_STEPS))
        self.path = path
        return z

    def step(self, number: int) -> Shown:
        """The room at a step of the path, counted from 0."""
        assert self.path is not None, "a path is drawn first"
        place = even_places(PATH_STEPS)[[number]]
        (room,) = self.path.rooms(place, [f"step_{number:02d}"])
        return Shown(room.scene, f"path, step {number} of {PATH_STEPS - 1}")


def download(scene: Scene, form: str, shell: ShellName) -> tuple[str, bytes, list[str]]:
    """The name of a room's file, its bytes, and notes for the user; several files are zipped.

    Args:
        form: One of `FORMATS`.
        shell: Parts of the room itself to write, in the formats that leave a choice.

    Raises:
        InputError: the room cannot be written, or a package for it is not installed.
    """
    check_names([scene])
    to, notes = FORMATS[form], []
    with TemporaryDirectory() as name:
        folder = Path(name)
        if to.startswith("."):
            save(scene, folder / f"{scene.name}{to}", shell=shell)
        else:
            chosen = shell if to in (*SIMULATORS, "obj") else None
            notes = export_scenes([scene], to, folder, chosen)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if len(files) == 1 and files[0].parent == folder:
            return files[0].name, files[0].read_bytes(), notes
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for path in files:
                # The entry has no date of today, so that the same room is the same file.
                entry = zipfile.ZipInfo(path.relative_to(folder).as_posix())
                archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)
    return f"{scene.name}_{to}.zip", packed.getvalue(), notes
