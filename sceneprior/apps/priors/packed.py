"""Packed priors: where they are found, and their file of weights, settings and a card.

The file is a zip, which any tool opens and which compresses zeros well, with three entries, none of
which holds executable code:

README.md            the card (apps/priors/card.py)
config.json          the run's settings, the stage, the classes; `PackedPrior`
model.safetensors    the weights

A folder, or a repository of the Hugging Face Hub, with these three files is read like the zip.
"""

import hashlib
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

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import cause_of, check_file, json_text, read_bytes, reading, write_whole
from sceneprior.core.parts import KINDS
from sceneprior.core.settings import Section, check_settings
from sceneprior.lifted.trained import TrainedLifted
from sceneprior.paper.prior import TrainedPrior
from sceneprior.training.method import RunConfig, Trained

FORMAT = "sceneprior-prior"
VERSION = 1
CARD, CONFIG, WEIGHTS = FILES = ("README.md", "config.json", "model.safetensors")
LARGEST = {CARD: 2**20, CONFIG: 2**24, WEIGHTS: 2**31}
"""Limits on the unpacked sizes in bytes; larger files are refused before they are read."""
FEW = 4096
"""Number of elements below which tensors are kept in full precision, since little is saved."""
HUB = "hf://"
_LARGEST_WEIGHT = 1e6
"""Bound of all weights; the largest in a shipped prior is 26,000."""


class Description(Section):
    """The contents of config.json."""

    format: str = FORMAT
    version: int = VERSION
    stage: str
    classes: list[str]
    """Names of the label set's classes."""
    training_rooms: int
    room_ids: list[str]
    """Ids of the training rooms whose latents are packed; empty without latents."""
    settings: dict[str, Any]
    """The run's config, defaults included."""


@dataclass(frozen=True)
class PackedPrior:
    """The contents of a packed prior."""

    said: Description
    tensors: dict[str, Tensor]
    card: str


def pack(trained: Trained, card: str, latents: bool = False, half: bool = False) -> PackedPrior:
    """Pack a trained method for writing to a file.

    Args:
        latents: Keep the latents and ids of the training rooms. Without them, no `kernel` rooms can
            be drawn, and no images reconstructed.
        half: Store large tensors in half precision: the file is smaller, and rooms differ slightly.
    """
    networks: dict[str, Any] = {"prior": trained.prior}
    rooms: list[str] = []
    if isinstance(trained, TrainedPrior):
        logits = trained.logits if latents else trained.logits[:0]
        networks["latents"] = nn.Embedding.from_pretrained(logits)
        networks["sampler"] = trained.sampler if isinstance(trained, TrainedLifted) else None
        rooms = list(trained.room_ids) if latents and trained.remembers_rooms else []
    tensors = {
        f"{name}.{key}": value.half() if half and _is_large(value) else value
        for name, network in networks.items()
        if network is not None
        for key, value in network.state_dict().items()
    }
    said = Description(
        stage=trained.stage,
        classes=list(label_set(trained.config.label_set)),
        training_rooms=len(trained.room_ids),
        room_ids=rooms,
        settings=shared_settings(trained.config),
    )
    return PackedPrior(said, tensors, card)


def shared_settings(config: RunConfig) -> dict[str, Any]:
    """A run's settings, without those of Lightning, and with the shards' path reduced to a name, to
    hide the user's folders."""
    ours = {"trainer", "callbacks", "logger", "init_from"}
    settings = config.model_dump(mode="json", by_alias=True, exclude=ours)
    settings["data"]["shards"] = Path(settings["data"]["shards"]).name
    return settings


def _is_large(tensor: Tensor) -> bool:
    return tensor.dtype == torch.float32 and tensor.numel() >= FEW


def unpack(packed: PackedPrior, config: RunConfig, source: str) -> Trained:
    """Restore the trained method of a file; `config` is the validated `packed.said.settings`."""
    try:
        if packed.said.stage not in config.stage_names:
            raise ValueError(f"no stage of its method is called '{packed.said.stage}'")
        build = partial(config.networks, packed.said.stage, len(packed.said.room_ids))
        # Build on the meta device first: settings may describe networks too large for memory.
        with torch.device("meta"), _ShapesAlone():
            shapes = {name: tensor.shape for name, tensor in build().state_dict().items()}
        found = {name: tensor.shape for name, tensor in packed.tensors.items()}
        different = sorted(name for name in shapes | found if shapes.get(name) != found.get(name))
        if different:
            raise ValueError(
                f"{different[0]} and {len(different) - 1} others do not fit; a prior of another "
                "version has to be trained again"
            )
        classes = label_set(config.label_set)
        if packed.said.classes != list(classes):
            raise ValueError(f"its classes are not those of {config.label_set}")
        for name, tensor in packed.tensors.items():
            _check(name, tensor, len(classes))
        networks = build()
        networks.load_state_dict(packed.tensors)
        return config.trained(networks, packed.said.stage, tuple(packed.said.room_ids))
    except (ValueError, RuntimeError, KeyError, TypeError, InputError) as error:
        raise InputError(
            f"{source}: its weights do not match its settings ({cause_of(error)}); have it "
            "packed again with `sceneprior pack`."
        ) from None


