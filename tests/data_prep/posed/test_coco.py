"""COCO's files of many images, and of videos, that cannot be used."""

import json

import capture_files as tools
import pytest
from capture_files import refusal


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda data: data["annotations"].clear(), "has no annotations; expected one for each"),
        (lambda data: data["annotations"][2].update(image_id=99), "image 99 is not amo"),
        (
            lambda data: data["annotations"][2].update(category_id=99),
            "category 99 is not amo",
        ),
        (lambda data: data["images"][0].update(height=10**6, width=10**6), "1000000 x 1000000 pi"),
        (
            lambda data: data["images"][0].update(height=97),
            "mask has 128 x 96 pixels, but t",
        ),
        (lambda data: data["annotations"][2].update(segmentation=None), "is neither polygons nor"),
        (lambda data: data.pop("images"), "is not a COCO JSON of masks: images is"),
    ],
)
def test_coco_files_that_cannot_be_used(room, change, said):
    tools.write_coco_images(room)
    path = room.folder / "coco.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    assert str(path) in refusal(room) and said in refusal(room)


def test_coco_results_and_several_files(room):
    tools.write_coco_images(room)
    path = room.folder / "coco.json"
    text = path.read_text()
    path.write_text("[]")
    assert f"{path} is a list of results, not a COCO JSON of masks; exp" in refusal(room)
    path.write_text(text[:-9])
    assert "coco.json is not JSON" in refusal(room)
    (room.folder / "instances.json").write_text(text)
    assert "has several COCO files (coco.json, instances.json); a room has one:" in refusal(room)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda data: data["videos"].append(data["videos"][0]), "describes 2 videos; keep that of"),
        (
            lambda data: data["annotations"][0]["segmentations"].pop(),
            "it has 9 masks of video 3, but video 3 has 10 frames; an annotation has a mask, or",
        ),
        (lambda data: data["annotations"][0].update(video_id=4), "masks of video 4, but video 3"),
    ],
)
def test_coco_videos_that_cannot_be_used(room, change, said):
    tools.write_coco_video(room)
    path = room.folder / "instances.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    assert str(path) in refusal(room) and said in refusal(room)


@pytest.mark.parametrize("video", [True, False])
def test_more_objects_than_ids(room, video, monkeypatch):
    monkeypatch.setattr("data_prep.readers.posed.coco.LARGEST_ID", 3)
    if video:
        tools.write_coco_video(room)
        assert "instances.json has 3 objects; expected at most 2." in refusal(room)
    else:
        tools.write_coco_images(room, "track_id")
        assert "coco.json has 3 tracks; expected at most 2." in refusal(room)
