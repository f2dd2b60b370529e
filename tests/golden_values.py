"""Results that stay as they are, in `golden/`: whole texts, and plain data as JSON.

`TAKE=1 pytest ...` writes the golden files that the chosen tests compare with anew, and `TAKE=runs`
trains the kept runs (`kept_runs.py`), too.
"""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parent / "golden"
TAKE = bool(os.environ.get("TAKE"))
TAKE_RUNS = os.environ.get("TAKE") == "runs"
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def assert_text(name: str, text: str) -> None:
    """`text` is what the file `golden/<name>` holds."""
    path = FOLDER / name
    if TAKE:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert text == path.read_text()


def assert_as_before(name: str, found: Any, rel: float = 1e-5, abs: float = 1e-6) -> None:
    """`found`, made of plain data, is what `golden/<name>.json` holds.

    Words and whole numbers are compared exactly, other numbers within a tolerance, since their last
    digits differ between processors.
    """
    found = json.loads(json.dumps(found))
    if TAKE:
        _write(name, found)
    _compare(found, _known(name), name, rel, abs)


def hold(name: str, found: dict[str, Any], slack: float = 0.0, **hidden: object) -> None:
    """Each entry of `found` equals its entry in `golden/data_prep/<name>.json`.

    `slack` is the tolerance of numbers, in texts too, relative and absolute; parts of texts in
    `hidden` are replaced by their names.
    """
    name = f"data_prep/{name}"
    text = json.dumps(found)
    for word, value in hidden.items():
        text = text.replace(str(value), f"<{word}>")
    found = json.loads(text)
    if TAKE:
        _write(name, _known(name) | found)
    known = _known(name)
    _compare(found, {key: known[key] for key in found}, name, slack, slack, texts=slack > 0)


def _known(name: str) -> Any:
    path = FOLDER / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else {}


def _write(name: str, values: Any) -> None:
    path = FOLDER / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=1, sort_keys=True) + "\n")


def _compare(
    found: Any, known: Any, where: str, rel: float, abs: float, texts: bool = False
) -> None:
    if isinstance(known, dict):
        assert isinstance(found, dict) and found.keys() == known.keys(), where
        for key, value in known.items():
            _compare(found[key], value, f"{where}.{key}", rel, abs, texts)
    elif isinstance(known, list):
        assert isinstance(found, list) and len(found) == len(known), where
        for row, value in enumerate(known):
            _compare(found[row], value, f"{where}[{row}]", rel, abs, texts)
    elif isinstance(known, str) and texts:
        assert _NUMBER.sub("#", found) == _NUMBER.sub("#", known), where
        for one, other in zip(_NUMBER.findall(found), _NUMBER.findall(known), strict=True):
            assert float(one) == pytest.approx(float(other), rel=rel, abs=abs), where
    elif isinstance(known, float):
        assert found == pytest.approx(known, rel=rel, abs=abs), where
    else:
        assert found == known, where
