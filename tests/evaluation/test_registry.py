"""docs/evaluation.md defines every metric, with the unit and the direction that tables show."""

from pathlib import Path

from sceneprior.evaluation.metrics import DECODED, METRICS, USE

DOCS = Path(__file__).parents[2] / "docs" / "evaluation.md"
BETTER = {"closer": "lower", "lower": "lower", "higher": "higher", "half": "0.5", "none": "–"}


def test_the_docs_define_every_metric_in_the_order_of_tables():
    lines = [line for line in DOCS.read_text().splitlines() if line.startswith("| `")]
    listed = [line.rsplit(" | ", 1)[0] for line in lines]
    against = [metric for metric in METRICS if "test" not in metric.sets]
    alone = [metric for metric in METRICS if "test" in metric.sets]
    for group in (against, alone, USE, DECODED):
        wanted = [f"| `{m.key}` | {m.unit} | {BETTER[m.direction]}" for m in group]
        start = listed.index(wanted[0])
        assert listed[start : start + len(wanted)] == wanted
