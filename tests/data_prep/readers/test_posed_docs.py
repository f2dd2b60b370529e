"""docs/posed_data.md runs as printed: its ten lines, then its commands."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from pages import ROOT, first_block, run_first_commands
from PIL import Image
from posed_files import PosedRoom, furniture

from sceneprior.core.id_tables import read_mask

DOCUMENT = ROOT / "docs" / "posed_data.md"


@pytest.mark.slow
def test_the_example_runs_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = first_block(DOCUMENT, "python")
    assert len(lines.splitlines()) == 10
    for k, name in enumerate(("attic", "cellar", "hall")):
        made = PosedRoom(Path(), furniture(0.1 * k))
        views = [(pose, made.ids(view)) for view, pose in enumerate(made.poses)]
        code = lines.replace("attic", name)
        exec(code, {"Path": Path, "Image": Image, "np": np, "json": json, "views": views})
    run_first_commands(DOCUMENT)
    assert len(list(Path("scenes").glob("*.glb"))) == 2
    with Image.open("shards/inspect.png") as sheet:
        assert sheet.width > 1000
    page = Path("run/report.html").read_text()
    assert "<h2>New rooms</h2>" in page and "have no 3D boxes" in page and "Real, test" not in page
    assert "<h2>Training input</h2>" in page and "<h2>Learning curves</h2>" in page
    scores = json.loads(Path("run/scores.json").read_text())
    assert 0 <= scores["category_kl"] < 0.1 and "mask_iou_training_views" not in scores
    assert "known from views alone" in page


def test_every_key_that_is_read_is_in_the_document():
    from data_prep.readers.posed import transforms
    from data_prep.readers.posed.recording import Camera
    from sceneprior.core import id_tables

    text = DOCUMENT.read_text()
    keys = {word for key in re.findall(r"`([^`]+)`", transforms.__doc__) for word in key.split()}
    assert len(keys) == 8
    for word in keys | set(Camera.model_fields):
        spelt = f"`{word}`" if not re.fullmatch(r"k[23]", word) else "`k1` to `k4`"
        assert spelt in text, word
    for name in id_tables.SHELL:
        assert f"`{name}`" in text


def test_colours_become_ids_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    colours = np.array([[(0, 0, 0), (255, 0, 3)], [(7, 7, 7), (255, 0, 3)]], dtype=np.uint8)
    for name in ("coloured", "instances"):
        Path(name).mkdir()
    for k, picture in enumerate((colours, colours[::-1])):
        Image.fromarray(picture).save(f"coloured/{k}.png")
    code = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)[1]
    exec(code, {"Path": Path, "Image": Image, "np": np})
    one, other = (read_mask(Path(f"instances/{k}.png")) for k in (0, 1))
    assert one.tolist() == other[::-1].tolist() == [[0, 2], [1, 2]]
