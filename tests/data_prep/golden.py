"""Sentences and numbers as they were before the code moved, in `tests/golden/data_prep/`.

`TAKE_GOLDENS=1 pytest ...` writes those that changed.
"""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[1] / "golden" / "data_prep"
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def hold(name: str, found: dict[str, Any], slack: float = 0.0, **hidden: object) -> None:
    """Each entry of `found` equals its entry in the golden file `name`, up to numbers' last digits.

    Entries are texts, numbers, or lists and dicts of them. `slack` is the tolerance of numbers, in
    texts too, relative and absolute; parts of texts in `hidden` are replaced by their names.
    """
    path = FOLDER / f"{name}.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    text = json.dumps(found, sort_keys=True)
    for word, value in hidden.items():
        text = text.replace(str(value), f"<{word}>")
    found = json.loads(text)
    if os.environ.get("TAKE_GOLDENS"):
        known |= found
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
    for key, value in found.items():
        assert key in known, f"{key} is not in {path}"
        _compare(value, known[key], slack, f"{name}, {key}")


def _compare(found: Any, known: Any, slack: float, where: str) -> None:
    if isinstance(known, dict):
        assert isinstance(found, dict) and found.keys() == known.keys(), where
        for key, value in known.items():
            _compare(found[key], value, slack, f"{where}.{key}")
    elif isinstance(known, list):
        assert len(found) == len(known), where
        for one, other in zip(found, known, strict=True):
            _compare(one, other, slack, where)
    elif isinstance(known, str) and slack:
        assert _NUMBER.sub("#", found) == _NUMBER.sub("#", known), where
        pairs = zip(_NUMBER.findall(found), _NUMBER.findall(known), strict=True)
        for one, other in pairs:
            assert float(one) == pytest.approx(float(other), rel=slack, abs=slack), where
    elif isinstance(known, float):
        assert found == pytest.approx(known, rel=slack, abs=slack), where
    else:
        assert found == known, where
