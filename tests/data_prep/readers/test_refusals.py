"""Damaged and foreign files of every format: each is refused in one sentence of the golden file."""

import csv
import io
import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from capture_files import SEGMENTS, timestamp
from PIL import Image
from posed_files import SET
from public_files import write_hdf5
from refusals import refused
from scan_files import frame_header, png, sens_bytes, sens_header, write_ply, write_zip
from toy_formats import FORMATS

from data_prep.engine.plan import read_splits
from data_prep.engine.source import RoomTask
from data_prep.readers import DATA_SETS, open_reader
from data_prep.readers.posed.formats import read_formats, read_label_set
from data_prep.readers.posed.reader import Posed, find_rooms
from data_prep.readers.scan_files import open_masks, read_sens
from data_prep.readers.scannet import ScanNet, find_scans, split_scans

Damage = Callable[[Path], object]


def edit(name: str, change: Callable[[Any], object]) -> Damage:
    """Change the contents of a JSON file."""

    def damage(folder: Path) -> None:
        data = json.loads((folder / name).read_text())
        change(data)
        (folder / name).write_text(json.dumps(data))

    return damage


def keys(name: str, **changes: Any) -> Damage:
    """Other values of a JSON's keys; None takes a key away."""

    def change(data: dict[str, Any]) -> None:
        data.update(changes)
        for key in [key for key, value in changes.items() if value is None]:
            del data[key]

    return edit(name, change)


def text(name: str, content: str | bytes) -> Damage:
    content = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(content)


