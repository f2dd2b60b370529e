"""A folder remembers what it was begun for: the same goes on, anything else is refused."""

import json

import pytest
from front_files import bedroom
from front_jobs import digests, front_job, rooms_of, three_houses

from data_prep.engine.build import build_shards
from sceneprior.core.errors import InputError


def test_other_settings_want_another_folder(front, tmp_path):
    three_houses(front)
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    with pytest.raises(InputError, match=r"begun with other settings \(seed differ\).*new folder"):
        build_shards(front_job(front, out, seed=1))
    with pytest.raises(InputError, match=r"\(recipe, renderer differ\)"):
        build_shards(front_job(front, out, rules=("views.per_m2=3",), renderer="pyrender"))
    front.house("house9", bedroom("Bedroom-9"))
    with pytest.raises(InputError, match=r"\(houses differ\)"):
        build_shards(front_job(front, out))
    plan = json.loads((out / "plan.json").read_text())
    plan["settings"]["plan_version"] = 1
    (out / "plan.json").write_text(json.dumps(plan | {"rooms": [{"room_id": "a", "area_m2": 1}]}))
    with pytest.raises(
        InputError, match=r"was written by another release \(plan version 1\); choose a new"
    ):
        build_shards(front_job(front, out))
    (out / "plan.json").write_text("{")
    with pytest.raises(InputError, match=r"plan\.json cannot be read"):
        build_shards(front_job(front, out))
    (out / "plan.json").unlink()
    with pytest.raises(InputError, match=r"holds shards without a plan\.json"):
        build_shards(front_job(front, out))


def test_only_works_on_a_part_of_a_folder_that_was_begun_for_everything(front, tmp_path):
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(20)))
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    expected = digests(out)
    for name in ("train/bedroom_0001.h5", "test/bedroom_0000.h5"):
        (out / name).unlink()
    plan = json.loads((out / "plan.json").read_text())
    asked = [room["room_id"] for room in plan["rooms"] if room["split"] == "train"][9]
    part = build_shards(front_job(front, out, only=asked.replace("_", "/", 1)))
    assert (part.shards_made, part.shards_kept, part.shards_open) == (1, 2, 1)
    assert part.statuses == {"prepared": 1} and part.report["rooms"][0]["room_id"] == asked
    assert asked in rooms_of(out)
    assert not (out / "index.json").exists() and not (out / "report.json").exists()
    with pytest.raises(InputError, match=r"--only house/attic selects no room of the plan"):
        build_shards(front_job(front, out, only="house/attic"))
    with pytest.raises(InputError, match=r"\(seed differ\)"):
        build_shards(front_job(front, out, only=asked, seed=1))
    assert build_shards(front_job(front, out)).shards_made == 1
    assert digests(out) == expected
    # The other way round it is another job.
    alone = tmp_path / "alone"
    build_shards(front_job(front, alone, only=asked))
    with pytest.raises(InputError, match=r"begun with other settings \(only differ\)"):
        build_shards(front_job(front, alone))


def test_a_finished_folder_is_left_as_it_is(front, tmp_path):
    """Not one file is written again, so it may be read-only."""
    three_houses(front)
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    build_shards(front_job(front, out))
    build_shards(front_job(front, out, only="house1"))
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == times
