"""Writers of small rooms in the formats of public data sets: boxes, cameras, images of ids.

The world of a `PosedRoom` is z up, in metres; each writer converts it to its data set's.
"""

import csv
import json
from pathlib import Path

import h5py
import numpy as np
from PIL import Image
from posed_files import PosedRoom, Thing
from scan_files import BOX_FACES
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

from data_prep.readers.annotations import NYU40
from sceneprior.core.observations import RoomViews

UNIT = 0.0254
"""Metres per asset unit of made Hypersim scenes."""
FLOOR = [(-3.0, -3.2), (3.1, -3.2), (3.1, 3.0), (-3.0, 3.0)]


def furnished(folder: Path) -> PosedRoom:
    """A bed, a chair and a pillow of class void, on a floor, before a wall; five cameras."""
    things = [
        Thing(3, "bed", (-0.9, -0.8, 0.0), (0.5, 0.9, 0.5)),
        Thing(300, "chair", (0.9, 0.4, 0.0), (1.3, 0.8, 0.9)),
        Thing(7, "pillow", (1.0, -0.9, 0.0), (1.3, -0.6, 0.4)),
        Thing(11, "floor", (-3.0, -3.2, -0.1), (3.1, 3.0, 0.0)),
        Thing(12, "wall", (-3.0, 3.0, 0.0), (3.1, 3.1, 2.5)),
    ]
    return PosedRoom(folder, things)


def write_hdf5(path: Path, **arrays: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array)


def category(thing: Thing) -> str:
    return {"bed": "King-size Bed", "chair": "Dining Chair", "pillow": "Mattress"}[thing.name]