def cut(name: str, end: int) -> Damage:
    """Keep a file's first bytes only."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:end])


def gone(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def array(name: str, value: Any) -> Damage:
    return lambda folder: np.save(folder / name, value, allow_pickle=True)


def image(name: str, value: Any) -> Damage:
    return lambda folder: Image.fromarray(np.asarray(value, dtype=np.uint8)).save(folder / name)


def hdf5(name: str, **arrays: Any) -> Damage:
    """Replace arrays of an HDF5 file; None takes one away, and `only` all others."""

    def damage(folder: Path) -> None:
        with h5py.File(folder / name) as file:
            found = {key: file[key][()] for key in file} if "only" not in arrays else {}
        found |= {key: value for key, value in arrays.items() if key != "only"}
        write_hdf5(folder / name, **{k: value for k, value in found.items() if value is not None})

    return damage


ROOM, POSES, SIZE = "attic", "attic/transforms.json", (96, 128)
PNG = "attic/instances/frame_00001.png"


def frame(**changes: Any) -> Damage:
    return edit(POSES, lambda data: data["frames"][1].update(changes))


POSED: dict[str, Damage] = {
    "frames empty": keys(POSES, frames=[]),
    "frames of another type": keys(POSES, frames=3),
    "frame without a name": keys(POSES, frames=[{"file_path": 3}]),
    "frame without a pose": keys(POSES, frames=[{"file_path": "frame_00000.jpg"}]),
    "focal length of words": keys(POSES, fl_x="wide"),
    "size of half a pixel": keys(POSES, w=12.5),
    "no focal length": keys(POSES, fl_x=None, fl_y=None),
    "negative focal length": keys(POSES, fl_x=-1),
    "angle in degrees": keys(POSES, fl_x=None, camera_angle_x=62.0),
    "long focal length": keys(POSES, fl_y=2600),
    "focal length as a share": keys(POSES, fl_x=0.6),
    "coefficient of a fisheye": keys(POSES, k4=0.03),
    "unknown camera model": keys(POSES, camera_model="FULL_OPENCV"),
    "fisheye with p2": keys(POSES, is_fisheye=True, p2=0.1),
    "lens that folds": keys(POSES, k1=-0.9),
    "fisheye of larger pictures": keys(
        POSES, camera_model="OPENCV_FISHEYE", k1=0.05, cx=640.0, cy=480.0, w=None, h=None
    ),
    "no scale": keys(POSES, metres_per_unit=0),
    "wrong scale": keys(POSES, metres_per_unit=100),
    "half a centre": keys(POSES, floor_center_m=[1]),
    "high floor": keys(POSES, floor_m=1.55),
    "other aspect": keys(POSES, w=100),
    "small matrix": frame(transform_matrix=[[1, 2], [3, 4]]),
    "path of a number": frame(instance_path=3),
    "path with a zero": frame(instance_path="a\0b"),
    "long path": frame(instance_path="x" * 300),
    "shared ids": frame(file_path="other/frame_00000.png"),
    "no JSON": text(POSES, "{"),
    "list": text(POSES, "[1, 2]"),
    "bytes": text(POSES, b"\xff\xfe"),
    "mask of another size": image(PNG, np.zeros((96, 127))),
    "mask turned": image(PNG, np.zeros((128, 96))),
    "masks turned": lambda folder: [
        image(str(path.relative_to(folder)), np.zeros((128, 96)))(folder)
        for path in folder.glob("attic/instances/*.png")
    ],
    "coloured ids": image(PNG, np.zeros((96, 128, 3))),
    "damaged PNG": cut(PNG, 60),
    "masks that are missing": lambda folder: shutil.rmtree(folder / "attic/instances"),
    "known pixels of another size": lambda folder: (
        frame(mask_path="known.png")(folder), image("attic/known.png", np.ones((95, 128)))(folder)
    ),
    "no table of classes": gone("attic/classes.json"),
    "two tables": text("attic/classes.csv", "3,bed"),
    "no class of the set": text("attic/classes.json", '{"1": "lamp", "2": "vase"}'),
}  # fmt: skip
"""Damages of a room of transforms.json and PNGs of ids."""


def poses(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    def of(data: dict[str, Any]) -> None:
        for item in data["frames"]:
            item["transform_matrix"] = change(np.array(item["transform_matrix"])).tolist()

    return edit(POSES, of)


POSED |= {
    "left-handed poses": poses(lambda pose: pose @ np.diag([1.0, 1, -1, 1])),
    "lost poses": poses(lambda pose: pose * np.nan),
    "transposed poses": poses(lambda pose: pose.T),
    "scaled poses": poses(lambda pose: pose @ np.diag([3.0, 3, 3, 1])),
    "poses with a last row": poses(lambda pose: pose + np.eye(4)[::-1]),
    "sheared poses": poses(lambda pose: pose @ np.diag([1.0, 2, 0.5, 1])),
    "huge poses": poses(lambda pose: pose * 1e12),
    "inverted poses": poses(np.linalg.inv),
    "y up": poses(lambda pose: np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
                  @ pose + np.diag([0, 0, 0, 0.0]) - np.eye(4)[1][:, None] * np.eye(4)[3] * 2),
}  # fmt: skip

CLOUD = "attic/sparse/0"
COLMAP: dict[str, Damage] = {
    "cut model": cut(f"{CLOUD}/images.bin", 20),
    "no image": text(f"{CLOUD}/images.bin", struct.pack("<Q", 0)),
    "other camera": text(f"{CLOUD}/cameras.bin", struct.pack("<QiiQQ3d", 1, 9, 0, 3, 3, 1, 1, 1)),
    "camera model": text(f"{CLOUD}/cameras.bin", struct.pack("<QiiQQ", 1, 7, 6, 3, 3)),
}

LABELS = "attic/json_data/mask_frame_00000.json"
IDS = "attic/mask_data/mask_frame_00000.npy"
COCO, VIDEO = "attic/coco.json", "attic/instances.json"
KEYFRAME = f"attic/keyframes/corrected_cameras/{timestamp(3)}.json"
PANOPTIC = "attic/panoptic.json"


def annotation(**changes: Any) -> Damage:
    return edit(COCO, lambda data: data["annotations"][2].update(changes))


def segment(**changes: Any) -> Damage:
    return edit(PANOPTIC, lambda data: data["annotations"][1]["segments_info"][0].update(changes))


OTHERS: dict[str, dict[str, Damage]] = {
    "transforms": POSED,
    "colmap": COLMAP,
    "polycam": {"entry of words": keys(KEYFRAME, t_12="far"), "cut": cut(KEYFRAME, 40)},
    "record3d": {
        "no poses": keys("attic/metadata", poses=[]),
        "short pose": edit("attic/metadata", lambda data: data["poses"][1].pop()),
        "short intrinsics": edit("attic/metadata", lambda data: data["K"].pop()),
        "no width": keys("attic/metadata", w=None),
        "selfies": keys("attic/metadata", poses=[[0, 0, 0, 1, 0, 0, 0]] * 10),
        "one lens": keys("attic/metadata", perFrameIntrinsicCoeffs=[[1, 1, 1, 1]]),
    },
    "sam2": {
        "no table of classes": gone("attic/classes.json"),
        "mask of another size": image("attic/007/frame_00001.png", np.zeros((9, 8))),
        "folder twice": lambda folder: (folder / "attic/007").rename(folder / "attic/03"),
        "folder 0": lambda folder: (folder / "attic/007").rename(folder / "attic/000"),
        "other names": lambda folder: [
            path.rename(path.with_name(path.name.removeprefix("frame_")))
            for path in sorted(folder.glob("attic/*/*.png"))
        ],
    },
    "grounded-sam2": {
        "floats": array(IDS, np.zeros(SIZE)),
        "three axes": array(IDS, np.zeros((2, *SIZE), dtype=bool)),
        "negative ids": array(IDS, np.full(SIZE, -3)),
        "large ids": array(IDS, np.full(SIZE, 65_535)),
        "objects": array(IDS, np.array([{}])),
        "id of words": lambda folder: (folder / LABELS).write_text(
            (folder / LABELS).read_text().replace('"300": {', '"x": {')
        ),
        "no classes": lambda folder: [path.unlink() for path in folder.glob("attic/json_data/*")],
        "other names": lambda folder: [
            path.rename(path.with_name(path.name.replace("frame_", "")))
            for path in sorted(folder.glob("attic/mask_data/*.npy"))
        ],
    },
    "grounded-sam2, images": {
        "no path": lambda folder: (folder / "attic/json_data/results_3.json").write_text(
            (folder / "attic/json_data/results_3.json").read_text().replace("image_path", "path")
        ),
        "picture twice": keys("attic/json_data/results_3.json", image_path="frame_00002.jpg"),
    },
    "coco": {
        "no annotations": keys(COCO, annotations=[]),
        "unknown image": annotation(image_id=99),
        "unknown category": annotation(category_id=99),
        "no mask": annotation(segmentation=None),
        "boxes": annotation(segmentation=[]),
        "huge image": edit(COCO, lambda data: data["images"][0].update(height=10**6, width=10**6)),
        "image of another size": edit(COCO, lambda data: data["images"][0].update(height=97)),
        "no images": keys(COCO, images=None),
        "results": text(COCO, "[]"),
        "image id twice": edit(
            COCO, lambda data: data["images"].append(data["images"][0] | {"file_name": "b.jpg"})
        ),
        "category id twice": edit(
            COCO, lambda data: data["categories"].append(data["categories"][0] | {"name": "chair"})
        ),
        "two files": lambda folder: shutil.copy(folder / COCO, folder / VIDEO),
    },
    "coco, video": {
        "two videos": edit(VIDEO, lambda data: data["videos"].append(data["videos"][0])),
        "missing mask": edit(VIDEO, lambda data: data["annotations"][0]["segmentations"].pop()),
        "other video": edit(VIDEO, lambda data: data["annotations"][0].update(video_id=4)),
    },
    "panoptic": {
        "changing class": segment(category_id=27),
        "unknown category": segment(category_id=1),
        "no categories": keys(PANOPTIC, categories=None),
        "no annotations": keys(PANOPTIC, annotations=[]),
        "id of words": segment(id="x"),
        "grey ids": image("attic/instances/frame_00000.png", np.zeros(SIZE)),
    },
}  # fmt: skip
assert SEGMENTS[3] == 70_001

VIEW, HOUSE = "scene_00007/2D_rendering/480/perspective/full/0", "house/0.hdf5"
CAMERAS, SCENE = "metadata_camera_parameters.csv", "ai_001_002"
UNIT, MESH = f"{SCENE}/_detail/metadata_scene.csv", f"{SCENE}/_detail/mesh"
PLACES = f"{SCENE}/_detail/cam_00/camera_keyframe_positions.hdf5"
PICTURE = f"{SCENE}/images/scene_cam_00_geometry_hdf5/frame.0001"
BOXES = f"{MESH}/metadata_semantic_instance_bounding_box_object_aligned_2d_extents.hdf5"
CENTERS = BOXES.replace("extents", "positions")
PLY, NERF = "0a5c01/scans/mesh_aligned_0.05.ply", "0a5c01/dslr/nerfstudio/transforms.json"
GROUPS, IPHONE = "0a5c01/scans/segments_anno.json", "0a5c01/iphone/pose_intrinsic_imu.json"


def row(**changes: str) -> Damage:
    """Change the row of the scene in Hypersim's table of cameras."""

    def damage(folder: Path) -> None:
        (found,) = csv.DictReader((folder / CAMERAS).open())
        with (folder / CAMERAS).open("w", newline="") as file:
            writer = csv.DictWriter(file, list(found))
            writer.writeheader()
            writer.writerow(found | changes)

    return damage


