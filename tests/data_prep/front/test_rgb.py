"""Pictures of the views: the same cameras, the same pieces, the same bytes."""

import dataclasses
import io
import math

import numpy as np
import pytest
import shapely
from front_files import bedroom, room
from front_jobs import digests, front_job, rooms_of
from PIL import Image

from data_prep.engine.build import build_shards
from data_prep.front.drawing import shell_of
from data_prep.front.furnished import Room
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh


def areas(mesh: Mesh) -> np.ndarray:
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def test_the_shell_of_a_room_with_a_corner_and_a_pillar():
    outline = [(-2, -3), (2, -3), (2, 0), (0, 0), (0, 3), (-2, 3)]
    pillar = [(-1, -1), (-0.5, -1), (-0.5, -0.5), (-1, -0.5)]
    floor = shapely.Polygon(outline, [pillar])
    empty = Room("house_A", "Bedroom", floor, 2.5, ())
    ground, walls, ceiling = shell_of(empty)
    assert areas(ground).sum() == areas(ceiling).sum() == pytest.approx(18 - 0.25)
    assert areas(walls).sum() == pytest.approx((20 + 2) * 2.5)
    assert np.ptp(ground.vertices_m[:, 1]) == 0 and ceiling.vertices_m[:, 1].min() == 2.5
    assert (walls.vertices_m[:, 1].min(), walls.vertices_m[:, 1].max()) == (0.0, 2.5)
    two = shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(3, 0, 4, 1)])
    parts = shell_of(dataclasses.replace(empty, floor=two))
    assert [areas(part).sum() for part in parts] == pytest.approx([2, 8 * 2.5, 2])


def test_pictures_show_what_the_masks_show(front, tmp_path):
    (front.future / "bed" / "model.mtl").write_text("Kd 1 0 0\n")  # nothing else is red
    (front.future / "lamp" / "model.mtl").write_text("Kd 0 0 1\n")  # void, but in the picture
    pieces = [{"jid": "bed", "pos": (0, 0, -1)}, {"jid": "stand", "pos": (-1.4, 0, -1.8)}]
    pieces.append({"jid": "lamp", "pos": (1.3, 0, -0.8)})
    front.house("house0", room("A", pieces), room("B", pieces, yaw_rad=math.radians(30)))
    out = tmp_path / "shards"
    summary = build_shards(front_job(front, out, rgb=True))
    assert summary.statuses == {"prepared": 2}
    blue = 0
    for room_id, (views, _) in rooms_of(out).items():
        files = sorted((out / "rgb" / room_id).iterdir())
        assert [path.name for path in files] == [f"{k:04d}.png" for k in range(len(views.visible))]
        for view, path in enumerate(files):
            with Image.open(io.BytesIO(path.read_bytes())) as image:
                assert (image.size, image.mode) == ((120, 90), "RGB")
                picture = np.asarray(image).astype(int)
            bed = views.instance_ids[view] == 1
            red = (picture[..., 0] > 60) & (picture[..., 1:].max(axis=-1) == 0)
            inner = bed & np.roll(bed, 1, 0) & np.roll(bed, -1, 0) & np.roll(bed, 1, 1)
            inner &= np.roll(bed, -1, 1)  # away from edges, where colours mix
            assert red[inner].all() and not red[~bed].any()
            blue += ((picture[..., 2] > 60) & (picture[..., :2].max(axis=-1) == 0)).sum()
    assert blue > 100


def test_pictures_change_nothing_else_and_are_the_same_every_time(front, tmp_path):
    front.house("house0", bedroom("A"), bedroom("B"), bedroom("C"))
    without, once, again = (tmp_path / name for name in ("without", "once", "again"))
    build_shards(front_job(front, without))
    build_shards(front_job(front, once, rgb=True, workers=2))
    build_shards(front_job(front, again, rgb=True))
    assert digests(once) == digests(again)
    assert digests(without, "*/*.h5", "models/*") == digests(once, "*/*.h5", "models/*")
    assert not (without / "rgb").exists() and len(digests(once, "rgb/*/*.png")) > 20
    with pytest.raises(InputError, match=r"was begun with other settings \(rgb differ\)"):
        build_shards(front_job(front, without, rgb=True))
    # What a finished shard is missing comes back with the shard.
    gone = sorted(once.glob("rgb/*A/*.png"))[0]
    gone.unlink()
    for shard in once.glob("*/*.h5"):
        shard.unlink()
    build_shards(front_job(front, once, rgb=True))
    assert digests(once) == digests(again)