def write_blenderproc(folder: Path, house: str, room: PosedRoom, cameras: bool = True) -> None:
    """Frames as BlenderProc's write_hdf5 does; the bed is made of two meshes.

    The last frame shows the same furniture as that of another room, a kitchen.
    """
    height, width = room.size
    folder.mkdir(parents=True, exist_ok=True)
    focal = room.focal_px
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    np.save(folder / "cam_K.npy", K)
    rows = [
        {"model_id": f"model_{thing.name}", "category": category(thing)}
        for thing in room.things[:3]
    ]
    (folder / "model_info.json").write_text(json.dumps(rows))
    for view, pose in enumerate(room.poses):
        ids = room.ids(view)
        image = np.zeros(ids.shape, dtype=np.uint8)
        where = "Kitchen-2" if view == len(room.poses) - 1 else "MasterBedroom-1"
        parts = [{"idx": 0, "inst_mark": "", "room_id": "", "jid": "", "uid": "", "category_id": 0}]
        for k, thing in enumerate(room.things):
            image[ids == thing.id] = k + 1
            common = {"uid": f"{k}/model", "location": [0, 0, 0]}
            if k >= 3:  # floor and wall
                common |= {"inst_mark": f"layout_{k}", "room_id": "", "jid": "", "category_id": 41}
            else:
                common |= {
                    "inst_mark": f"furniture_{k}", "room_id": where, "category_id": k,
                    "jid": f"model_{thing.name}",
                }  # fmt: skip
            parts.append({"idx": k + 1, **common})
        left = (image == 1) & (np.arange(width) < width // 2)
        image[left] = 9
        parts.append({**parts[1], "idx": 9})
        frame = {
            "instance_segmaps": image,
            "class_segmaps": image,
            "instance_attribute_maps": np.bytes_(json.dumps(parts)),
        }
        if cameras:
            frame["cam_Ts"] = pose
        write_hdf5(folder / house / f"{view}.hdf5", **frame)


def cast(room: PosedRoom, pose: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Ids (H, W) of the nearest boxes along rays (H, W, 3) in OpenGL's camera axes."""
    with np.errstate(divide="ignore"):
        inverse = 1 / (rays @ pose[:3, :3].T)
    nearest, ids = np.full(rays.shape[:2], np.inf), np.full(rays.shape[:2], -1)
    for thing in room.things:
        near, far = (inverse * (np.array(side) - pose[:3, 3]) for side in (thing.low, thing.high))
        enters = np.minimum(near, far).max(axis=-1)
        hit = (enters < np.maximum(near, far).min(axis=-1)) & (enters > 0) & (enters < nearest)
        nearest[hit], ids[hit] = enters[hit], thing.id
    return ids


def cam_from_uv(room: PosedRoom, lens_shift: float = 0.0, horizontal: float = 0.0) -> np.ndarray:
    """Projection of Hypersim (3, 3); a `lens_shift` tilts the image plane about the x axis."""
    height, width = room.size
    across, up = width / 2 / room.focal_px, height / 2 / room.focal_px
    return np.array(
        [[across, 0, 0.1], [0, up, -0.05], [-horizontal * across, -lens_shift * up, -1]]
    )


def write_hypersim(folder: Path, scene: str, room: PosedRoom, projection: np.ndarray) -> None:
    """A scene with two trajectories; the image of the second one's last frame was not released."""
    height, width = room.size
    root = folder / scene
    detail, pictures = root / "_detail", root / "images"
    table = folder / "metadata_camera_parameters.csv"
    row = {
        "scene_name": scene, "settings_output_img_height": float(height),
        "settings_output_img_width": float(width),
        **{f"M_cam_from_uv_{i}{j}": projection[i, j] for i in range(3) for j in range(3)},
    }  # fmt: skip
    rows = list(csv.DictReader(table.open())) if table.is_file() else []
    folder.mkdir(parents=True, exist_ok=True)
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        writer.writeheader()
        writer.writerows([*rows, row])
    u = (np.arange(width) + 0.5) / width * 2 - 1
    v = 1 - (np.arange(height) + 0.5) / height * 2
    uv = np.stack([*np.meshgrid(u, v), np.ones((height, width))], axis=-1)
    half = len(room.poses) // 2
    for name, poses in (("cam_00", room.poses[:half]), ("cam_01", room.poses[half:])):
        poses = np.stack(poses)
        write_hdf5(detail / name / "camera_keyframe_positions.hdf5", dataset=poses[:, :3, 3] / UNIT)
        write_hdf5(detail / name / "camera_keyframe_orientations.hdf5", dataset=poses[:, :3, :3])
        for k, pose in enumerate(poses):
            if name == "cam_01" and k == len(poses) - 1:
                continue
            ids = cast(room, pose, uv @ projection.T).astype(np.int16)
            kinds = np.full(ids.shape, -1, dtype=np.int16)
            for thing in room.things:
                kinds[ids == thing.id] = NYU40.index(thing.name) + 1
            ids[ids == 12] = -1  # the wall has a class, but no instance
            start = pictures / f"scene_{name}_geometry_hdf5" / f"frame.{k:04d}"
            write_hdf5(Path(f"{start}.semantic_instance.hdf5"), dataset=ids)
            write_hdf5(Path(f"{start}.semantic.hdf5"), dataset=kinds)
    (detail / "metadata_scene.csv").write_text(
        f"parameter_name,parameter_value\nmeters_per_asset_unit,{UNIT}\n"
    )
    count = max(thing.id for thing in room.things) + 1
    boxes = {"positions": (count, 3), "extents": (count, 3), "orientations": (count, 3, 3)}
    arrays = {name: np.full(shape, np.inf) for name, shape in boxes.items()}
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # the box's axes are the world's y, z, x
    for thing in room.things:
        low, high = np.array(thing.low), np.array(thing.high)
        arrays["positions"][thing.id] = (low + high) / 2 / UNIT
        arrays["extents"][thing.id] = (high - low)[[1, 2, 0]] / UNIT
        arrays["orientations"][thing.id] = turn
    start = "metadata_semantic_instance_bounding_box_object_aligned_2d_"
    for name, array in arrays.items():
        write_hdf5(detail / "mesh" / f"{start}{name}.hdf5", dataset=array)


def write_structured3d(folder: Path, scene: str, number: str, room: PosedRoom) -> None:
    height, width = room.size
    root = folder / scene
    views = root / "2D_rendering" / number / "perspective" / "full"
    half_angles = [np.arctan(side / 2 / room.focal_px) for side in (width, height)]
    for k, pose in enumerate(room.poses):
        view = views / str(k)
        view.mkdir(parents=True)
        ids = room.ids(k)
        kinds = np.zeros(ids.shape, dtype=np.uint8)
        for thing in room.things:
            kinds[ids == thing.id] = NYU40.index(thing.name) + 1
        ids = np.where(np.isin(ids, (0, 11, 12)), 65_535, ids).astype(np.uint16)
        Image.fromarray(ids).save(view / "instance.png")
        palette = Image.fromarray(kinds, "P")
        palette.putpalette(np.random.default_rng(0).integers(0, 256, 768).astype(np.uint8).tolist())
        palette.save(view / "semantic.png")
        eye, ahead, up = 1000 * pose[:3, 3], -pose[:3, 2], pose[:3, 1]
        numbers = [*eye, *ahead, *up, *half_angles, 1]
        (view / "camera_pose.txt").write_text(" ".join(f"{x:.9g}" for x in numbers))
    boxes = []
    for thing in room.things[:3]:
        low, high = np.array(thing.low) * 1000, np.array(thing.high) * 1000
        basis = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]
        boxes.append({
            "ID": thing.id, "basis": basis, "coeffs": ((high - low) / 2)[[1, 2, 0]].tolist(),
            "centroid": ((low + high) / 2).tolist(),
        })  # fmt: skip
    boxes.append({**boxes[0], "ID": 40, "coeffs": [0, 0, 0]})
    (root / "bbox_3d.json").write_text(json.dumps(boxes))
    (root / "annotation_3d.json").write_text(json.dumps(structure(number)))


def structure(number: str) -> dict:
    """A room with a floor and a ceiling of four lines each, and a door in a wall."""
    junctions = [(*corner, z) for z in (0.0, 2.6) for corner in FLOOR]
    # The second line is the lower edge of the door, which lies in the floor's plane.
    lines = [[0, 1], [1, 3], [2, 3], [1, 2], [3, 0], [4, 5], [6, 7], [5, 6], [7, 4]]
    planes = [{"type": "floor"}, {"type": "ceiling"}, {"type": "wall"}, {"type": "wall"}]
    line_junction = np.zeros((len(lines), len(junctions)), dtype=int)
    for k, line in enumerate(lines):
        line_junction[k, line] = 1
    plane_line = np.zeros((4, len(lines)), dtype=int)
    plane_line[0, :5] = plane_line[1, 5:] = plane_line[3, 1] = 1
    return {
        "junctions": [
            {"ID": k, "coordinate": [1000 * x for x in point]} for k, point in enumerate(junctions)
        ],
        "lines": [],
        "planes": [{"ID": k, "offset": 0.0, **plane} for k, plane in enumerate(planes)],
        "semantics": [
            {"ID": int(number), "type": "bedroom", "planeID": [0, 1, 2]},
            {"ID": 77, "type": "door", "planeID": [3]},
        ],
        "planeLineMatrix": plane_line.tolist(),
        "lineJunctionMatrix": line_junction.tolist(),
    }  # fmt: skip


FROM_MESH = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""From the mesh's world to nerfstudio's: x and y swapped, z reversed."""


def write_scannetpp(folder: Path, scene: str, room: PosedRoom, poses: str = "nerfstudio") -> None:
    """Poses of the DSLR (nerfstudio, colmap) or of the iPhone (iphone).

    The furniture is also annotated as one large object.
    """
    root = folder / scene
    (root / "scans").mkdir(parents=True)
    vertices = np.concatenate([thing.corners for thing in room.things])
    vertices = np.maximum(vertices, (-np.inf, -np.inf, 0))  # a scanned floor has no thickness
    faces = np.concatenate([BOX_FACES + 8 * k for k in range(len(room.things))])
    Trimesh(vertices, faces, process=False).export(root / "scans" / "mesh_aligned_0.05.ply")
    segments = np.repeat(np.arange(len(room.things)) * 10, 8)
    (root / "scans" / "segments.json").write_text(json.dumps({"segIndices": segments.tolist()}))
    names = {"chair": "office chair", "pillow": "cushion"}
    groups = [
        {
            "id": k,
            "objectId": k + 1,
            "label": names.get(thing.name, thing.name),
            "segments": [10 * k],
        }
        for k, thing in enumerate(room.things)
    ]
    groups.insert(0, {"id": 9, "objectId": 9, "label": "furniture", "segments": [0, 10, 20]})
    (root / "scans" / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))
    height, width = room.size
    if poses == "colmap":
        write_colmap_text(root / "dslr" / "colmap", room)
        return
    if poses == "iphone":
        K = [[room.focal_px, 0, width / 2], [0, room.focal_px, height / 2], [0, 0, 1]]
        K = (np.diag([1920 / width, 1440 / height, 1]) @ K).tolist()
        aligned = [pose @ np.diag([1.0, -1, -1, 1]) for pose in room.poses]
        frames = {
            f"frame_{k:06d}": {"timestamp": k / 60, "aligned_pose": pose.tolist(), "intrinsic": K,
                               "pose": np.eye(4).tolist(), "imu": []}
            for k, pose in enumerate(aligned)
        }  # fmt: skip
        (root / "iphone").mkdir()
        (root / "iphone" / "pose_intrinsic_imu.json").write_text(json.dumps(frames))
        return
    data = {
        "fl_x": room.focal_px, "fl_y": room.focal_px, "cx": width / 2, "cy": height / 2,
        "w": width, "h": height, "k1": 0.04, "k2": -0.01, "k3": 0.001, "k4": -0.0002,
        "camera_model": "OPENCV_FISHEYE", "test_frames": [],
        "frames": [
            {"file_path": f"DSC{k:05d}.JPG", "is_bad": False,
             "transform_matrix": (FROM_MESH @ pose).tolist()}
            for k, pose in enumerate(room.poses)
        ],
    }  # fmt: skip
    path = root / "dslr" / "nerfstudio" / "transforms.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(data))


def write_colmap_text(folder: Path, room: PosedRoom) -> None:
    """A COLMAP model of a fisheye camera as text, whose world is the mesh's."""
    folder.mkdir(parents=True)
    (height, width), f = room.size, room.focal_px
    lens = f"{f} {f} {width / 2} {height / 2} 0.04 -0.01 0.001 -0.0002"
    (folder / "cameras.txt").write_text(f"# made\n1 OPENCV_FISHEYE {width} {height} {lens}\n")
    lines = ["# made"]
    for k, pose in enumerate(room.poses):
        inverse = np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        numbers = " ".join(f"{value:.12g}" for value in (w, x, y, z, *inverse[:3, 3]))
        lines += [f"{k + 1} {numbers} 1 DSC{k:05d}.JPG", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def classes_of(views: RoomViews, names: tuple[str, ...]) -> list[str]:
    return [names[k] for k in views.object_class]
