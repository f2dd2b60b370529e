"""A room's table of classes and a label set in; what each value of its masks means out."""

from collections import Counter
from pathlib import Path

import numpy as np

from data_prep.posed.labels import SHELL, read_classes, tidy
from sceneprior.classes import label_set
from sceneprior.errors import InputError


class IdTable:
    """Values of masks -> consecutive ids: k + 1 for the k-th instance of the table, then one more
    for what is not in it, which hides what is behind it as void furniture does."""

    def __init__(self, folder: Path, label_set_name: str):
        names = {tidy(name): i for i, name in enumerate(label_set(label_set_name))}
        of_id = read_classes(folder)
        shell = [
            key for key, name in of_id.items() if tidy(name) in SHELL and tidy(name) not in names
        ]
        objects = sorted(set(of_id) - set(shell))
        indices = [names.get(tidy(of_id[key]), 0) for key in objects]
        self.classes = np.array([*indices, 0], dtype=np.int16)
        self.is_object = self.classes > 0
        if not self.is_object.any():
            came = ", ".join(sorted({of_id[key] for key in of_id})[:10])
            raise InputError(
                f"{folder}: none of its classes ({came}) is in the label set "
                f"({', '.join(list(names)[1:11])}{', ...' if len(names) > 11 else ''})."
            )
        others = Counter(of_id[key] for key in objects if tidy(of_id[key]) not in names)
        self.notes = [
            f"classes outside the label set are void: "
            f"{', '.join(f'{name} ({count})' for name, count in sorted(others.items()))}"
        ] * bool(others)
        self.strange: set[int] = set()
        self._unknown = len(objects) + 1
        # The last entry is that of -1.
        self._table = np.full(65_537, self._unknown, dtype=np.uint32)
        self._table[[0, *shell]] = 0
        self._table[objects] = np.arange(1, len(objects) + 1)
        self._listed = np.array([-1, 0, *of_id])

    def ids(self, values: np.ndarray) -> np.ndarray:
        """(H, W) uint32 for `observe`; remembers values that the table does not have."""
        self.strange |= set(np.setdiff1d(values, self._listed).tolist())
        return self._table[values]
