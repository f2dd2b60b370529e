"""Shared settings of the parts of `gpu.py`: sizes, device, and the function that notes results."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch


@dataclass(frozen=True)
class Sizes:
    """Sizes of the measurements."""

    compared_level: int = 2
    """Level of the icospheres in the comparison with the reference; 2 has 320 faces."""
    compared_objects: int = 3
    compared_views: int = 2
    compared_shrink: int = 2
    """Divisor of the image size, 120 x 90, in that comparison."""
    levels: tuple[int, ...] = (3, 4)
    """Levels of the icospheres that are timed: 1,280 faces, and the paper's 5,120."""
    rooms: int = 16
    """Rooms per batch, for timing silhouettes and for training the paper's run."""
    large_batch: int = 128
    """Rooms per batch of an additional run, for memory."""
    repeats: int = 15
    homes: int = 96
    """Procedural homes, 67 of them for training: 268 rows with their turned copies."""
    epochs: int = 5
    changes: tuple[str, ...] = ()
    """Changes to the paper's config."""


PAPER = Sizes()
TINY = Sizes(
    compared_level=1, compared_objects=2, compared_views=1, compared_shrink=6, levels=(0,), rooms=2,
    large_batch=4, repeats=1, homes=6, epochs=3,
    changes=(
        "model.width=16", "model.decoder.heads=2", "model.decoder.hidden=16", "data.workers=0",
        "model.latent_space.anchors=10", "model.shape.width=8", "model.shape.level=1",
        "data.views_per_room=2", "layout.cpu_threads=1", "shape.cpu_threads=1",
    ),
)  # fmt: skip
"""Sizes for a test on a CPU."""


@dataclass(frozen=True)
class Setup:
    """Settings with which a part is called."""

    device: str
    sizes: Sizes
    folder: Path
    """Folder shared by all parts, which keeps the homes."""
    note: Callable[[str, dict[str, float]], None]
    """Function that immediately writes a row of the part's table, from the row's title and values
    by name; names end in units."""


@contextmanager
def peak_mib(device: str) -> Iterator[Callable[[], float]]:
    """Yield a function that returns the peak MiB of tensors on the GPU since entry; 0 on a CPU."""
    if device == "cpu":
        yield lambda: 0.0
        return
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    yield lambda: torch.cuda.max_memory_allocated() / 2**20
