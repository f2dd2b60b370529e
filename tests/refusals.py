"""What users read when something is refused: every sentence, whole, in `golden/refusals/`.

A test says only which input is refused; the sentence stands in one text file per area, where all
of them can be read and compared. `TAKE=1 pytest ...` writes those that changed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from golden_values import FOLDER, TAKE

GOLDEN = FOLDER / "refusals"


@contextmanager
def refused(key: str, error: type[Exception] | None = None, **hidden: object) -> Iterator[None]:
    """The block raises `error` with the sentence `key` of the golden file.

    Args:
        key: `AREA/NAME`: a line of `golden/refusals/AREA.txt`.
        error: Class of the error; an `InputError` by default.
        hidden: Parts of the sentence that differ from run to run, such as `tmp=tmp_path`; the
            sentence has `<tmp>` in place of each.

    >>> from sceneprior.core.errors import InputError
    >>> with refused("core/refusals_themselves"):
    ...     raise InputError("Expected a lamp.")
    """
    from sceneprior.core.errors import InputError

    kind = error or InputError
    try:
        yield
    except kind as found:
        sentence = str(found)
    else:
        raise AssertionError(f"{key}: nothing was refused")
    for name, value in hidden.items():
        sentence = sentence.replace(str(value), f"<{name}>")
    line = sentence.replace("\\", "\\\\").replace("\n", "\\n")
    area, _, name = key.partition("/")
    path = GOLDEN / f"{area}.txt"
    known = _read(path)
    if TAKE and known.get(name) != line:
        known[name] = line
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{key}: {known[key]}\n" for key in sorted(known)))
    assert line == known.get(name), (
        f"{key}: the sentence is\n{line}\nin place of\n{known.get(name)}"
    )


def _read(path: Path) -> dict[str, str]:
    if not path.exists():
        return {}
    return dict(line.split(": ", 1) for line in path.read_text().splitlines())
