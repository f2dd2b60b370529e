"""Pages of the site from outside of docs/: the reference of all commands, and configs/README.md."""

from pathlib import Path
from typing import Any

import typer.cli
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from typer.main import get_command

from sceneprior.apps.cli.commands import app

CONFIGS = Path(__file__).parents[1] / "configs" / "README.md"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add `cli.md` and `configs.md`."""
    files.append(File.generated(config, "cli.md", content=commands_page()))
    text = CONFIGS.read_text().replace("](../docs/", "](")
    files.append(File.generated(config, "configs.md", content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to configs/README.md lead to its page."""
    return markdown.replace("](../configs/README.md", "](configs.md")


def commands_page() -> str:
    """All commands and their options in Markdown, as typer writes it from their own help."""
    command = get_command(app)
    with command.make_context("sceneprior", [], resilient_parsing=True) as context:
        text = typer.cli.get_docs_for_click(obj=command, ctx=context, name="sceneprior")
    return f"# Commands\n\n{text}"
