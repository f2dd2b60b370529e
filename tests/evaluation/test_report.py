"""The page stands alone: nothing outside itself, nothing of a machine, all it promises."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from toy_metrics import without_classifiers

from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.evaluation.page import write_rooms_page
from sceneprior.evaluation.report import write_report
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis


@pytest.fixture(scope="module")
def generated(shards) -> list[Scene]:
    scenes = reference_scenes(shards, "train", limit=4)
    return [replace(scene.without_meshes(), floor_m=None) for scene in scenes]


@pytest.fixture(scope="module")
def page(shards, generated, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("report") / "new" / "report.html"
    truth = reference_scenes(shards, "train", limit=2, tracked_only=True)
    with pytest.MonkeyPatch.context() as patch:
        without_classifiers(patch)
        scores = evaluate_synthesis(generated, shards, EvalOptions(resamples=20))
    scores |= {"class_accuracy": 0.991, "box_iou_3d": 0.74, "seconds": 600.0}
    scores |= {"mask_iou_held_out": 0.81}
    write_report(
        path,
        title="Bedrooms <new> & real",
        shards=shards,
        source="run my_run",
        made_by="Paper's method; rooms drawn by: paper",
        views=True,
        generated=generated,
        scores=scores,
        commands=["sceneprior synthesize --run RUN -n 16", "make demo && echo '<done>'"],
        curves={"layout/box": [(step, 1 / (1 + step)) for step in range(1000)], "nothing": []},
        decoded=[(generated[0], truth[0]), (generated[1], truth[1])],
        unfolding=generated,
    )
    assert [item.name for item in path.parent.iterdir()] == ["report.html"]
    assert path.stat().st_size < 8e6
    return path.read_text(encoding="utf-8")


class Tags(HTMLParser):
    """Every opened tag with its attributes, and a check that all are closed in order."""

    EMPTY = ("meta", "img", "br")

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_needs_nothing_outside_itself(page, shards):
    """The only script of the page is the viewer, which tests/evaluation/test_page.py opens in a
    browser."""
    parsed = Tags(page)
    assert parsed.open == []
    assert [tag for tag, _ in parsed.tags].count("script") == 1
    page = re.sub("<script>.*</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"https?:", page)
    kinds = {tag for tag, _ in parsed.tags}
    assert not kinds & {"link", "iframe", "object"}
    models = [attrs for tag, attrs in parsed.tags if tag == "model-viewer"]
    assert len(models) == 4 + 5 + 2 * 2  # generated, test, pairs
    assert all(attrs["src"].startswith("data:model/gltf-binary;") for attrs in models)
    pictures = [attrs for tag, attrs in parsed.tags if tag == "img"]
    assert all(attrs["src"].startswith("data:image/") and attrs["alt"] for attrs in pictures)
    assert "url(" not in page and "@import" not in page
    assert str(shards.parent) not in page
    assert "my_run" in page and shards.name in page


def test_every_part_is_there(page):
    for heading in (
        "New rooms beside real ones", "Interpolation on the sphere", "Scores", "Training input",
        "Decoded training rooms", "Learning curves", "Commands that made this page",
    ):  # fmt: skip
        assert f"<h2>{heading}</h2>" in page
    # 4 generated, 4 unfolding, 5 test rooms and 2 pairs, each drawn twice, 6 views, 1 of curves.
    assert page.count("<img") == 2 * (4 + 4 + 5 + 2 * 2) + 6 + 1
    assert "99.1%" in page and "10.0 min" in page and "not FID" in page
    assert "mean soft mask IoU in held-out views" in page
    assert "of the Frechet gap to real rooms closed" in page and "Gap closed, from" in page
    assert "cannot be compared with the paper" in page
    assert "100% of 2 classes right, mean 3D box IoU 1.00" in page


def test_a_page_of_a_stranger_s_rooms_runs_nothing(tmp_path):
    label = "<img src=x onerror='alert(1)'>"
    item = SceneObject(label, (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    room = Scene("</figcaption><script>alert(2)</script>", f"void,{label}", (item,))
    write_rooms_page(tmp_path / "a.html", [room], title=label, subtitle=label)
    page = (tmp_path / "a.html").read_text("utf-8")
    assert "<img src=x" not in page and "<script>alert" not in page
    assert "&lt;script&gt;alert(2)" in page and 'alt="&lt;img src=x onerror=&#39;' in page
