"""The interface between a data set (`Source`) and the engine.

A source reads the files of a data set and knows no shards or reports; the engine (build.py) handles
those and knows no data set. `front/source.py` is the source for 3D-FRONT.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from sceneprior.core.errors import InputError
from sceneprior.core.observations import RoomGroundTruth, RoomViews
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen import Renderer


@dataclass(frozen=True)
class RoomTask:
    """One room to prepare, as stored in `plan.json`."""

    room_id: str
    house: str
    """File or folder the room is read from: a house, a scan."""
    split: str
    """One of `SPLITS` of shards."""
    views: int = 0
    """Number of views to draw; 0 if the data set has its own."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Further JSON values that the source needs to read the room."""


@dataclass
class Line:
    """One line of the report: a room, or a house that could not be read."""

    room_id: str
    """Id of the room; the house's name if its list of rooms could not be read."""
    house: str
    status: str
    """`prepared`, `filtered` (excluded by a rule), or `failed` (the files are faulty)."""
    rule: str = ""
    """Name of the rule that filters the room: a rule of the recipe, or `split`, `no_view`, ..."""
    reason: str = ""
    """Sentence on why the room is not prepared."""
    split: str = ""
    views: int = 0
    objects: int = 0
    """Tracked objects: those visible in at least one view."""
    visible: int = 0
    """Objects visible in a view, summed over the views."""
    notes: list[str] = field(default_factory=list)
    """Parts of the room that were left out, with reasons."""
    classes: dict[str, int] = field(default_factory=dict)
    """Tracked objects of each class."""
    unknown_categories: dict[str, int] = field(default_factory=dict)
    """Number of pieces per unknown category; see `PreparedRoom`."""
    cameras: dict[str, Any] = field(default_factory=dict)
    """Origin of the cameras; see `PreparedRoom`."""


@dataclass(frozen=True)
class Survey:
    """Result of the first pass over the whole data set."""

    rooms: tuple[RoomTask, ...]
    """Rooms in the order of the shards, with unique ids."""
    left_out: tuple[Line, ...] = ()
    """Rooms, or whole houses, that are not prepared."""


@dataclass(frozen=True)
class PreparedRoom:
    """One room, ready to be written."""

    views: RoomViews
    truth: RoomGroundTruth | None = None
    """3D ground truth; None if the source has none."""
    models: Mapping[str, Mesh] = field(default_factory=dict)
    """Meshes by id, each in its own frame, for `models/<id>.ply`."""
    notes: tuple[str, ...] = ()
    """Parts of the room that were left out, with reasons."""
    unknown_categories: Mapping[str, int] = field(default_factory=dict)
    """Number of pieces per category that is void because the recipe does not mention it."""
    cameras: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the cameras, for `inspect --verify`: `file`, the name of the file of poses, and
    `room_from_world`, 4 rows of 4, the rigid transform from its world, in metres, to the room."""


class Source(Protocol):
    """A data set and its recipe: a frozen dataclass of paths and settings, sent to the workers.

    Methods may depend only on the source's fields and on the files, not on earlier calls or on the
    process they run in.

    Attributes:
        name: Name of the data set in `index.json`: "3d-front".
        label_set: Name of the label set, for `sceneprior.core.classes.label_set`.
        room_type: Type of the rooms; also in the shards' names: `train/<room_type>_0000.h5`.
        draws: True if `prepare` needs a renderer; otherwise it gets None.
        only: Requested part: HOUSE, HOUSE/ROOM or a room id (plan.py); None for everything.
        official: Origin of official counts and the counts, which the report compares with; or None.
    """

    @property
    def name(self) -> str: ...
    @property
    def label_set(self) -> str: ...
    @property
    def room_type(self) -> str: ...
    @property
    def draws(self) -> bool: ...
    @property
    def only(self) -> str | None: ...
    @property
    def official(self) -> tuple[str, dict[str, int]] | None: ...

    def settings(self, only: str | None) -> dict[str, Any]:
        """Settings that the shards' bytes depend on, as JSON, without paths.

        Called first, in the main process, so it also rejects wrong folders. A run may resume in a
        folder only if its settings are equal (`read_plan`). `index.json` repeats `recipe` and
        `seed`. `only` is the value of `--only` to assume: the source's own, or None for everything.
        """

    def survey(self) -> Survey:
        """Make one cheap pass over the data set (`run_tasks`) and list the rooms to prepare.

        Raises InputError if no room is left, or `train` is empty.
        """

    def prepare(self, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | Line:
        """Read one room and observe it in all its views, in a worker process.

        The result depends on the task alone, not on the worker or on earlier tasks. An exception
        counts as a failed room, like a `Line` with status "failed".
        """


def sentence_of(error: Exception) -> str:
    """Describe why a room failed; SCENEPRIOR_DEBUG=1 re-raises unexpected errors instead."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename} cannot be read ({error.strerror})"
    if os.environ.get("SCENEPRIOR_DEBUG"):
        raise error
    return " ".join(f"unforeseen {type(error).__name__}: {error}".split())[:300]
