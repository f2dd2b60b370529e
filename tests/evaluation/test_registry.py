"""Every metric says once what tables and docs need, and docs/evaluation.md lists it as it is."""

from pathlib import Path

from sceneprior.evaluation.registry import as_markdown

DOCS = Path(__file__).parents[2] / "docs" / "evaluation.md"


def test_the_docs_list_every_metric_as_it_is():
    text = DOCS.read_text()
    listed = text.split("<!-- metrics")[1].split("-->\n\n")[1].split("\n<!-- end")[0]
    assert listed == as_markdown(), (
        "docs/evaluation.md is out of date; put there what `python -c 'from "
        "sceneprior.evaluation.registry import as_markdown; print(as_markdown())'` prints."
    )
