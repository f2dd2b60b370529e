"""Writers of the files that other tools write, of the rooms of `posed_files`."""

import json
from typing import Any

import numpy as np
from PIL import Image
from posed_files import PosedRoom, Thing
from pycocotools import mask as coco
from scipy.spatial.transform import Rotation

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From z up to ARKit's y up; keeps x."""
FLOOR = {"floor_m": 0.0, "floor_center_m": [0.1, 0.2]}
"""The room's keys with y up: what (0.1, -0.2) is with z up."""


def write_plain(room: PosedRoom) -> None:
    """The room as transforms.json and PNGs of ids."""
    room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])


def write_room_keys(room: PosedRoom) -> None:
    """A transforms.json that has keys about the room only."""
    room.write_transforms(FLOOR)


# -- Poses -----------------------------------------------------------------------------------------


def write_polycam(room: PosedRoom, folder: str = "corrected_cameras") -> None:
    """Raw data as the README of PolyCam/polyform has it; pictures are named by microseconds."""
    height, width = room.size
    place = room.folder / "keyframes" / folder
    place.mkdir(parents=True)
    for view, pose in enumerate(room.poses):
        rows = (Y_UP @ pose)[:3]
        data: dict[str, Any] = {f"t_{i}{j}": rows[i, j] for i in range(3) for j in range(4)}
        data |= {"fx": room.focal_px, "fy": room.focal_px, "cx": width / 2, "cy": height / 2}
        data |= {"width": width, "height": height, "blur_score": 112.5, "manual_keyframe": False}
        (place / f"{timestamp(view)}.json").write_text(json.dumps(data))
    room.rename(timestamp)
    write_room_keys(room)


def timestamp(view: int) -> str:
    return str(51_234_567_890 + 33_333 * view)


def write_record3d(room: PosedRoom, name: str = "metadata", per_frame: bool = False) -> None:
    """The JSON of a recording with the LiDAR camera; the world's y is up, as for a level start."""
    height, width = room.size
    poses = []
    for pose in room.poses:
        pose = Y_UP @ pose
        poses.append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
    f, x, y = room.focal_px, width / 2, height / 2
    data: dict[str, Any] = {
        "w": width, "h": height, "dw": 192, "dh": 256, "fps": 60, "cameraType": 1,
        "K": [f, 0, 0, 0, f, 0, x, y, 1], "initPose": [0, 0, 0, 1, 0, 0, 0],
        "poses": [[float(value) for value in pose] for pose in poses],
        "frameTimestamps": [view / 60 for view in range(len(poses))],
    }  # fmt: skip
    if per_frame:
        data["perFrameIntrinsicCoeffs"] = [[f, f, x + view, y] for view in range(len(poses))]
    path = room.folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(data))
    room.rename(str)
    write_room_keys(room)


# -- Masks -----------------------------------------------------------------------------------------


def remove_pngs(room: PosedRoom, table: bool = True) -> None:
    for path in (room.folder / "instances").iterdir():
        path.unlink()
    (room.folder / "instances").rmdir()
    if table:
        (room.folder / "classes.json").unlink()


def write_sam2(room: PosedRoom, place: str = ".", hidden: bool = True) -> None:
    """A folder per object with a palette PNG of 0 and 1 for each frame; `hidden`: of all frames."""
    remove_pngs(room, table=False)
    for thing in room.things:
        folder = room.folder / place / f"{thing.id:03d}"
        folder.mkdir(parents=True)
        for view in range(len(room.poses)):
            mask = (room.ids(view) == thing.id).astype(np.uint8)
            if hidden or mask.any():
                picture = Image.fromarray(mask)
                picture.putpalette([0, 0, 0, 128, 0, 0])
                picture.save(folder / f"{room.stem(view)}.png")


def write_grounded_sam2(room: PosedRoom) -> None:
    """The ids of a frame, and a JSON of their classes and boxes."""
    remove_pngs(room)
    for name in ("mask_data", "json_data", "result"):
        (room.folder / name).mkdir()
    height, width = room.size
    for view in range(len(room.poses)):
        ids = room.ids(view)
        np.save(room.folder / f"mask_data/mask_{room.stem(view)}.npy", ids.astype(np.uint16))
        labels = {
            str(thing.id): {
                "instance_id": thing.id, "class_name": thing.name, "x1": 1, "y1": 2, "x2": 3,
                "y2": 4, "logit": 0.0,
            }
            for thing in room.things
            if (ids == thing.id).any()
        }  # fmt: skip
        data = {
            "mask_name": f"mask_{room.stem(view)}.npy", "mask_height": height, "mask_width": width,
            "promote_type": "mask", "labels": labels,
        }  # fmt: skip
        (room.folder / f"json_data/mask_{room.stem(view)}.json").write_text(json.dumps(data))


def packed(mask: np.ndarray) -> dict[str, Any]:
    """Compressed run lengths."""
    made = coco.encode(np.asfortranarray(mask.astype(np.uint8)))
    return {"size": list(mask.shape), "counts": made["counts"].decode()}


def outlines(mask: np.ndarray) -> list[list[float]]:
    """Polygons: a rectangle around each run of pixels of a row."""
    found = []
    for y, row in enumerate(mask):
        ends = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        for x1, x2 in ends.reshape(-1, 2).tolist():
            found.append([x1, y, x2, y, x2, y + 1, x1, y + 1])
    return [[float(value) for value in polygon] for polygon in found]