def parts(content: bytes) -> Damage:
    return hdf5(HOUSE, instance_attribute_maps=np.bytes_(content))


OTHERS |= {
    "blenderproc": {
        "no camera matrix": gone("cam_K.npy"),
        "truncated camera matrix": text("cam_K.npy", b"\x93NUMPY"),
        "other camera matrix": array("cam_K.npy", np.eye(4)),
        "no table of classes": gone("model_info.json"),
        "foreign table of classes": lambda folder: (
            (folder / "model_info.json").unlink(),
            (folder / "blender_label_mapping.csv").write_text("id;name\n1;bed\n"),
        ),
        "picture alone": hdf5(HOUSE, instance_segmaps=None),
        "three channels": hdf5(HOUSE, instance_segmaps=np.zeros((4, 4, 3), int)),
        "no attributes": parts(b"[{}]"),
        "attributes cut": parts(b"["),
        "no marks": parts(b'[{"idx": 1, "room_id": 0}]'),
        "half a pose": hdf5(HOUSE, cam_Ts=np.eye(3)),
        "no pose": hdf5(HOUSE, cam_Ts=None),
        "empty array": hdf5(HOUSE, instance_segmaps=h5py.Empty("u1")),
        "truncated frame": cut(HOUSE, 900),
        "two sizes": hdf5("house/3.hdf5", instance_segmaps=np.zeros((50, 60), np.uint8)),
    },
    "hypersim": {
        "no table of cameras": gone(CAMERAS),
        "foreign table": text(CAMERAS, "a,b\n1,2\n"),
        "binary table": text(CAMERAS, b"\xff\xfe\x00"),
        "no row": row(scene_name="ai_9"),
        "no size": row(settings_output_img_width="wide"),
        "no projection": row(M_cam_from_uv_22="1"),
        "no unit": text(UNIT, "a,b\n"),
        "negative unit": text(UNIT, "parameter_name,parameter_value\nmeters_per_asset_unit,-1\n"),
        "truncated trajectory": cut(PLACES, 900),
        "poses of other frames": hdf5(PLACES, dataset=np.zeros((3, 3))),
        "cameras below the floor": hdf5(PLACES, dataset=np.full((2, 3), -100.0)),
        "depths": hdf5(f"{PICTURE}.semantic_instance.hdf5", dataset=np.zeros(SIZE)),
        "other name": hdf5(f"{PICTURE}.semantic.hdf5", only=None, data=np.eye(2)),
        "no boxes": gone(BOXES),
        "boxes of another scene": hdf5(BOXES, dataset=np.zeros((2, 3))),
        "boxes unknown": hdf5(CENTERS, dataset=np.full((301, 3), np.nan)),
        "no images": lambda folder: shutil.rmtree(folder / SCENE / "images"),
        "no trajectories": lambda folder: [
            shutil.rmtree(path) for path in sorted((folder / SCENE / "_detail").glob("cam*"))
        ],
    },
    "structured3d": {
        "truncated pose": text(f"{VIEW}/camera_pose.txt", "1 2 3"),
        "angles in degrees": text(f"{VIEW}/camera_pose.txt", "0 0 1000 1 0 0 0 0 1 40 30 1"),
        "tiny angle": text(f"{VIEW}/camera_pose.txt", "0 0 1000 1 0 0 0 0 1 0.01 0.01 1"),
        "other size": image(f"{VIEW}/semantic.png", np.zeros((10, 20))),
        "colours": image(f"{VIEW}/semantic.png", np.zeros((96, 128, 3))),
        "truncated boxes": text("scene_00007/bbox_3d.json", "[{"),
        "foreign boxes": text("scene_00007/bbox_3d.json", '[{"id": 1}]'),
        "no structure": gone("scene_00007/annotation_3d.json"),
        "lines of another scene": keys("scene_00007/annotation_3d.json", planeLineMatrix=[[1]]),
        "semantic ids": image(f"{VIEW}/semantic.png", np.full(SIZE, 41)),
    },
    "scannetpp": {
        "poses of another scene": edit(NERF, lambda data: [
            item["transform_matrix"][0].__setitem__(3, 50.0) for item in data["frames"]
        ]),
        "no poses": gone(NERF),
        "no size": keys(NERF, w=None),
        "no frames": keys(NERF, frames=[]),
        "truncated mesh": cut(PLY, 200),
        "segments of another scene": keys("0a5c01/scans/segments.json", segIndices=[1, 2]),
        "no annotation": gone(GROUPS),
        "foreign annotation": text(GROUPS, "{}"),
    },
    "scannetpp, colmap": {"no images": text("0a5c01/dslr/colmap/images.txt", "# nothing\n")},
    "scannetpp, iphone": {
        "rows": edit(IPHONE, lambda data: data["frame_000000"].update(aligned_pose=[[1.0]] * 4)),
        "no pose": keys(IPHONE, frame_000000={"pose": []}),
    },
}  # fmt: skip

