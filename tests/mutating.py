"""Random damage to bytes, and to values inside a file; and a reader in a process of its own."""

import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

MUTATIONS = 300
MOST_BYTES = 6 * 2**30
"""Address space of a reader; torch alone reserves some of it."""
MOST_RESIDENT = 2 * 2**30
MOST_S = 300

DEEP = "@deep@"
JUNK: list[Any] = [
    None, True, False, 0, -1, 0.5, 10**400, 1e300, -1e300, 1e9, 1e5, 1e-300, float("nan"),
    float("inf"), "", "x", "1", "1e999", "nan", "\ud800", "\0", "[bold]", "x" * 5000, "../../up",
    [], {}, [None], [[]], {"a": 1}, ["1", "x"], [1e300] * 3, [float("nan")] * 4, 20_000, 2**31,
    2**63, 180.0, ["desk"] * 3, "Floor", DEEP, [DEEP], {"id": DEEP},
]  # fmt: skip
"""Values that replace others in files."""

WORDS = ("99", "-9", "0", "nan", "1e999", "x", "-1", "9" * 400, "", "\ufffd", "#", "= =", "\0")
"""Words that replace others in texts."""

_READER = """
import importlib.util, json, resource, sys
from pathlib import Path
from sceneprior.core.errors import InputError

spec = importlib.util.spec_from_file_location("reader", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
for name in sys.argv[3:]:
    print(json.dumps(["begun", name]), flush=True)
    try:
        getattr(module, sys.argv[2])(Path(name))
        said = ""
    except InputError as error:
        said = f"{type(error).__name__}: {error}"
    except Exception as error:
        said = f"RAW {type(error).__name__}: {str(error)[:200]}"
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps(["done", name, said, held]), flush=True)
"""


def damaged_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, or with a few bytes changed, removed, repeated or zeroed."""
    where = sorted(int(at) for at in rng.integers(0, len(data), 2))
    changed = bytearray(data)
    match int(rng.integers(6)):
        case 0:
            return data[: where[0]]
        case 1:
            del changed[where[0] : where[0] + int(rng.integers(1, 9))]
        case 2:
            changed[where[1] : where[1]] = changed[where[0] : where[0] + int(rng.integers(1, 99))]
        case 3:
            stop = min(len(data), where[0] + int(rng.integers(1, 64)))
            changed[where[0] : stop] = bytes(stop - where[0])
        case _:
            for at in rng.integers(0, len(data), int(rng.integers(1, 8))):
                changed[at] = rng.integers(256)
    return bytes(changed)


def damaged_words(text: str, rng: np.random.Generator) -> bytes:
    """With another word somewhere, a line gone or doubled, or damaged bytes."""
    if rng.random() < 0.3:
        return damaged_bytes(text.encode(), rng)
    lines = text.split("\n")
    at = rng.integers(len(lines))
    if rng.random() < 0.2:
        lines[at : at + 1] = [lines[at]] * (2 * int(rng.integers(2)))
    else:
        words = lines[at].split(" ")
        words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
        lines[at] = " ".join(words)
    return "\n".join(lines).encode()


def places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of a JSON document."""
    for key in list(data) if isinstance(data, dict) else range(len(data)):
        yield data, key
        if isinstance(data[key], dict | list):
            yield from places(data[key])


def damaged_json(data: Any, rng: np.random.Generator) -> str:
    """Up to three places: something else there, gone or doubled; at times all of it, or cut off."""
    data = json.loads(json.dumps(data))
    for _ in range(rng.integers(1, 4)):
        if not data:
            break
        found = list(places(data))
        # Long lists of numbers would take all the damage: choose among kinds of places first.
        kinds = sorted({str(key) if isinstance(key, str) else "#" for _, key in found})
        kind = kinds[rng.integers(len(kinds))]
        same = [item for item in found if (item[1] if isinstance(item[1], str) else "#") == kind]
        container, key = same[rng.integers(len(same))]
        action = rng.random()
        if action < 0.2:
            del container[key]
        elif action < 0.25 and isinstance(container, list):
            container += [container[key]] * int(rng.choice([1, 3]))
        else:
            container[key] = deepcopy(JUNK[rng.integers(len(JUNK))])
    if rng.random() < 0.05:
        data = JUNK[rng.integers(len(JUNK))]
    text = json.dumps(data).replace(json.dumps(DEEP), "[" * 3000 + "]" * 3000)
    return text[: rng.integers(len(text))] if rng.random() < 0.05 else text


def assert_one_sentence(script: str, function: str, paths: Sequence[Path]) -> list[str]:
    """Read files in a process with little memory: each is read, or refused in one sentence.

    Returns:
        What was said of each file; "" where it was read.
    """
    told = subprocess.run(
        [sys.executable, "-c", _READER, script, function, *map(str, paths)],
        capture_output=True, text=True, timeout=MOST_S,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES)),
    )  # fmt: skip
    lines = [json.loads(line) for line in told.stdout.splitlines() if line.startswith("[")]
    assert told.returncode == 0, f"{lines[-1:]} ended it: {told.stderr[-2000:]}"
    done = [line[1:] for line in lines if line[0] == "done"]
    assert len(done) == len(paths)
    for name, said, held in done:
        assert not said.startswith("RAW"), f"{name}: {said}"
        assert "\n" not in said and len(said) < 2500, f"{name}: {said[:3000]}"
        assert held < MOST_RESIDENT, f"{name}: {held / 2**30:.1f} GiB"
    return [said for _, said, _ in done]
