"""Reading and checking YAML settings; a mistake is one sentence that names the file and the key."""

import difflib
import importlib.resources
import re
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from sceneprior.errors import ConfigError
from sceneprior.files import write_whole


class _Loader(yaml.SafeLoader):
    """Safe YAML in which 3e-4 is a number, as people write it; YAML 1.1 asks for 3.0e-4."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"),
    [*"-+0123456789"],
)


TAGS = ("name", "supervision")
"""Keys that tell a section of one kind from one of another."""


class Section(BaseModel):
    # Strict: "yes" is no number and 3.5 no count. Unknown keys are errors that name a neighbour.
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )


_S = TypeVar("_S", bound=Section)


def find_config(name: str) -> Path:
    """A path to a YAML, or the name of a config that ships with the package; else ConfigError."""
    path = Path(name)
    if path.is_file():
        return path
    folders = [
        Path(str(importlib.resources.files("sceneprior"))) / "configs",
        Path(__file__).resolve().parent.parent / "configs",
    ]
    for folder in folders:
        if path.parent == Path() and (folder / name).is_file():
            return folder / name
    shipped = sorted({item.name for folder in folders for item in folder.glob("*.yaml")})
    raise ConfigError(
        f"No config '{name}': it is neither a file nor one of the shipped {', '.join(shipped)}."
    )


def read_settings(name: str, overrides: tuple[str, ...] = ()) -> tuple[Path, dict[str, Any]]:
    """A YAML's path and what it holds, with `section.key=value` overrides applied.

    Raises:
        ConfigError: not found, not YAML, or an override that is none.
    """
    path = find_config(name)
    data = read_yaml(path)
    for override in overrides:
        apply_override(data, override)
    return path, data


def read_yaml(path: Path) -> dict[str, Any]:
    """What a YAML file of settings holds; a ConfigError where it is none."""
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path} holds no settings; expected `section:` and `key: value` lines.")
    return data


def check_settings(model: type[_S], data: dict[str, Any], source: str) -> _S:
    """Plain data as the model it should be; a ConfigError names the source and the key, and for a
    typo the nearest key."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(_explain(model, error, source)) from None


def apply_override(data: dict[str, Any], override: str, option: str = "--set") -> None:
    """Change plain data by `section.key=value`; `option` is what the user gave it with.

    Raises:
        ConfigError: it is no such text, its value no YAML, or its section a value.
    """
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
    except yaml.YAMLError:
        raise ConfigError(f"{option} {override}: '{text}' is not a YAML value.") from None


def dump_settings(settings: Section, path: Path) -> None:
    """Write settings, every default included."""
    data = settings.model_dump(mode="json", by_alias=True)
    write_whole(path, yaml.safe_dump(data, sort_keys=False).encode())


def _explain(model: type[Section], error: ValidationError, source: str) -> str:
    first, *others = error.errors(include_url=False)
    location, section, variants = _section_of(model, [str(part) for part in first["loc"]])
    key = ".".join(location)
    more = f" ({len(others)} more problem{'s' * (len(others) > 1)} after it)" if others else ""
    if first["type"] == "extra_forbidden":
        known = [field.alias or name for name, field in section.model_fields.items()]
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.0)
        return f"{source}: unknown key '{key}'; the nearest valid key is '{near[0]}'.{more}"
    if first["type"] == "missing":
        return f"{source}: '{key}' is missing and has no default; add it.{more}"
    known_names = ", ".join(variants)
    what = "" if first["type"][:9] != "union_tag" else first["ctx"]["discriminator"].strip("'")
    if first["type"] == "union_tag_not_found":
        return f"{source}: '{key}' has no {what}; add one of {known_names}.{more}"
    if first["type"] == "union_tag_invalid":
        tag = first["ctx"]["tag"]
        return f"{source}: no {what} of '{key}' is '{tag}'; choose from {known_names}.{more}"
    if first["type"] == "model_attributes_type" and variants:
        return (
            f"{source}: '{key}' is a section; write {{name: ...}} with one of {known_names}.{more}"
        )
    got = f" (got {first['input']!r})" if not isinstance(first["input"], dict) else ""
    reason = first["msg"].removeprefix("Value error, ").removesuffix(".")
    reason = reason[:1].lower() + reason[1:]
    where = f"'{key}': " if key else ""
    return f"{source}: {where}{reason}{got}.{more}"


def _section_of(
    model: type[BaseModel], location: list[str]
) -> tuple[list[str], type[BaseModel], list[str]]:
    """Where an error is, as the YAML has it, the section that holds its last key, and the names of
    the variants that this key may have.

    Pydantic puts the name of a section's variant (`decoder: {name: lstm}`) after its key.
    """
    section, keys, inner = model, list[str](), list[type[BaseModel]]()
    for part in location:
        if len(inner) > 1:  # the variants of a section; the next part names one
            section = next(v for v in inner if _tag(v) == part)
            inner = []
            continue
        section = inner[0] if inner else section
        keys.append(part)
        # A name that the user chose, of a section that `dict[str, ...]` holds, is no field.
        field = section.model_fields.get(part)
        types = (field.annotation, *get_args(field.annotation)) if field is not None else ()
        inner = [v for v in types if isinstance(v, type) and issubclass(v, BaseModel)]
    return keys, section, [str(_tag(v)) for v in inner if _tag(v)]


def _tag(variant: type[BaseModel]) -> str | None:
    """What tells a section from its alternatives, if it has any: `lstm` of {name: lstm}."""
    fields = variant.model_fields
    return next((fields[key].default for key in TAGS if key in fields), None)
