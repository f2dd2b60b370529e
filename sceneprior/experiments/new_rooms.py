"""Comparisons of new rooms: an `eval-fid` a run and distribution of latents."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from sceneprior.experiments.comparison import RoomComparison, Run, distributions_of
from sceneprior.experiments.figure import write_figure
from sceneprior.experiments.steps import Step, read_result
from sceneprior.experiments.table import NEW_ROOMS, Row
from sceneprior.experiments.task import CompareOptions, Task, first_row, shards_of
from sceneprior.offscreen import Renderer
from sceneprior.shards import iterate_rooms


class NewRooms(Task):
    """Each run generates rooms, which are evaluated by all metrics."""

    form = NEW_ROOMS

    def __init__(self, comparison: RoomComparison, options: CompareOptions):
        self.comparison, self.options = comparison, options
        self.count = cache(self._count)

    def _count(self, rooms: str) -> int:
        """How many rooms each run generates."""
        shards = shards_of(self.comparison, rooms)
        return self.comparison.count or sum(1 for _ in iterate_rooms(shards, "train"))

    def check(self, rooms: str) -> None:
        self.count(rooms)

    def scoring(self, run: Run) -> list[Step]:
        return scoring_steps(self.comparison, run, self.count(run.rooms), self.options)

    def rows(self, run: Run) -> list[Row]:
        return rows_of(self.comparison, run, [step.result for step in self.scoring(run)])

    def draw(self, rooms: str, runs: Sequence[Run], path: Path, renderer: Renderer) -> None:
        write_figure(self.comparison, runs, self.count(rooms), path, renderer)


def scoring_steps(
    comparison: RoomComparison, run: Run, count: int, options: CompareOptions
) -> list[Step]:
    """`eval-fid` of a trained run, once for each distribution of its latents.

    They depend on what the rows of one table have in common.
    """
    weights = [] if options.inception is None else ["--inception", str(options.inception)]
    # Some methods decode meshes and some have boxes alone: --boxes compares what all have.
    alike = ["-n", str(count), "--seed", str(comparison.sampling_seed), "--boxes"]
    alike += ["--renderer", options.renderer, *weights]
    steps = []
    for number, distribution in enumerate(distributions_of(comparison, run)):
        name = f"scores_{distribution}" if number else "scores"
        scores = run.folder / f"{name}.json"
        asked = alike if distribution is None else [*alike, "--distribution", distribution]
        paths = ["--run", str(run.folder / "run"), "--out", str(scores)]
        steps.append(Step(name, ["eval-fid", *paths, *asked], result=scores, depends_on=asked))
    return steps


def rows_of(comparison: RoomComparison, run: Run, results: Sequence[Path]) -> list[Row]:
    """A row for each distribution of latents, and one of decoded training rooms where there are
    some; what training took stands in the first."""
    first = first_row(comparison, run)
    rows: list[Row] = []
    for path in results:
        scores = read_result(path)
        latents = scores["protocol"]["latents"]
        rows.append(
            replace(first, variant=latents, scores=scores, costs={} if rows else first.costs)
        )
    if decoded := rows[0].scores.get("decoded_rooms"):
        scores = {**decoded, "protocol": rows[0].scores["protocol"]}
        rows.append(replace(first, variant="of training rooms, decoded", scores=scores, costs={}))
    return rows
