"""The file of a packed prior: weights, settings and a card, and nothing that can run.

A zip, so that any tool opens it and zeros cost nothing, of three files:

README.md            the card (priors/card.py)
config.json          the run's settings, the stage, the classes; `PackedPrior`
model.safetensors    the weights

A folder with these three files is the same prior, and so is a repository of the Hugging Face Hub.
"""

import io
import json
import zipfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load as read_tensors
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.files import json_text, write_whole
from sceneprior.settings import Section, check_settings
from sceneprior.training.method import RunConfig, Trained, TrainedPrior

FORMAT = "sceneprior-prior"
VERSION = 1
CARD, CONFIG, WEIGHTS = FILES = ("README.md", "config.json", "model.safetensors")
LARGEST = {CARD: 2**20, CONFIG: 2**24, WEIGHTS: 2**31}
"""Bytes of a file, unpacked: what claims more is refused before it is read."""
FEW = 4096
"""Tensors of fewer numbers are kept in full precision: halving them saves nothing."""


class Description(Section):
    """What config.json says."""

    format: str = FORMAT
    version: int = VERSION
    stage: str
    classes: list[str]
    """Of the label set."""
    training_rooms: int
    room_ids: list[str]
    """Of the training rooms whose latents are in it; [] where none are."""
    settings: dict[str, Any]
    """The run's config, defaults included."""


@dataclass(frozen=True)
class PackedPrior:
    """What such a file holds."""

    said: Description
    tensors: dict[str, Tensor]
    card: str


def pack(trained: Trained, card: str, latents: bool = False, half: bool = False) -> PackedPrior:
    """What stands for a trained method in a file.

    Args:
        latents: Keep those of the training rooms, and the rooms' ids. Without them `kernel`,
            `geodesic` and `gaussian` rooms cannot be drawn, nor images reconstructed.
        half: Keep large tensors in half precision: a smaller file, of rooms that differ a little.
    """
    networks: dict[str, Any] = {"prior": trained.prior}
    rooms: list[str] = []
    if isinstance(trained, TrainedPrior):
        logits = trained.logits if latents else trained.logits[:0]
        networks["latents"] = nn.Embedding.from_pretrained(logits)
        networks["sampler"] = trained.sampler
        rooms = list(trained.room_ids) if latents and trained.remembers_rooms else []
    tensors = {
        f"{name}.{key}": value.half() if half and _is_large(value) else value
        for name, network in networks.items()
        if network is not None
        for key, value in network.state_dict().items()
    }
    settings = trained.config.model_dump(mode="json", by_alias=True)
    # A path says where the data lie on someone's machine; their name is enough.
    settings["data"]["shards"] = Path(settings["data"]["shards"]).name
    classes = list(label_set(trained.config.label_set))
    count = len(trained.room_ids)
    said = Description(
        stage=trained.stage,
        classes=classes,
        training_rooms=count,
        room_ids=rooms,
        settings=settings,
    )
    return PackedPrior(said, tensors, card)


def _is_large(tensor: Tensor) -> bool:
    return tensor.dtype == torch.float32 and tensor.numel() >= FEW


def unpack(packed: PackedPrior, config: RunConfig, source: str) -> Trained:
    """The trained method of a file; `config` is `packed.said.settings`, checked.

    Raises:
        InputError: the weights are not those of these settings.
    """
    try:
        if packed.said.stage not in config.stage_names:
            raise ValueError(f"no stage of its method is called '{packed.said.stage}'")
        build = partial(config.networks, packed.said.stage, len(packed.said.room_ids))
        # Without memory first: settings may ask for networks that no machine holds.
        with torch.device("meta"), _ShapesAlone():
            shapes = {name: tensor.shape for name, tensor in build().state_dict().items()}
        found = {name: tensor.shape for name, tensor in packed.tensors.items()}
        different = sorted(name for name in shapes | found if shapes.get(name) != found.get(name))
        if different:
            raise ValueError(f"{different[0]} and {len(different) - 1} others do not fit")
        classes = label_set(config.label_set)
        if packed.said.classes != list(classes):
            raise ValueError(f"its classes are not those of {config.label_set}")
        for name, tensor in packed.tensors.items():
            _check(name, tensor, len(classes))
        networks = build()
        networks.load_state_dict(packed.tensors)
        return config.trained(networks, packed.said.stage, tuple(packed.said.room_ids))
    except (ValueError, RuntimeError, KeyError, TypeError, InputError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{source}: its weights are not those of its settings ({reason}); have it packed again "
            "with `sceneprior pack`."
        ) from None


class _ShapesAlone(TorchFunctionMode):
    """Leaves out on the device `meta` what gives values and no shapes, and for which torch would
    import its compiler: that takes as long as all else that loads a prior."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is nn.init.normal_:
            return kwargs["tensor"]
        if func in (nn.functional.normalize, Tensor.div):
            return args[0]
        return torch.empty(*args) if func is torch.randn else func(*args, **kwargs)


def _check(name: str, tensor: Tensor, classes: int) -> None:
    """A `ValueError` where numbers are none, or classes that are not there."""
    if tensor.is_floating_point():
        if not tensor.isfinite().all():
            raise ValueError(f"{name} holds numbers that are not finite")
    elif name.endswith("_class") and not ((tensor >= -1) & (tensor < classes)).all():
        raise ValueError(f"{name} names classes that are not there")


def write_packed(packed: PackedPrior, path: Path) -> None:
    """Write a prior to one file, whole or not at all; the same prior, the same bytes."""
    described = packed.said.model_dump(mode="json")
    tensors = {name: tensor.contiguous() for name, tensor in packed.tensors.items()}
    contents = (packed.card.encode(), json_text(described).encode(), tensors_to_bytes(tensors))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in zip(FILES, contents, strict=True):
            archive.writestr(_entry(name), content)
    write_whole(Path(path), buffer.getvalue())


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name)  # dated 1980, so that nothing depends on the day
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def is_packed(path: Path) -> bool:
    """Whether a path is a file, or a folder of its files, and no run."""
    return path.is_file() or (path / WEIGHTS).is_file()


def read_packed(path: Path) -> PackedPrior:
    """Read a packed prior. Nothing in it is executed, and nothing is written.

    Raises:
        InputError: it is no packed prior, or damaged.
    """
    try:
        card, described, weights = (_contents(path, name) for name in FILES)
        data = json.loads(described)
        if (data["format"], data["version"]) != (FORMAT, VERSION):
            raise ValueError(
                f"it says format '{data['format']}' version {data['version']}, not '{FORMAT}' "
                f"version {VERSION}"
            )
        said = check_settings(Description, data, CONFIG)
        return PackedPrior(said, read_tensors(weights), card.decode())
    except Exception as error:  # what zipfile and safetensors raise depends on the damaged byte
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path} is no packed prior, or is damaged ({type(error).__name__}: {reason}); fetch "
            "it again, or have it packed again with `sceneprior pack RUN --out FILE`."
        ) from None


def _contents(path: Path, name: str) -> bytes:
    """One of its files, of at most `LARGEST` bytes."""
    most = LARGEST[name]
    if path.is_dir():
        with (path / name).open("rb") as file:
            content = file.read(most + 1)
    else:
        with zipfile.ZipFile(path) as archive, archive.open(name) as member:
            content = member.read(most + 1)
    if len(content) > most:
        raise ValueError(f"{name} has more than {most} bytes")
    return content
