"""Pages of the site that are made from code: the reference of all commands."""

import typer.cli
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from typer.main import get_command

from sceneprior.apps.cli.commands import app


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add `cli.md`."""
    files.append(File.generated(config, "cli.md", content=commands_page()))
    return files


def commands_page() -> str:
    """All commands and their options in Markdown, as typer writes it from their own help."""
    command = get_command(app)
    with command.make_context("sceneprior", [], resilient_parsing=True) as context:
        text = typer.cli.get_docs_for_click(obj=command, ctx=context, name="sceneprior")
    return f"# Commands\n\n{text}"
