"""Write docs/configuration.md from the types and docstrings of all settings.

python docs/write_configuration.py docs/configuration.md
"""

import inspect
import json
import pkgutil
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NamedTuple, get_args, get_origin

from sceneprior.apps.config import METHODS, WITH_BASELINE_DECODERS
from sceneprior.core.settings import Section, find_config, read_yaml

PAPER = "paper/bedroom.yaml"
LINE = 110
HEAD = f"""# All settings

The keys of a run's YAML, by method and section: type and range, the default (a key without one
must be given), the value in `configs/{PAPER}` (bedroom.yaml), and the effect. That file has the
paper's settings where the paper gives them ([key by key](paper_map.md#the-settings-key-by-key)). A
key is described once; keys that a section shares with an earlier one, with the same default, are
only named. On the command line, `--set layout.epochs=10` changes a key. [Which config to
take](../configs/README.md) is another page.

<!-- Written by docs/write_configuration.py from the docstrings of the settings; change those. -->
"""
BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
TYPES = {int: "integer", float: "number", bool: "true or false", str: "text", NoneType: "null"}


class Key(NamedTuple):
    """A key of a section: its names from the top, and where it is defined."""

    path: tuple[str, ...]
    section: type[Section]
    name: str
    default: Any

    @property
    def owner(self) -> type:
        """The class whose docstring describes the key."""
        return next(
            base
            for base in self.section.__mro__
            if self.name in getattr(base, "__annotations__", ()) and described(base, self.name)
        )


def described(base: Any, name: str) -> str | None:
    """The description of a key in a class; the name of a variant has that of the whole variant."""
    if name == "name":
        return inspect.cleandoc(base.__doc__)
    field = base.model_fields[name] if name in base.__annotations__ else None
    return None if field is None else field.description


def sections_of(annotation: Any) -> list[type[Section]]:
    """The sections, one or several variants, that a key may have."""
    every = [annotation, *get_args(annotation)]
    return [one for one in every if isinstance(one, type) and issubclass(one, Section)]


def keys_of(section: type[Section], path: tuple[str, ...] = (), given: Any = None) -> Iterator[Key]:
    """All keys of a section and of those within it; `given` is the section's own default."""
    for name, field in section.model_fields.items():
        default = field.get_default() if given is None else getattr(given, name, field.default)
        key = Key((*path, field.alias or name), section, name, default)
        inner = sections_of(field.annotation)
        for part in inner:
            yield from keys_of(part, key.path, default if isinstance(default, part) else None)
        if not inner:
            yield key


def type_of(annotation: Any) -> str:
    """A type in words."""
    if get_origin(annotation) is Literal:
        return " or ".join(f"`{choice}`" for choice in get_args(annotation))
    if get_origin(annotation) in (dict, tuple):
        return "section" if get_origin(annotation) is dict else "list"
    parts = get_args(annotation) or (annotation,)
    return " or ".join(TYPES.get(part) or type_of(part) for part in parts)


def entry(key: Key, paper: Any) -> str:
    """The line of a key."""
    field = key.section.model_fields[key.name]
    dotted = ".".join(key.path[1:] or key.path)
    text = re.sub(r"\bNone\b", "null", " ".join((described(key.owner, key.name) or "").split()))
    if key.name == "name":
        return wrapped(f"- **`{dotted}: {key.default}`**: {text}")
    bounds = [
        f"{sign} {shown(getattr(bound, word))}"
        for bound in field.metadata
        for word, sign in BOUNDS.items()
        if hasattr(bound, word)
    ]
    said = [" ".join([type_of(field.annotation), ", ".join(bounds)]).strip()]
    said += [] if field.is_required() else [f"default {shown(key.default)}"]
    variant = key.section.model_fields.get("name")
    for part in key.path:
        same = isinstance(paper, dict) and (
            variant is None or paper.get("name", variant.default) == variant.default
        )
        paper = paper.get(part) if same else None
    said += [] if paper is None else [f"bedroom.yaml {shown(paper)}"]
    return wrapped(f"- **`{dotted}`** ({'; '.join(said)}): {text}")


def shown(value: Any) -> str:
    return f"`{value}`" if isinstance(value, str) else json.dumps(value)


def wrapped(text: str) -> str:
    return textwrap.fill(text, LINE, subsequent_indent="  " * text.startswith("-"),
        break_long_words=False, break_on_hyphens=False)  # fmt: skip


def page() -> str:
    """The whole page."""
    lines, paper, known = [HEAD], read_yaml(find_config(PAPER)), dict[Any, str]()
    for method, where in METHODS.items():
        config = pkgutil.resolve_name(WITH_BASELINE_DECODERS.get(method, where))
        lines.append(f"## `method: {method}`\n")
        sections: dict[str, list[Key]] = {}
        for key in keys_of(config):
            if key.path != ("method",):
                sections.setdefault(key.path[0] if key.path[1:] else "", []).append(key)
        for section, keys in sections.items():
            place = f"`{section}` of `{method}`" if section else f"the top of `{method}`"
            entries, same = list[str](), dict[str, list[str]]()
            for key in keys:
                first = known.setdefault((key.owner, key.name, repr(key.default)), place)
                if first != place:
                    same.setdefault(first, []).append(f"`{'.'.join(key.path[1:] or key.path)}`")
                    continue
                entries.append(entry(key, paper if method == "paper" else {}))
            for at, names in same.items():
                entries.append(wrapped(f"- As in {at}: {', '.join(dict.fromkeys(names))}."))
            lines.append("\n".join([f"### `{section}`\n"] * bool(section) + entries) + "\n")
    return "\n".join(lines)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page())
