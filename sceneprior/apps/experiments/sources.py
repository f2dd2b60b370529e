"""Tables of rooms of any origin: folders of scenes, priors and runs, which are evaluated on the
same shards, and result files. Nothing is trained."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sceneprior.apps.api import load
from sceneprior.apps.experiments.evaluate import evaluate_folder, scores_of
from sceneprior.apps.experiments.rows import GROUPS, NEW_ROOMS, Result, Row, of_set
from sceneprior.apps.experiments.table import write_tables
from sceneprior.apps.priors.packed import name_of
from sceneprior.core.errors import InputError
from sceneprior.core.files import json_text, write_json
from sceneprior.core.scene_json import FORMAT
from sceneprior.core.shards import iterate_rooms
from sceneprior.evaluation.score_table import read_scores
from sceneprior.evaluation.synthesis import EvalOptions
from sceneprior.evaluation.use import UseOptions
from sceneprior.render.scene_files import format_of

SHARED = {
    "label_set": "label set", "shards": "shards", "split": "split", "n_test": "test rooms",
    "n_train_rooms_available": "training rooms", "n_train_rooms": "training rooms compared",
    "n_pictured": "rooms compared by pictures", "render": "rendering", "networks": "networks",
    "renders": "pictures of test rooms", "stand": "--stand", "version": "version of the result",
    "request": "requested rooms",
}  # fmt: skip
"""Entries of a protocol that results share if they can be compared, with their names."""
_SHORT = 40
"""Largest length of a value that a message quotes."""


def compare_sources(
    sources: Sequence[str], against: Path | None, out: Path, count: int | None, options: EvalOptions
) -> int:
    """Evaluate sources, write their results to `out`, and tabulate them.

    Args:
        sources: Folders of scenes, priors and runs, or result files, which are taken as they are.
        against: Shards with the real rooms; None if all sources are result files.
        count: Rooms of each source. None takes the size of the smallest folder of scenes or,
            without such folders, the number of training rooms.

    Returns:
        The number of tables, one for each protocol.
    """
    titles = {source: _title(source) for source in sources}
    for title, times in Counter(titles.values()).items():
        if times > 1:
            raise InputError(f"{times} sources are called '{title}'; rename a folder or a file.")
    results: dict[str, Result] = {}
    rooms = [source for source in sources if not source.endswith(".json")]
    if rooms and against is None:
        raise InputError(
            f"{rooms[0]} is to be evaluated, but nothing says against which rooms; give --against "
            "SHARDS, or only result files, such as scores.json."
        )
    if rooms and against is not None and count is None:
        folders = [many for source in rooms if (many := _scenes_in(Path(source)))]
        count = min(folders) if folders else sum(1 for _ in iterate_rooms(against, "train"))
    for source, title in titles.items():
        if source not in rooms:
            hint = "write it with `sceneprior evaluate`"
            results[title] = read_scores(Path(source), hint)
            continue
        assert count is not None  # since there are rooms, and shards
        if _scenes_in(Path(source)):
            found = evaluate_folder(Path(source), count, options, against, UseOptions())
        else:
            prior = load(source)
            generate = partial(prior.sample, count, options.seed)
            found = scores_of(generate, against, options, UseOptions())
            found["protocol"] |= {"run": title, "latents": prior.distribution}
        write_json(out / f"{title}.json", found)
        results[title] = found
    rows = rows_of_results(results)
    write_tables(rows, NEW_ROOMS, out)
    return len({row.rooms for row in rows})


def _title(source: str) -> str:
    """The name of a source: of its folder, prior or file, or of the folder of a scores.json."""
    path = Path(source)
    if path.suffix == ".json":
        return path.resolve().parent.name if path.stem == "scores" else path.stem
    return name_of(source).rpartition("/")[2]


def _scenes_in(folder: Path) -> int:
    """The number of scenes in a folder; 0 if it is a run or a prior."""
    return (
        sum(format_of(path) == FORMAT for path in folder.glob("*.json")) if folder.is_dir() else 0
    )


def rows_of_results(results: Mapping[str, Result]) -> list[Row]:
    """A row for each result, by title, in a table for each protocol, the most frequent one first.

    Values of two protocols cannot be compared; a warning above the later tables says what differs.
    """
    protocols = {title: _shared(scores) for title, scores in results.items()}
    digests = {title: _digest(shared) for title, shared in protocols.items()}
    rows = []
    (main, _), *_ = Counter(digests.values()).most_common(1)
    first = protocols[next(title for title in results if digests[title] == main)]
    for digest, _ in Counter(digests.values()).most_common():
        for title in (each for each in results if digests[each] == digest):
            scores, own = results[title], protocols[title]
            protocol = dict(scores["protocol"])
            if digest != main:
                protocol["apart"] = (
                    f"these rows cannot be compared with those of protocol {main}: "
                    f"{_difference(own, first)}"
                )
            latents = protocol.get("latents", "as given")
            origin = latents.partition(",")[0]
            group = GROUPS["kernel"] if origin == "kernel" else "new rooms"
            found = of_set(scores | {"protocol": protocol}, "generated")
            heading = f"Rooms against {protocol.get('shards', 'no real rooms')}, protocol {digest}"
            seed, rank = protocol.get("seed", 0), int(origin == "kernel")
            rows.append(Row(heading, seed, title, "", latents, found, group, rank))
    return rows


def _shared(scores: Result) -> dict[str, Any]:
    """The entries `SHARED` of a result's protocol."""
    protocol = scores["protocol"]
    own = {
        "renders": protocol.get("renders_sha256", {}).get("test"),
        "stand": protocol.get("use", {}).get("stand", False),
        "version": scores["version"],
    }
    return {key: own.get(key, protocol.get(key)) for key in SHARED}


def _digest(shared: Mapping[str, Any]) -> str:
    return hashlib.sha256(json_text(dict(shared)).encode()).hexdigest()[:8]


def _difference(own: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Say in which entries two protocols differ."""
    said = []
    for key, name in SHARED.items():
        here, there = own[key], other[key]
        if here != there:
            short = max(len(str(here)), len(str(there))) <= _SHORT
            said.append(f"{name} {here} in place of {there}" if short else f"other {name}")
    return ", ".join(said)