SCAN = "scans/scene0000_00/scene0000_00"
FILT, RAW = f"{SCAN}_2d-instance-filt.zip", f"{SCAN}_2d-instance.zip"
ALIGNED = "axisAlignment = {}\n"


def groups(**changes: Any) -> Damage:
    return edit(f"{SCAN}.aggregation.json", lambda data: data["segGroups"][0].update(changes))


def masks(**members: bytes) -> Damage:
    return lambda folder: write_zip(
        folder / FILT, {name.replace("__", "/") + ".png": data for name, data in members.items()}
    )


def palette() -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(GREY).convert("P").save(buffer, "PNG")
    return buffer.getvalue()


def encrypted(folder: Path) -> None:
    """Set the flag of encryption, in the header of the first member and in the table."""
    data = bytearray((folder / FILT).read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    (folder / FILT).write_bytes(data)


GREY = np.zeros((242, 324), dtype=np.uint8)
NOISE = np.random.default_rng(0).integers(0, 256, GREY.shape).astype(np.uint8)
OTHERS["scannet"] = {
    **{f"no {end}": gone(f"{SCAN}{end}") for end in (
        ".sens", ".txt", ".aggregation.json", "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.ply",
        "_2d-instance-filt.zip",
    )},
    "raw masks": lambda folder: (folder / FILT).rename(folder / RAW),
    "binary properties": text(f"{SCAN}.txt", b"\xff\xfe"),
    "short alignment": text(f"{SCAN}.txt", ALIGNED.format("1 0 0")),
    "lost alignment": text(f"{SCAN}.txt", ALIGNED.format("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 nan")),
    "transposed alignment": text(f"{SCAN}.txt", ALIGNED.format("1 0 0 0 0 1 0 0 0 0 1 0 1 0 0 1")),
    "segments": text(f"{SCAN}_vh_clean_2.0.010000.segs.json", '{"segIndices": [1, 2, 3]}'),
    "segments of halves": text(f"{SCAN}_vh_clean_2.0.010000.segs.json", '{"segIndices": [1.5]}'),
    "list": text(f"{SCAN}.aggregation.json", "[]"),
    "JSON cut": cut(f"{SCAN}.aggregation.json", 90),
    "negative object": groups(objectId=-1),
    "object of truth": groups(objectId=True),
    "object without a label": groups(label=None),
    "segments of words": groups(segments=["x"]),
    "mesh of NaN": lambda folder: write_ply(
        folder / f"{SCAN}_vh_clean_2.ply", np.full((8, 3), np.nan), np.array([(0, 1, 2)])
    ),
    "triangles of missing vertices": lambda folder: write_ply(
        folder / f"{SCAN}_vh_clean_2.ply", np.zeros((8, 3)), np.array([(0, 1, 8)])
    ),
    "no usable frame": lambda folder: (folder / f"{SCAN}.sens").write_bytes(
        sens_bytes([np.full((4, 4), np.inf), np.eye(4)], [b""] * 2)
    ) and masks(**{"77": png(GREY)})(folder),
    "other aspect": lambda folder: (folder / f"{SCAN}.sens").write_bytes(
        sens_bytes([np.eye(4)] * 6, [b""] * 6, (500, 500))
    ),
    "zip of labels": masks(a__1=png(GREY.astype(np.uint16))),
    "zip of colours": masks(a__1=png(np.repeat(GREY[..., None], 3, axis=2))),
    "zip of another format": masks(**{"0": b"GIF89a" + bytes(30)}),
    "zip of two sizes": masks(**{"0": png(GREY), "1": png(GREY[1:])}),
    "zip of a huge member": masks(**{"0": bytes((64 << 20) + 1)}),
    "zip with a frame twice": masks(a__1=png(GREY), b__001=png(GREY)),
    "zip without masks": masks(text=b""),
    "zip that leads out": masks(**{"..__0": png(GREY)}),
    "zip with a root": masks(**{"__etc__0": png(GREY)}),
    "zip with a drive": masks(**{"C:\\0": png(GREY)}),
    "zip cut": cut(FILT, 300),
    "zip of a huge picture": masks(**{"0": png(GREY)[:16] + (60000).to_bytes(4, "big") * 2
                                      + png(GREY)[24:]}),
    "zip of a palette": masks(**{"0": palette()}),
    "zip of half a picture": masks(**{"0": png(NOISE)[:4000]}),
    "zip with a password": encrypted,
}  # fmt: skip

CASES = [(name, damage) for name, damages in OTHERS.items() for damage in damages]


@pytest.mark.parametrize(("name", "damage"), CASES)
def test_damaged_files_are_refused_in_one_sentence(tmp_path, name, damage):
    folder = tmp_path / "data"
    folder.mkdir()
    source = FORMATS[name](folder).source
    (task,) = source.survey().rooms
    OTHERS[name][damage](folder)
    with refused(f"readers/{name} | {damage}", tmp=tmp_path):
        source.settings(None)
        source.rooms(task.house)
        source.prepare(task, None)


def test_frames_of_one_name_need_folders_and_ups_need_axes(tmp_path):
    FORMATS["transforms"](tmp_path)

    def told(key: str, **settings: Any) -> None:
        with refused(f"readers/{key}", tmp=tmp_path):
            reader = Posed(tmp_path, **{"classes": SET} | settings)
            reader.settings(None)
            reader.prepare(RoomTask(ROOM, ROOM, "train"), None)

    for key, changes in {
        "up": {"up": "x"}, "side": {"max_side": 0}, "height": {"camera_height_m": 0.0},
        "unit": {"metres_per_unit": float("inf")}, "floor": {"floor_m": float("nan")},
        "tracks": {"tracks": "magic"}, "share": {"test_share": 1.0}, "set": {"classes": "kitti"},
    }.items():  # fmt: skip
        told(f"settings | {key}", **changes)
    told("tools | none of Polycam", poses="polycam")
    told("tools | no masks of SAM 2", masks="sam2")
    (tmp_path / "attic/007").mkdir()
    image("attic/007/0.png", np.zeros(SIZE))(tmp_path)
    told("tools | two formats of masks")
    shutil.rmtree(tmp_path / "attic/007")
    (tmp_path / "attic/metadata").write_text('{"poses": []}')
    told("tools | two formats of poses")
    (tmp_path / "attic/metadata").unlink()
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[0.8, -0.6], [0.6, 0.8]]
    keys(POSES, floor_center_m=[0.0, 0.0])(tmp_path)
    edit(
        POSES,
        lambda data: [
            item.update(transform_matrix=(tilt @ item["transform_matrix"]).tolist())
            for item in data["frames"]
        ],
    )(tmp_path)
    told("no level axis", up="cameras")
    edit(POSES, lambda data: data.update(frames=data["frames"][:1]))(tmp_path)
    told("one view", up="cameras")
    shutil.copy(tmp_path / POSES, tmp_path / "attic/transforms_val.json")
    keys("attic/transforms_val.json", floor_m=0.3)(tmp_path)
    edit("attic/transforms_val.json", lambda data: data["frames"][0].update(file_path="b"))(
        tmp_path
    )
    (tmp_path / POSES).rename(tmp_path / "attic/transforms_test.json")
    told("two floors")
    (tmp_path / "attic").rename(tmp_path / "hall")
    told("no room of this name")


