"""Reads and checks YAML settings; the message of an error names the file and the key."""

import difflib
import importlib.resources
import re
import reprlib
import sys
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from sceneprior.core.errors import ConfigError, shortened
from sceneprior.core.files import read_text, write_whole

MOST_BYTES = 2**20
"""Maximum size of a settings file."""


class _Loader(yaml.SafeLoader):
    """Safe YAML loader that also accepts 3e-4 as a number (YAML 1.1 requires 3.0e-4)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"),
    [*"-+0123456789"],
)


CONFIG_FOLDERS = ("", "paper", "lifted", "baselines", "compare")
"""Folders of `configs/`, in the order in which a bare name is looked up."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 2
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 120


class Section(BaseModel):
    # Strict: "yes" is not a number and 3.5 not a count. An unknown key is an error that names the
    # nearest valid key.
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )


class AttentionSection(Section):
    """Settings with fields `width` and `heads`."""

    @model_validator(mode="after")
    def _heads_divide_width(self) -> "AttentionSection":
        width, heads = (getattr(self, name) for name in ("width", "heads"))
        if width % heads:
            raise ValueError(f"width {width} is not a multiple of heads {heads}")
        return self


_S = TypeVar("_S", bound=Section)


def find_config(name: str) -> Path:
    """Find a config by its path, or by the name of a config that ships with the package.

    A name has a folder, as in `lifted/bedroom.yaml`, or is bare, as in `bedroom.yaml`, which means
    the first of that name in `CONFIG_FOLDERS`.
    """
    path = Path(name)
    if path.is_file():
        return path
    roots = [
        Path(str(importlib.resources.files("sceneprior"))) / "configs",
        Path(__file__).resolve().parents[2] / "configs",
    ]
    within = CONFIG_FOLDERS if path.parent == Path() else ("",)
    for found in (root / folder / name for root in roots for folder in within):
        if found.is_file() and not path.is_absolute() and ".." not in path.parts:
            return found
    shipped = sorted(
        {p.relative_to(root).as_posix() for root in roots for p in root.rglob("*.yaml")}
    )
    raise ConfigError(
        f"No config '{name}': it is neither a file nor one of the shipped {', '.join(shipped)}."
    )


def read_settings(name: str, overrides: tuple[str, ...] = ()) -> tuple[Path, dict[str, Any]]:
    """Read a config with `section.key=value` overrides; returns its path and its data."""
    path = find_config(name)
    data = read_yaml(path)
    for override in overrides:
        apply_override(data, override)
    return path, data


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file of settings."""
    text = read_text(path, MOST_BYTES)
    try:
        data = yaml.load(text, _Loader)
    # Python itself raises a ValueError for invalid dates and for numbers of thousands of digits.
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise ConfigError(f"{path} is not a YAML file: {shortened(error)}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path} holds no settings; expected `section:` and `key: value` lines.")
    return data


def check_settings(model: type[_S], data: dict[str, Any], source: str) -> _S:
    """Validate plain data as a model."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(_explain(model, error, source)) from None


def apply_override(data: dict[str, Any], override: str, option: str = "--set") -> None:
    """Change plain data by `section.key=value`; `option` is the command-line option, for errors."""
    key, equals, text = override.partition("=")
    if not equals:
        raise ConfigError(f"{option} takes section.key=value, got '{override}'.")
    *parents, last = key.strip().split(".")
    node = data
    for parent in parents:
        node = node.setdefault(parent, {})
        if not isinstance(node, dict):
            raise ConfigError(f"{option} {override}: '{parent}' is a value, not a section.")
    try:
        node[last] = yaml.load(text, _Loader)
    except (ValueError, RecursionError, yaml.YAMLError):
        raise ConfigError(
            f"{option} {shortened(override)}: '{shortened(text)}' is not a YAML value."
        ) from None


def as_value(text: str) -> str:
    """A text as a value of `apply_override`: in quotes where YAML would read something else."""
    try:
        plain = yaml.load(text, _Loader) == text
    except (ValueError, RecursionError, yaml.YAMLError):
        plain = False
    return text if plain else yaml.safe_dump(text, default_style='"', width=sys.maxsize).strip()


def dump_settings(settings: Section, path: Path) -> None:
    """Write settings to a YAML file, including defaults."""
    data = settings.model_dump(mode="json", by_alias=True)
    write_whole(path, yaml.safe_dump(data, sort_keys=False).encode())


def _explain(model: type[Section], error: ValidationError, source: str) -> str:
    first, *others = error.errors(include_url=False)
    location, section, variants = _section_of(model, [str(part) for part in first["loc"]])
    key = shortened(".".join(location))
    more = f" ({len(others)} more problem{'s' * (len(others) > 1)} after it)" if others else ""
    if first["type"] == "extra_forbidden":
        known = [field.alias or name for name, field in section.model_fields.items()]
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.0)
        valid = ".".join([*location[:-1], near[0]])
        return f"{source}: unknown key '{key}'; the nearest valid key is '{valid}'.{more}"
    if first["type"] == "missing":
        return f"{source}: '{key}' is missing and has no default; add it.{more}"
    known_names = ", ".join(variants)
    what = "" if first["type"][:9] != "union_tag" else first["ctx"]["discriminator"].strip("'")
    if first["type"] == "union_tag_not_found":
        return f"{source}: '{key}' has no {what}; add one of {known_names}.{more}"
    if first["type"] == "union_tag_invalid":
        tag = shortened(first["ctx"]["tag"])
        return f"{source}: no {what} of '{key}' is '{tag}'; choose from {known_names}.{more}"
    if first["type"] == "model_attributes_type" and variants:
        return (
            f"{source}: '{key}' is a section; write {{name: ...}} with one of {known_names}.{more}"
        )
    got = f" (got {_SHORT.repr(first['input'])})" if not isinstance(first["input"], dict) else ""
    reason = shortened(first["msg"].removeprefix("Value error, ").removesuffix("."))
    reason = reason[:1].lower() + reason[1:]
    where = f"'{key}': " if key else ""
    return f"{source}: {where}{reason}{got}.{more}"


def _section_of(
    model: type[BaseModel], location: list[str]
) -> tuple[list[str], type[BaseModel], list[str]]:
    """Translate a pydantic error location to the YAML's keys.

    Pydantic inserts the name of a section's variant (`decoder: {name: lstm}`) after its key. Also
    returns the section of the last key, and the names of the variants that this key may have.
    """
    section, keys, inner = model, list[str](), list[type[BaseModel]]()
    for part in location:
        if len(inner) > 1:  # several variants of a section; the next part names one
            section = next(v for v in inner if _tag(v) == part)
            inner = []
            continue
        section = inner[0] if inner else section
        keys.append(part)
        # A key chosen by the user, in a `dict[str, ...]`, is not a field.
        field = section.model_fields.get(part)
        types = (field.annotation, *get_args(field.annotation)) if field is not None else ()
        inner = [v for v in types if isinstance(v, type) and issubclass(v, BaseModel)]
    return keys, section, [str(_tag(v)) for v in inner if _tag(v)]


def _tag(variant: type[BaseModel]) -> str | None:
    """Name that distinguishes a variant of a section, if it has one: `lstm` in {name: lstm}."""
    fields = variant.model_fields
    return fields["name"].default if "name" in fields else None