def write_grounded_sam2_images(room: PosedRoom) -> None:
    """The JSON of a demo of single images, for each frame."""
    remove_pngs(room)
    (room.folder / "json_data").mkdir()
    height, width = room.size
    for view in range(len(room.poses)):
        ids = room.ids(view)
        rows = [
            {
                "class_name": thing.name, "bbox": [1.0, 2.0, 3.0, 4.0], "score": [0.9],
                "segmentation": packed(ids == thing.id),
            }
            for thing in room.things
            if (ids == thing.id).any()
        ]  # fmt: skip
        data = {
            "image_path": f"images/{room.stem(view)}.jpg", "annotations": rows,
            "box_format": "xyxy", "img_width": width, "img_height": height,
        }  # fmt: skip
        (room.folder / f"json_data/results_{view}.json").write_text(json.dumps(data))


def categories(room: PosedRoom) -> dict[str, int]:
    names = dict.fromkeys(thing.name for thing in room.things)
    return {name: 10 + k for k, name in enumerate(names)}


def write_coco_json(room: PosedRoom, name: str, data: dict[str, Any]) -> None:
    data["categories"] = [{"id": k, "name": name} for name, k in categories(room).items()]
    path = room.folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"info": {}, "licenses": [], **data}))


def write_coco_images(
    room: PosedRoom, track: str = "", name: str = "coco.json", polygons: bool = False
) -> None:
    """Annotations of images; `track` is `track_id`, `instance_id`, `attributes` or none."""
    remove_pngs(room)
    height, width = room.size
    images, rows = [], []
    for view in range(len(room.poses)):
        picture = f"{room.stem(view)}.jpg"
        images.append({"id": 7 + view, "file_name": picture, "height": height, "width": width})
        ids = room.ids(view)
        for thing in room.things:
            mask = ids == thing.id
            if not mask.any():
                continue
            row = {
                "id": len(rows) + 1, "image_id": 7 + view, "iscrowd": 0,
                "category_id": categories(room)[thing.name],
                "segmentation": outlines(mask) if polygons else packed(mask),
            }  # fmt: skip
            if track == "attributes":
                row["attributes"] = {"occluded": False, "track_id": thing.id}
            elif track:
                row[track] = thing.id
            rows.append(row)
    write_coco_json(room, name, {"images": images, "annotations": rows})


def write_coco_video(room: PosedRoom) -> None:
    """One annotation per object, with a mask or null for each frame, as in YouTube-VIS."""
    remove_pngs(room)
    height, width = room.size
    names = [f"attic/{room.stem(view)}.jpg" for view in range(len(room.poses))]
    video = {"id": 3, "width": width, "height": height, "length": len(names), "file_names": names}
    ids = [room.ids(view) for view in range(len(names))]

    def masks(number: int) -> list[dict[str, Any] | None]:
        return [packed(i == number) if (i == number).any() else None for i in ids]

    rows = [
        {
            "id": k, "video_id": 3, "category_id": categories(room)[thing.name], "iscrowd": 0,
            "segmentations": masks(thing.id),
        }
        for k, thing in enumerate(room.things)
    ]  # fmt: skip
    write_coco_json(room, "instances.json", {"videos": [video], "annotations": rows})


SEGMENTS = {3: 70_001, 300: 5, 7: 1_000_000, 11: 256}
"""Ids of COCO's kind for those of the things and of a wall."""


def write_panoptic(room, change=lambda data: None):
    wall = Thing(11, "wall-brick", (-3.0, 3.0, 0.0), (3.0, 3.1, 2.5))
    room.things.append(wall)
    room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])
    (room.folder / "classes.json").unlink()
    names = {"bed": 65, "Chair": 62, "backpack": 27, "wall-brick": 171}
    annotations = []
    for view in range(len(room.poses)):
        ids = room.ids(view).astype(int)
        for mine, theirs in SEGMENTS.items():
            ids[ids == mine] = theirs
        colours = np.stack([ids % 256, ids // 256 % 256, ids // 65536], axis=-1)
        Image.fromarray(colours.astype(np.uint8)).save(room.png(view))
        segments = [
            {"id": SEGMENTS[thing.id], "category_id": names[thing.name], "area": 3, "iscrowd": 0}
            for thing in room.things
            if (ids == SEGMENTS[thing.id]).any()
        ]
        annotations.append({"file_name": room.png(view).name, "segments_info": segments})
    data = {
        "images": [],
        "annotations": annotations,
        "categories": [
            {"id": number, "name": name, "isthing": int(name != "wall-brick")}
            for name, number in names.items()
        ],
    }
    change(data)
    (room.folder / "panoptic.json").write_text(json.dumps(data))


# -- Comparisons -----------------------------------------------------------------------------------


def same_masks(made, plain):
    """Compare everything that is measured in images; the order of objects is that of their ids."""
    order = [made.object_class.tolist().index(label) for label in plain.object_class]
    ids = np.zeros(made.instance_ids.max() + 1, dtype=plain.instance_ids.dtype)
    for new, old in enumerate(order):
        ids[old + 1] = new + 1
    ids[-1] = plain.instance_ids.max()  # the backpack, which is void
    np.testing.assert_array_equal(ids[made.instance_ids], plain.instance_ids)
    for name in ("boxes", "visible", "mask_pixels", "sides_clear"):
        np.testing.assert_array_equal(getattr(made, name)[:, order], getattr(plain, name))


def same_objects(made, plain):
    """Map from the objects found to those of given ids, checked to be one to one."""
    pairs = set(zip(made.instance_ids.ravel(), plain.instance_ids.ravel(), strict=True))
    assert len(pairs) == len(np.unique(plain.instance_ids))
    for a, b in pairs:
        if 0 < b <= len(plain.object_class):
            assert made.object_class[a - 1] == plain.object_class[b - 1]