class _ShapesAlone(TorchFunctionMode):
    """Skips functions on the meta device that only set values.

    Torch would import its compiler for them, which takes as long as the rest of loading a prior.
    """

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
    """Raise ValueError for numbers that are not finite, or class indices out of range."""
    if tensor.is_floating_point():
        if not (tensor.abs() < _LARGEST_WEIGHT).all():
            raise ValueError(f"{name} holds numbers that are not finite, or huge")
    elif name == "sampler.look_class" and not (tensor >= 0).any():
        raise ValueError(f"{name} holds no class")
    elif name.endswith("_class") and not ((tensor >= -1) & (tensor < classes)).all():
        raise ValueError(f"{name} holds class indices out of range")
    elif name.endswith("part_kind") and not ((tensor >= -1) & (tensor < KINDS)).all():
        raise ValueError(f"{name} holds part types out of range")
    elif name.endswith(("backs", "fronts")) and not ((tensor >= 0) & (tensor < QUARTERS)).all():
        raise ValueError(f"{name} holds side indices out of range")


def write_packed(packed: PackedPrior, path: Path) -> None:
    """Write a prior to one file, atomically; the same prior gives the same bytes."""
    described = packed.said.model_dump(mode="json")
    tensors = {name: tensor.contiguous() for name, tensor in packed.tensors.items()}
    contents = (packed.card.encode(), json_text(described).encode(), tensors_to_bytes(tensors))
    for name, content in zip(FILES, contents, strict=True):
        if len(content) > LARGEST[name]:
            raise InputError(
                f"{name} of {path} would have {len(content)} bytes, and a packed prior may have "
                f"{LARGEST[name]} there; nothing was written. Shorten what --about names, if it is "
                f"{CARD}."
            )
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in zip(FILES, contents, strict=True):
            # An entry has the default date, 1980, so that the bytes are reproducible.
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    write_whole(Path(path), buffer.getvalue())


def is_packed(path: Path) -> bool:
    """True if a path is a packed prior: a file, or a folder of its files."""
    return path.is_file() or (path / WEIGHTS).is_file()


def read_packed(path: Path) -> PackedPrior:
    """Read a packed prior. Nothing in it is executed, and nothing is written."""
    then = "; fetch it again, or have it packed again with `sceneprior pack RUN --out FILE`."
    with reading(path, " is not a packed prior, or is damaged", then):
        card, described, weights = (_contents(path, name) for name in FILES)
        data = json.loads(described)
        if (data["format"], data["version"]) != (FORMAT, VERSION):
            raise ValueError(
                f"it says format '{data['format']}' version {data['version']}, not '{FORMAT}' "
                f"version {VERSION}"
            )
        said = check_settings(Description, data, CONFIG)
        return PackedPrior(said, read_tensors(weights), card.decode())


def _contents(path: Path, name: str) -> bytes:
    """Read one file of a packed prior, of at most `LARGEST` bytes."""
    most = LARGEST[name]
    if path.is_dir():
        return read_bytes(path / name, most, f"{path} is not a packed prior")
    check_file(path)
    with zipfile.ZipFile(path) as archive, archive.open(name) as member:
        content = member.read(most + 1)
    if len(content) > most:
        raise ValueError(f"{name} has more than {most} bytes")
    return content


# -- Where priors are ------------------------------------------------------------------------------


def shipped_priors() -> dict[str, Path]:
    """The priors that the package ships, by name.

    >>> "procthor-bedroom" in shipped_priors()
    True
    """
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.prior"))}


def priors_that_draw(label: str) -> list[str]:
    """The shipped priors whose samplers draw a class.

    >>> priors_that_draw("wardrobe")
    ['bedroom', 'demo-bedroom']
    """
    shipped = shipped_priors().items()
    return [name for name, path in shipped if label in drawn_classes(read_packed(path))]


def drawn_classes(packed: PackedPrior) -> list[str]:
    """The classes that the sampler of a packed prior draws."""
    drawn = packed.tensors["sampler.look_class"].unique().tolist()
    return [name for index, name in enumerate(packed.said.classes) if index in drawn]


def find_prior(where: str | Path) -> Path:
    """The file or folder of a prior: a path, which takes precedence; a name of `shipped_priors`; or
    `hf://OWNER/NAME`, which is downloaded once and kept in the Hub's cache."""
    text = str(where)
    if text.startswith(HUB):
        return _fetch(text)
    path, shipped = Path(where), shipped_priors()
    if path.exists():
        return path
    if text in shipped:
        return shipped[text]
    raise InputError(
        f"No prior at {text}; give a run's folder (`sceneprior fit`), a file of `sceneprior pack`, "
        f"{HUB}OWNER/NAME, or a name: {', '.join(shipped)}."
    )


def name_of(where: str | Path) -> str:
    """The name of a prior as stored in generated files, without the folders of this machine.

    >>> name_of("runs/bedroom.prior"), name_of("hf://owner/rooms"), name_of("out/demo/run")
    ('bedroom', 'hf://owner/rooms', 'run')
    """
    text = str(where)
    return text if text.startswith(HUB) else Path(text).resolve().name.removesuffix(".prior")


def version_of(weights: Path) -> str:
    """The version of a prior: the first 12 digits of the SHA-256 of its packed file, of the weights
    in a packed folder, or of a run's checkpoint."""
    path = weights / WEIGHTS if weights.is_dir() else weights
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]


def _fetch(where: str) -> Path:
    """The folder of a repository of the Hub, downloaded unless it is in the cache."""
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise InputError(
            f"{where} is on the Hugging Face Hub, which needs one more package: pip install "
            "'sceneprior[hub]'."
        ) from None
    try:
        return Path(snapshot_download(where.removeprefix(HUB), allow_patterns=list(FILES)))
    except Exception as error:  # errors of the network, of the Hub, or an invalid name
        raise InputError(
            f"{where} cannot be fetched ({type(error).__name__}: {cause_of(error)}). Check the "
            "name and the network connection; for a private repository, set HF_TOKEN or run `hf "
            "auth login`."
        ) from None
