"""Find a prior by path, by the name of a shipped prior, or by a repository of the Hub."""

import hashlib
from pathlib import Path

from sceneprior.apps.priors.packed import FILES, WEIGHTS
from sceneprior.core.errors import InputError

HUB = "hf://"


def shipped_priors() -> dict[str, Path]:
    """The priors that the package ships, by name.

    >>> "procthor-bedroom" in shipped_priors()
    True
    """
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.prior"))}


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
        reason = " ".join(str(error).split())[:160]
        raise InputError(
            f"{where} cannot be fetched ({type(error).__name__}: {reason}). Check the name and the "
            "network connection; for a private repository, set HF_TOKEN or run `hf auth "
            "login`."
        ) from None
