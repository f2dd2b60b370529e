"""What a data set tells the engine (`Source`), and what the engine asks of it.

A source knows a data set's files and nothing of processes, shards and reports; the engine
(build.py) knows those and nothing of data sets. 3D-FRONT's is `front/source.py`.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from data_prep.engine.workers import Run
from sceneprior.errors import InputError
from sceneprior.offscreen import Renderer
from sceneprior.scene import Mesh
from sceneprior.settings import Section
from sceneprior.shards import RoomGroundTruth, RoomViews

SPLITS = ("train", "val", "test")
"""Rooms to learn from, to choose settings and checkpoints on, and to report results on."""
_DEBUG_VARIABLE = "SCENEPRIOR_DEBUG"


class Expected(Section):
    """The known counts of a finished job on the real data set."""

    of: str = ""
    """Which data these counts are of, and who counted: "3D-FRONT, ATISS's index"."""
    rooms: int | None = None
    """Prepared rooms."""
    train: int | None = None
    val: int | None = None
    test: int | None = None
    """Prepared rooms of the split."""
    views: int | None = None
    objects: int | None = None


@dataclass(frozen=True)
class RoomTask:
    """One room worth preparing, as `plan.json` keeps it."""

    room_id: str
    house: str
    """The file or folder the room is read from: a house, a scan."""
    split: str
    """train or test."""
    views: int = 0
    """How many views to draw; 0 where the data set has its own."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Whatever else the source needs to read the room; plain JSON."""


@dataclass(frozen=True)
class LeftOut:
    """A room, or a whole house, that gives nothing, and why."""

    room_id: str
    """The house's name where not even its rooms could be read."""
    house: str
    status: Literal["filtered", "failed"]
    """filtered: a rule says so, all is well; failed: something is wrong with the files."""
    reason: str
    """A sentence."""
    rule: str = ""
    """What filters it: a rule of the recipe by its name, or `split`, `no_view`, ..."""
    notes: tuple[str, ...] = ()
    unknown_categories: Mapping[str, int] = field(default_factory=dict)
    """As in `PreparedRoom`."""


@dataclass(frozen=True)
class Survey:
    """What a first look at the whole data set found."""

    rooms: tuple[RoomTask, ...]
    """In the order in which shards hold them; each id once."""
    left_out: tuple[LeftOut, ...] = ()


@dataclass(frozen=True)
class PreparedRoom:
    """One room, ready to be written."""

    views: RoomViews
    truth: RoomGroundTruth | None = None
    """None where the source does not know the room in 3D."""
    models: Mapping[str, Mesh] = field(default_factory=dict)
    """Id -> mesh in its own frame, for `models/<id>.ply`."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """More files: path within the output folder -> bytes (`rgb/<room>/0000.png`)."""
    notes: tuple[str, ...] = ()
    """What was left out of the room, and why."""
    unknown_categories: Mapping[str, int] = field(default_factory=dict)
    """What the data set calls furniture that is void because the recipe says nothing about it ->
    how many pieces."""


class Source(Protocol):
    """A data set under a recipe. A frozen dataclass of paths and settings: it travels to workers.

    What a method does may depend on the source's fields, on the files, and on nothing else: not on
    what was asked before, nor on the process it runs in.
    """

    @property
    def name(self) -> str:
        """The data set, as `index.json` calls it: "3d-front"."""

    @property
    def label_set(self) -> str:
        """As `sceneprior.classes.label_set` takes it."""

    @property
    def room_type(self) -> str:
        """What shards are called after, too: `train/<room_type>_0000.h5`."""

    @property
    def draws(self) -> bool:
        """Whether `prepare` wants a renderer; without, it is given None."""

    @property
    def only(self) -> str | None:
        """HOUSE, HOUSE/ROOM or a room id, where not everything is wanted (selection.py)."""

    @property
    def expected(self) -> Expected | None:
        """The counts that the recipe expects, for the report."""

    def settings(self, only: str | None) -> dict[str, Any]:
        """What the shards' bytes depend on, as JSON; paths do not belong there.

        Called first of all, in the main process, so it also refuses wrong folders. A run goes on
        with a folder whose settings are equal. `recipe` and `seed` are repeated in `index.json`.

        Args:
            only: As if this had been asked for; the source's own, or None for everything.

        Raises:
            InputError: the data set is not where the source says.
        """

    def survey(self, run: Run) -> Survey:
        """Look at everything once, cheaply, and say which rooms are worth preparing.

        Args:
            run: `run(function, argument_lists, title)` does the work in worker processes and
                yields the results in order.

        Raises:
            InputError: nothing is left, or a split is empty.
        """

    def prepare(self, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | LeftOut:
        """Read one room and see it through its cameras, in a worker process.

        The same task gives the same arrays, whatever was prepared before, and wherever. Raising
        instead of returning LeftOut is fine, too: the engine makes a failed room of it.
        """


def sentence_of(error: Exception) -> str:
    """Why a room failed, in words; SCENEPRIOR_DEBUG=1 lets what is unforeseen through."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename} cannot be read ({error.strerror})"
    if os.environ.get(_DEBUG_VARIABLE):
        raise error
    return " ".join(f"unforeseen {type(error).__name__}: {error}".split())[:300]
