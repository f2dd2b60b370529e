"""The rows of a comparison's table, from the results that its runs left."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from sceneprior.apps.config import load_any_run
from sceneprior.apps.experiments.comparison import (
    Comparison,
    Run,
    ViewComparison,
    maker_of,
    title_of,
    variants_of,
)
from sceneprior.apps.experiments.steps import read_journal, read_result
from sceneprior.apps.experiments.table import VIEWS, Row
from sceneprior.lifted.trained import SAMPLER
from sceneprior.paper.sampling import marked
from sceneprior.training.checkpoints import read_checkpoint

OWN = "its own"
"""The way of a method that has neither latents nor our sampler; `protocol.latents` says so."""
AS_GIVEN = "as given"
DECODED = "of training rooms, decoded"
GROUPS = {
    "paper": "rooms of new latents (paper)",
    SAMPLER: "rooms of our sampler, object by object",
    OWN: "rooms of methods taught by {}",
    AS_GIVEN: "scenes as given, made elsewhere",
    DECODED: "training rooms, decoded: nothing is new",
    "kernel": "copies: rooms near training rooms",
}
"""Headings of a table of new rooms in their order, by where rooms come from; `{}` is what a method
learns from."""
SHAPES = {"fit": "as found", "fit_cad": "CAD models"}
"""Rows of a result of `eval-svr` that the table shows of a run."""


def rows_of(comparison: Comparison, run: Run) -> list[Row]:
    """The rows of a run that is scored; what training took stands in the first."""
    if isinstance(comparison, ViewComparison):
        rows = _rows_of_views(comparison, run)
    else:
        rows = _rows_of_rooms(comparison, run)
    return [replace(rows[0], costs=costs_of(run)), *rows[1:]]


def result_of(comparison: Comparison, run: Run, variant: str | None) -> Path:
    """The file that holds the scores of one of a run's variants."""
    is_first = variant == variants_of(comparison, run)[0]
    return run.folder / ("scores.json" if is_first else f"scores_{variant}.json")


def costs_of(run: Run) -> dict[str, int | float | None]:
    """Costs of training: `cpu_s`, `steps` and `parameters`; empty for scenes.

    CPU seconds are None where they are unknown: training was killed, or run by hand.
    """
    if run.scenes is not None:
        return {}
    steps = 0
    for final in (run.folder / "run").glob("*/final.ckpt"):
        saved = read_checkpoint(final)
        # Lightning counts updates; two networks that train each other make two a batch.
        steps += saved["global_step"] // len(saved["optimizer_states"])
    networks = load_any_run(run.folder / "run").prior
    return {
        "cpu_s": read_journal(run.folder).get("fit", {}).get("cpu_s"),
        "steps": steps,
        "parameters": sum(item.numel() for item in networks.parameters()),
    }


def _rows_of_rooms(comparison: Comparison, run: Run) -> list[Row]:
    """A row for each distribution of latents, and one of decoded training rooms where there are
    some."""
    found = {}
    for variant in variants_of(comparison, run):
        scores = read_result(result_of(comparison, run, variant))
        # The result says how its rooms were drawn, with the mark of the version that wrote it.
        drawn = scores["protocol"].get("latents", AS_GIVEN).split(",")[0]
        found[drawn] = scores
    first = next(iter(found.values()))
    if decoded := first.get("decoded_rooms"):
        found[DECODED] = {**decoded, "protocol": first["protocol"]}
    learns_from, ranks = run.run_config.learns_from, list(GROUPS)
    return [
        _row(
            comparison, run, drawn, GROUPS[drawn].format(learns_from), marked(drawn), scores,
            ranks.index(drawn),
        )
        for drawn, scores in found.items()
    ]  # fmt: skip


def _rows_of_views(comparison: Comparison, run: Run) -> list[Row]:
    """A row for each fit, and one more where CAD models stand in for what was found."""
    group = f"taught by {run.run_config.learns_from}"
    rows = []
    for variant in variants_of(comparison, run):
        found = read_result(result_of(comparison, run, variant))
        of: dict[str, dict[str, Any]] = {
            name: {**row["summary"], "intervals": row["intervals"]}
            for name, row in found["rows"].items()
        }
        of["fit"]["seconds"] = found["cpu_seconds_an_image"]
        beside = {name: of[name] for name in VIEWS.references.values()}
        for name, shapes in SHAPES.items():
            if name in of:
                scores = {**of[name], **beside, "protocol": found["protocol"]}
                rows.append(_row(comparison, run, variant, group, shapes, scores))
    return rows


def _row(
    comparison: Comparison,
    run: Run,
    variant: str | None,
    group: str,
    shown: str,
    scores: dict[str, Any],
    rank: int = 0,
) -> Row:
    """A row without costs; `shown` is how the table calls its variant."""
    rooms, title = comparison.rooms[run.rooms].title, title_of(comparison, run, variant)
    made_by = maker_of(comparison, run, variant).said
    return Row(rooms, group, title, shown, run.seed, scores, {}, made_by, rank)
