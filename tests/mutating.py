"""Random damage to bytes, words and values, by a file's type."""

import io
import json
import struct
import zipfile
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

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

ODD_YAML = (
    "*a", "&a [*a]", "[[[[", "{a: {b: {c: 1}}}", "!!set {1, 2}", "!!binary aGVsbG8=", ".nan", "-1",
    "99999999999999999999999", "2001-99-99", "~", "'", '"\\x0', "? [1]",
    "[" * 3000, "x" * 5000, "1e400", "!!python/object:os.system 1", "<<: *a",
)  # fmt: skip
"""Values of settings that replace others."""


def damaged(path: Path, whole: bytes, rng: np.random.Generator) -> bytes:
    """The contents of a file, damaged as its type suggests."""
    if rng.random() < 0.1 or not whole:
        return damaged_bytes(whole or b"0", rng)
    match path.suffix:
        case ".json" | "":
            return damaged_json(json.loads(whole), rng).encode()
        case ".yaml":
            return damaged_yaml(whole.decode(), rng)
        case ".txt" | ".csv" | ".tsv" | ".obj" | ".ply":
            if b"\0" in whole or rng.random() < 0.05:
                long = b"x" * 140_000  # as long as no cell is
                return damaged_bytes(whole, rng) if b"\0" in whole else long + whole
            return damaged_words(whole.decode(), rng)
        case ".glb" if rng.random() < 0.7:
            return damaged_glb(whole, rng)
        case ".npz" if rng.random() < 0.6:
            return damaged_arrays(whole, rng)
        case ".ckpt" if rng.random() < 0.6:
            return damaged_tensors(whole, rng)
        case ".prior" if rng.random() < 0.6:
            return damaged_prior(whole, rng)
        case _:
            return damaged_bytes(whole, rng)


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


def damaged_yaml(text: str, rng: np.random.Generator) -> bytes:
    """With some values exchanged for odd ones, some lines moved."""
    lines = text.splitlines()
    for _ in range(int(rng.integers(1, 4))):
        at, other = rng.integers(0, len(lines), 2)
        key, colon, _ = lines[at].partition(":")
        match int(rng.integers(4)):
            case 0:
                lines[at], lines[other] = lines[other], lines[at]
            case 1:
                lines[at] = "  " + lines[at]
            case _:
                lines[at] = f"{key}{colon} {ODD_YAML[rng.integers(len(ODD_YAML))]}"
    return "\n".join(lines).encode()


def damaged_glb(glb: bytes, rng: np.random.Generator) -> bytes:
    """With damaged JSON, or damaged binary data, in chunks of the right lengths."""
    length = struct.unpack("<I", glb[12:16])[0]
    text, binary = glb[20 : 20 + length], glb[20 + length :]
    if rng.random() < 0.6:
        text = damaged_json(json.loads(text), rng).encode()
    else:
        binary = binary[:8] + damaged_bytes(binary[8:], rng)
    text += b" " * (-len(text) % 4)
    size = 20 + len(text) + len(binary)
    return struct.pack("<5I", 0x46546C67, 2, size, len(text), 0x4E4F534A) + text + binary


_ARRAYS = (
    lambda a: a[:1], lambda a: a[..., :0], lambda a: a[:0], lambda a: a[None],
    lambda a: a.astype(str), lambda a: a.astype(complex), lambda a: a * np.nan,
    lambda a: a * 1e308 * 10, lambda a: a * 100, lambda a: -a, lambda a: a.ravel(),
    lambda a: a.astype(bool), lambda a: a.sum(), lambda a: a.astype("datetime64[s]"),
    lambda a: np.repeat(a, 20000, axis=0), lambda a: a.astype(np.int64) + 2**40,
)  # fmt: skip


def damaged_arrays(npz: bytes, rng: np.random.Generator) -> bytes:
    """With another value, type or shape of an array; at times without one."""
    with np.load(io.BytesIO(npz)) as file:
        arrays = dict(file)
    key = str(rng.choice(list(arrays)))
    array = arrays[key]
    if array.dtype.kind in "US":
        arrays[key] = np.array(["x", "y"]) if rng.random() < 0.5 else np.array("\ud800x"[1:])
    elif array.size < 5000 and np.ndim(array):
        with np.errstate(all="ignore"):
            arrays[key] = _ARRAYS[rng.integers(len(_ARRAYS))](array.astype(float))
    else:
        arrays[key] = array[..., :-1] if np.ndim(array) else array[None]
    if rng.random() < 0.1:
        del arrays[key]
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def damaged_tensors(saved: bytes, rng: np.random.Generator) -> bytes:
    """Other contents than `fit` writes, in a file that torch reads."""
    import torch

    data = torch.load(io.BytesIO(saved), weights_only=True)
    odd: list[Any] = [
        None, 3, -(2**40), [1, 2], "text", {}, {1: 2}, torch.zeros(2), torch.zeros(()), float("nan")
    ]  # fmt: skip
    value = odd[rng.integers(len(odd))]
    found = [(box, key) for box, key in places(data) if isinstance(box, dict)]
    kinds = sorted({str(key).split(".")[0] for _, key in found})
    kind = kinds[rng.integers(len(kinds))]
    same = [item for item in found if str(item[1]).split(".")[0] == kind]
    container, key = same[rng.integers(len(same))]
    if rng.random() < 0.2:
        del container[key]
    else:
        container[key] = value
    buffer = io.BytesIO()
    torch.save(value if rng.random() < 0.05 else data, buffer)
    return buffer.getvalue()


def damaged_prior(packed: bytes, rng: np.random.Generator) -> bytes:
    """A zip of the same names: one of its files is damaged, or a weight has other values."""
    from safetensors.numpy import load, save

    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(list(files)))
    if name.endswith(".json"):
        files[name] = damaged_json(json.loads(files[name]), rng).encode()
    elif name.endswith(".safetensors") and rng.random() < 0.8:
        tensors = load(files[name])
        changed = tensors[str(rng.choice(sorted(tensors)))]
        odd = [np.nan, -1e30, 1e30, 1e5, 0] if changed.dtype.kind == "f" else [-1, 99, 30_000]
        with np.errstate(all="ignore"):
            changed[...] = np.array(rng.choice(odd)).astype(changed.dtype)
        files[name] = save(tensors)
    else:
        files[name] = damaged_bytes(files[name], rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()
