"""Interface for reading masks, implemented for each tool that writes masks."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

import numpy as np

from data_prep.readers.posed.recording import PosedFrame
from sceneprior.core.checked import plain

_LISTED = 3


class MaskFormat(ABC):
    """The masks of one room in one tool's format.

    `folder` is the room's folder. `label_set_name` decides whether walls and floors are objects, in
    formats that distinguish them from objects.
    """

    name: ClassVar[str]
    """Value of `--from`."""
    title: ClassVar[str]
    """Name of the tool, and files or folders of the masks, for messages."""

    def __init__(self, folder: Path, label_set_name: str):
        self.folder, self.label_set_name = folder, label_set_name
        self.notes: list[str] = []

    @property
    def tracked(self) -> bool:
        """False if the ids belong to single images, whatever the option `--tracks` says."""
        return True

    @classmethod
    @abstractmethod
    def find(cls, folder: Path) -> list[Path]:
        """All mask files of a room; empty if the room has no masks in this format."""

    @abstractmethod
    def has(self, frame: PosedFrame) -> bool:
        """True if the frame has masks, even if they show no object."""

    @abstractmethod
    def wanted(self, frame: PosedFrame) -> str:
        """Description, for messages, of the expected file of a frame's masks, and of what exists
        instead."""

    @abstractmethod
    def size(self, frame: PosedFrame) -> tuple[int, int]:
        """Size of a frame's masks, (height, width)."""

    @abstractmethod
    def read(self, frame: PosedFrame) -> np.ndarray:
        """Ids of a frame, (height, width) integers, 0 for background."""

    @abstractmethod
    def classes(self) -> dict[int, str]:
        """Class of each id, if ids are the same in all frames."""

    def frame_classes(self, frame: PosedFrame) -> dict[int, str]:
        """Class of each id of one frame, if ids belong to single frames."""
        return self.classes()


def main_classes(of_frames: Iterable[dict[int, str]]) -> tuple[dict[int, str], list[str]]:
    """The most frequent class of each id over all frames, and a note on ids with several
    classes."""
    votes: dict[int, Counter[str]] = {}
    for classes in of_frames:
        for number, name in classes.items():
            votes.setdefault(number, Counter())[name] += 1
    changing = [
        f"{number} ({', '.join(f'{plain(name)} {k}' for name, k in count.most_common())})"
        for number, count in sorted(votes.items())
        if len(count) > 1
    ]
    notes = [f"ids with several classes take the most frequent one: {_some(changing)}"]
    most = {number: count.most_common(1)[0][0] for number, count in sorted(votes.items())}
    return most, notes if changing else []


def instead(names: Iterable[str]) -> str:
    """Describe the names that exist where another name was expected, if there are any."""
    listed = [plain(name) for name in sorted(names)]
    return f", but there is {_some(listed)}: give masks the names of their frames" if listed else ""


def _some(words: list[str]) -> str:
    return ", ".join(words[:_LISTED]) + (", ..." if len(words) > _LISTED else "")
