"""Every metric says once what tables and docs need, and docs/evaluation.md lists it as it is."""

from pathlib import Path

from sceneprior.evaluation.registry import METRICS, as_markdown

DOCS = Path(__file__).parents[2] / "docs" / "evaluation.md"


def test_the_docs_list_every_metric_as_it_is():
    text = DOCS.read_text()
    listed = text.split("<!-- metrics")[1].split("-->\n\n")[1].split("\n<!-- end")[0]
    assert listed == as_markdown(), (
        "docs/evaluation.md is out of date; put there what `python -c 'from "
        "sceneprior.evaluation.registry import as_markdown; print(as_markdown())'` prints."
    )


def test_metrics_of_one_network_stand_together_and_apply_where_it_is_given():
    networks = [metric.network for metric in METRICS]
    blocks = [n for row, n in enumerate(networks) if row == 0 or networks[row - 1] != n]
    assert blocks == ["inception", "alexnet", "effnet_lite0", None]
    lacking = {metric.key: metric.lacks(["effnet_lite0"], boxes=False) for metric in METRICS}
    plain = {key for key, want in lacking.items() if want is None}
    assert (lacking["fid"], lacking["sca"], lacking["gap_closed_boxes"]) == (
        "--inception", "--alexnet", "--boxes"
    )  # fmt: skip
    assert "fd_effnet_lite0" in plain and "mean_objects" in plain
    assert not plain & {"fid", "kid", "sca", "fd_effnet_lite0_boxes", "fid_boxes"}
