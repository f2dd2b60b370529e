"""What a comparison does with its trained runs: the interface of `new_rooms` and `single_views`."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sceneprior.config import load_any_run, load_config
from sceneprior.experiments.comparison import Comparison, Run
from sceneprior.experiments.steps import Step, read_journal
from sceneprior.experiments.table import Form, Row
from sceneprior.offscreen import Renderer
from sceneprior.training.checkpoints import read_checkpoint


@dataclass(frozen=True)
class CompareOptions:
    """How all runs of a comparison are trained and evaluated."""

    renderer: str = "auto"
    inception: Path | None = None
    """NVIDIA's `inception-2015-12-05.pt`; None leaves FID out."""
    accelerator: str = "auto"
    """That trains the runs, one device each: Lightning's word."""
    jobs: int = 1
    """Runs at a time."""


class Task(ABC):
    """How runs are scored, and what is shown of them."""

    form: Form

    @abstractmethod
    def check(self, rooms: str) -> None:
        """Refuse, before anything is trained, a kind of rooms that runs cannot be scored on."""

    @abstractmethod
    def scoring(self, run: Run) -> list[Step]:
        """Commands that score a trained run, each of which leaves a JSON of scores. They depend on
        what the rows of one table have in common."""

    @abstractmethod
    def rows(self, run: Run) -> list[Row]:
        """What stands in the table of a run that is scored; what training took, in the first."""

    @abstractmethod
    def draw(self, rooms: str, runs: Sequence[Run], path: Path, renderer: Renderer) -> None:
        """Write a picture of scored runs on the same rooms, one a method."""


def shards_of(comparison: Comparison, rooms: str) -> Path:
    """Where a kind of rooms is."""
    return Path(load_config(comparison.rooms[rooms].config).data.shards)


def first_row(comparison: Comparison, run: Run) -> Row:
    """A row of a run without scores."""
    method = comparison.methods[run.method]
    return Row(
        rooms=comparison.rooms[run.rooms].title,
        group=method.group,
        title=method.title,
        variant="",
        seed=run.seed,
        scores={},
        costs=costs_of(run),
    )


def costs_of(run: Run) -> dict[str, float | None]:
    """What training took: `cpu_s`, `steps` and `parameters`.

    CPU seconds are None where training was killed on the way, or done by hand: nobody knows.
    """
    steps = 0
    for final in (run.folder / "run").glob("*/final.ckpt"):
        saved = read_checkpoint(final)
        # Lightning counts updates; two networks that train each other make two a batch.
        steps += saved["global_step"] // len(saved["optimizer_states"])
    return {
        "cpu_s": read_journal(run.folder).get("fit", {}).get("cpu_s"),
        "steps": steps,
        "parameters": sum(
            item.numel() for item in load_any_run(run.folder / "run").prior.parameters()
        ),
    }
