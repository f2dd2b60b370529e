"""What the parts of `gpu.py` share: how much is measured, where, and who is told."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    compared_level: int = 2
    """Of the icospheres that kernels and reference draw: 320 faces."""
    compared_objects: int = 3
    compared_views: int = 2
    compared_shrink: int = 2
    """Their images are 120 x 90 divided by this."""
    levels: tuple[int, ...] = (3, 4)
    """Of the icospheres that are timed: 1,280 faces, and the paper's 5,120."""
    rooms: int = 16
    """Rooms a batch, of which silhouettes are timed and the paper's run is trained."""
    large_batch: int = 128
    """Rooms a batch beside it, for memory."""
    repeats: int = 15
    homes: int = 96
    """Made homes, 67 of them for training: 268 rows with their turned copies."""
    epochs: int = 5
    changes: tuple[str, ...] = ()
    """To the paper's config."""


PAPER = Sizes()
TINY = Sizes(
    compared_level=1, compared_objects=2, compared_views=1, compared_shrink=6, levels=(0,), rooms=2,
    large_batch=4, repeats=1, homes=6, epochs=3,
    changes=(
        "model.width=16", "model.decoder.heads=2", "model.decoder.hidden=16", "data.workers=0",
        "model.latent_space.anchors=10", "model.shape.width=8", "model.shape.level=1",
        "data.views_per_room=2", "samples.count=4", "layout.cpu_threads=1", "shape.cpu_threads=1",
    ),
)  # fmt: skip
"""What a CPU does in a test."""


@dataclass(frozen=True)
class Setup:
    """Where a part measures."""

    device: str
    sizes: Sizes
    folder: Path
    """Of the parts together: made homes stay there from one to the next."""
    note: Callable[[str, dict[str, float]], None]
    """Takes a row of the part's table: what was measured, and figures by names that end in units.
    A row is kept whatever comes after it."""


@contextmanager
def peak_mib(device: str) -> Iterator[Callable[[], float]]:
    """Gives a function of the most MiB that tensors took on a GPU within; 0 on a CPU."""
    if device == "cpu":
        yield lambda: 0.0
        return
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    yield lambda: torch.cuda.max_memory_allocated() / 2**20