def test_options_that_cannot_be(tmp_path):
    (tmp_path / "empty").mkdir()
    calls: dict[str, Callable[[], object]] = {
        "from | unknown": lambda: read_formats(["sam3"]),
        "from | two of a kind": lambda: read_formats(["sam2", "polycam", "coco"]),
        "rooms | no folder": lambda: find_rooms(tmp_path / "nowhere"),
        "rooms | empty": lambda: find_rooms(tmp_path / "empty"),
        "rooms | none of Polycam": lambda: find_rooms(tmp_path / "empty", "polycam"),
        "label set | unknown": lambda: read_label_set("nowhere"),
        "data set | no folder": lambda: open_reader("hypersim", tmp_path / "nowhere"),
        "data set | unknown": lambda: open_reader("kitti", tmp_path),
        "data set | recipe": lambda: open_reader("hypersim", tmp_path, "living"),
        "scans | no folder": lambda: find_scans(tmp_path / "none"),
        "scans | none": lambda: find_scans(tmp_path / "empty"),
        "scannet | masks": lambda: ScanNet(tmp_path, labels=tmp_path, masks="best"),
        "scannet | step": lambda: ScanNet(tmp_path, labels=tmp_path, frame_step=0),
        "zip | no file": open_masks(tmp_path / "a.zip").__enter__,
        "splits | no file": lambda: read_splits(tmp_path / "a.csv"),
        "lists | none": lambda: split_scans(["scene0000_00"], None, None),
        **{f"data set | no {name}": lambda name=name: open_reader(name, tmp_path)
           for name in DATA_SETS},
    }  # fmt: skip
    for key, call in calls.items():
        with refused(f"readers/{key}", tmp=tmp_path):
            call()
    for key, name, content in (
        ("twice", "a.txt", "bed\nbed\n"), ("empty", "a.txt", "# nothing\n"),
        ("cut", "a.json", "{"), ("no list", "a.json", '{"1": "bed"}'),
        ("comma", "a.json", '["bed, large"]'),
    ):  # fmt: skip
        (tmp_path / name).write_text(content)
        with refused(f"readers/label set | {key}", tmp=tmp_path):
            read_label_set(str(tmp_path / name))


