"""Results that stay as they are: nested numbers and words in `golden/NAME.json`.

Words and whole numbers are compared exactly, other numbers within a tolerance, since their last
digits differ between processors. `TAKE_GOLDEN=1 pytest ...` writes the files anew.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parent / "golden"


def assert_as_before(name: str, found: Any, rel: float = 1e-5, abs: float = 1e-6) -> None:
    """`found`, made of plain data, is what `golden/<name>.json` holds."""
    path, found = FOLDER / f"{name}.json", json.loads(json.dumps(found))
    if os.environ.get("TAKE_GOLDEN"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=1) + "\n")
    _compare(found, json.loads(path.read_text()), name, rel, abs)


def _compare(found: Any, kept: Any, where: str, rel: float, abs: float) -> None:
    if isinstance(kept, dict) and isinstance(found, dict):
        assert list(found) == list(kept), where
        for key, value in kept.items():
            _compare(found[key], value, f"{where}.{key}", rel, abs)
    elif isinstance(kept, list) and isinstance(found, list):
        assert len(found) == len(kept), where
        for row, value in enumerate(kept):
            _compare(found[row], value, f"{where}[{row}]", rel, abs)
    elif isinstance(kept, float):
        assert found == pytest.approx(kept, rel=rel, abs=abs), where
    else:
        assert found == kept, where
