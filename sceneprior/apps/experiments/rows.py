"""The rows of a comparison's table, from the result files of its runs."""

from typing import Any

from sceneprior.apps.config import load_any_run
from sceneprior.apps.experiments.comparison import (
    Comparison,
    Run,
    Variant,
    ViewComparison,
    variants_of,
)
from sceneprior.apps.experiments.steps import read_journal, read_result
from sceneprior.apps.experiments.table import VIEWS, Row
from sceneprior.lifted.trained import SAMPLER
from sceneprior.paper.sampling import marked
from sceneprior.training.checkpoints import read_checkpoint

OWN = "its own"
"""Value of `protocol.latents` for a method with neither latents nor the lifted method's sampler."""
AS_GIVEN = "as given"
DECODED = "of training rooms, decoded"
GROUPS = {
    "paper": "rooms of new latents (paper)",
    SAMPLER: "rooms of the lifted method's sampler, object by object",
    OWN: "rooms of methods trained on {}",
    AS_GIVEN: "scenes as given, made elsewhere",
    DECODED: "training rooms, decoded: nothing is new",
    "kernel": "copies: rooms near training rooms",
}
"""Group headings of a table of new rooms, in order, by the origin of the rooms. `{}` stands for the
method's supervision."""
SHAPES = {"fit": "as found", "fit_cad": "CAD models"}
"""Rows of an `eval-svr` result that the table shows, with their values in the column `shapes`."""


def rows_of(comparison: Comparison, run: Run) -> list[Row]:
    """The rows of an evaluated run; the first row includes the costs of training."""
    found = {variant: read_result(variant.result) for variant in variants_of(comparison, run)}
    of_task = _rows_of_views if isinstance(comparison, ViewComparison) else _rows_of_rooms
    rows = of_task(run, comparison.rooms[run.rooms].title, found)
    rows[0].scores.update(costs_of(run))
    return rows


def costs_of(run: Run) -> dict[str, int | float | None]:
    """Costs of training: `cpu_s`, `steps` and `parameters`; empty for scenes.

    CPU seconds are None if they are unknown, since training was killed or started by hand.
    """
    if run.scenes is not None:
        return {}
    steps = 0
    for final in (run.folder / "run").glob("*/final.ckpt"):
        saved = read_checkpoint(final)
        # Lightning counts updates; a GAN's two networks make two updates per batch.
        steps += saved["global_step"] // len(saved["optimizer_states"])
    networks = load_any_run(run.folder / "run").prior
    return {
        "cpu_s": read_journal(run.folder).get("fit", {}).get("cpu_s"),
        "steps": steps,
        "parameters": sum(item.numel() for item in networks.parameters()),
    }


def _rows_of_rooms(run: Run, title: str, found: dict[Variant, dict[str, Any]]) -> list[Row]:
    """A row for each distribution of latents, and one for decoded training rooms if there are
    any."""
    # A result names the distribution of its rooms, with the mark of the version that wrote it.
    drawn = [
        (variant, scores["protocol"].get("latents", AS_GIVEN).split(",")[0], scores)
        for variant, scores in found.items()
    ]
    first, last = drawn[0][2], drawn[-1][0]  # a sampler, which decodes no room, would come first
    if decoded := first.get("decoded_rooms"):
        drawn.append((last, DECODED, {**decoded, "protocol": first["protocol"]}))
    learns_from, groups = run.run_config.learns_from, list(GROUPS)
    return [
        Row(
            title, GROUPS[by].format(learns_from), variant.title, marked(by), run.seed, scores,
            variant.made_by, groups.index(by),
        )
        for variant, by, scores in drawn
    ]  # fmt: skip


def _rows_of_views(run: Run, title: str, found: dict[Variant, dict[str, Any]]) -> list[Row]:
    """A row for each fit, and another one if its objects were also replaced by CAD models."""
    group = f"trained on {run.run_config.learns_from}"
    rows = []
    for variant, result in found.items():
        of: dict[str, dict[str, Any]] = {
            name: {**row["summary"], "intervals": row["intervals"]}
            for name, row in result["rows"].items()
        }
        of["fit"]["seconds"] = result["cpu_seconds_an_image"]
        beside = {name: of[name] for name in VIEWS.references.values()}
        for name, shapes in SHAPES.items():
            if name in of:
                scores = {**of[name], **beside, "protocol": result["protocol"]}
                rows.append(
                    Row(title, group, variant.title, shapes, run.seed, scores, variant.made_by)
                )
    return rows