def test_lists_and_folders_of_scans(tmp_path):
    scans = tmp_path / "scans"
    for name in ("scene0000_00", "scene0001_00", "notes"):
        (scans / name).mkdir(parents=True)
    for folder in (tmp_path, scans / "scene0000_00", scans / "notes"):
        with refused(f"readers/scans | none in {folder.name[:5]}", tmp=tmp_path):
            find_scans(folder)
    train, val = tmp_path / "train.txt", tmp_path / "val.txt"
    for key, first, second in (
        ("both", "scene0000_00", "scene0000_00"), ("no scan", "scene0700_00", ""),
        ("commas", "\nscene0000_00,train", ""), ("binary", b"\xff".decode("latin1"), ""),
    ):  # fmt: skip
        train.write_text(first, encoding="latin1")
        val.write_text(second)
        with refused(f"readers/lists | {key}", tmp=tmp_path):
            split_scans(["scene0000_00", "scene0001_00"], train, val)


SENS: dict[str, bytes] = {
    "version": sens_bytes([np.eye(4)], [b""], version=3),
    "compression": sens_bytes([np.eye(4)], [b""], kind=7),
    "size": sens_bytes([np.eye(4)], [b""], size=(0, 32)),
    "focal length": sens_bytes([np.eye(4)], [b""], K=np.full((4, 4), np.nan)),
    "no frames": sens_header(0),
    "many frames": sens_header(1 << 60),
    "huge picture": sens_header(1) + frame_header(np.eye(4), 0, 0, (1 << 64) - 1),
    "huge name": b"\x04\0\0\0" + b"\xff" * 8 + bytes(100),
    "cut picture": sens_bytes([np.eye(4)] * 3, [b"colour"] * 3)[: len(sens_header(3)) + 107 + 98],
    "cut count": sens_bytes([np.eye(4)] * 3, [b"colour"] * 3)[:-5],
}


@pytest.mark.parametrize("name", SENS)
def test_recordings_that_are_damaged(tmp_path, name):
    path = tmp_path / "a.sens"
    path.write_bytes(SENS[name])
    with refused(f"readers/sens | {name}", tmp=tmp_path):
        read_sens(path)


TABLES = {
    "empty": "",
    "commas": "id,raw_category,nyu40class\n",
    "no rows": "id\traw_category\tnyu40class\n",
    "first release": "category\tcount\tnyuId\tnyu40id\teigen13id\tnyuClass\tnyu40class\nbed\t3\n",
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_label_tables_that_are_foreign(tmp_path, name):
    (tmp_path / "a.tsv").write_text(TABLES[name])
    (tmp_path / "scene0000_00").mkdir()
    with refused(f"readers/labels | {name}", tmp=tmp_path):
        ScanNet(tmp_path, labels=tmp_path / "a.tsv").settings(None)
