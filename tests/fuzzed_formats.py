"""Every format that the package reads: how a good file is made in a folder, and how it is read.

An entry returns the file that is damaged, a function that reads it, and, if the damage is not the
one of its type (`mutating.damaged`), a function that damages it.
"""

import contextlib
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

Entry = tuple[Path, Callable[[], object]] | tuple[Path, Callable[[], object], Callable]
FORMATS: dict[str, Callable[[Path], Entry]] = {}
LABEL_SET = "front3d_bedroom"
CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 2)]
FACES = [(1, 2, 4), (1, 4, 3), (5, 8, 6), (5, 7, 8), (1, 3, 7), (2, 6, 8)]


def entry(name: str) -> Callable:
    def add(make: Callable[[Path], Entry]) -> Callable[[Path], Entry]:
        FORMATS[name] = make
        return make

    return add


# -- Scenes, models and floors ---------------------------------------------------------------------


def example() -> Any:
    from sceneprior.core.scene import Scene, SceneObject, Turned
    from sceneprior.render.appearance import box_mesh

    bed = SceneObject("double_bed", (0.0, 0.3, -0.5), (1.8, 0.6, 2.0))
    turned = Turned(np.pi / 2, (1.2, 0.8, 0.6))
    desk = SceneObject("desk", (1.5, 0.4, 1.0), (0.6, 0.8, 1.2), turned=turned)
    floor = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
    meshed = tuple(
        SceneObject(o.label, o.center_m, o.size_m, box_mesh(o.center_m, o.size_m), o.turned)
        for o in (bed, desk)
    )
    return Scene("mine", LABEL_SET, meshed, floor, {"seed": 1})


def use_scenes(scenes: list, folder: Path) -> None:
    """Draw and write what could be read, in each format."""
    from sceneprior.interchange.export import export_scenes
    from sceneprior.render.scene_files import load_scene, save
    from sceneprior.render.topdown import TopDownProtocol, perspective, topdown

    shutil.rmtree(folder / "again", ignore_errors=True)
    for scene in scenes:
        topdown(scene, TopDownProtocol((32, 32)))
        perspective(scene, (24, 32))
        for ending in (".json", ".glb", ".obj"):
            save(scene, folder / "again" / f"again{ending}")
        load_scene(folder / "again" / "again.json")
    for to in ("atiss", "threed-front"):
        export_scenes(scenes, to, folder / "again" / to)


def scene_file(ending: str, folder: Path) -> Entry:
    from sceneprior.render.scene_files import load_scene_folder, save

    for each in (".json", ending):
        save(example(), folder / "given" / f"room{each}")
    path = folder / "given" / f"room{ending}"
    return path, lambda: use_scenes(load_scene_folder(path.parent), folder)


FORMATS["scene JSON"] = partial(scene_file, ".json")
FORMATS["scene GLB"] = partial(scene_file, ".glb")


def boxes(folder: Path, ending: str) -> Path:
    from sceneprior.interchange.export import export_scenes

    export_scenes([example()], "atiss", folder / "given")
    path = folder / "given" / "mine" / "boxes.npz"
    if ending == ".json":
        with np.load(path) as file:
            plain = {key: array.tolist() for key, array in file.items()}
        path.with_suffix(".json").write_text(json.dumps(plain))
        path.unlink()
    return path.with_suffix(ending)


def box_list(ending: str, folder: Path) -> Entry:
    from sceneprior.interchange.box_lists import read_box_lists

    path = boxes(folder, ending)
    return path, lambda: use_scenes(read_box_lists(folder / "given", LABEL_SET), folder)


FORMATS["box list npz"] = partial(box_list, ".npz")
FORMATS["box list JSON"] = partial(box_list, ".json")


@entry("floor npz")
def floor_npz(folder: Path) -> Entry:
    return floor_of(boxes(folder, ".npz"))


@entry("floor JSON")
def floor_json(folder: Path) -> Entry:
    path = folder / "floor.json"
    path.write_text(json.dumps([[0, 0], [4, 0], [4, 3], [0, 3.5]]))
    return floor_of(path)


@entry("floor of a scene")
def floor_scene(folder: Path) -> Entry:
    return floor_of(scene_file(".json", folder)[0])


def floor_of(path: Path) -> Entry:
    from sceneprior.interchange.floors import read_floor_file

    return path, lambda: read_floor_file(str(path))


OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(
    f"f {a}/1 {b}/2 {c}\n" for a, b, c in FACES
)
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\n"
    "property float z\nelement face 6\nproperty list uchar int vertex_indices\nend_header\n"
    + "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
    + "".join(f"3 {a - 1} {b - 1} {c - 1}\n" for a, b, c in FACES)
)


@entry("model PLY")
def model_ply(folder: Path) -> Entry:
    from sceneprior.core.ground_truth import load_model

    path = folder / "a.ply"
    path.write_text(PLY)
    return path, lambda: load_model(path)


def model_folder(file: str, folder: Path) -> Entry:
    from sceneprior.apps.retrieval.cad_models import open_models

    given, cache = folder / "given", folder / "cache"
    (given / "a").mkdir(parents=True)
    record = [{"model_id": "a", "category": "Wardrobe"}]
    (given / "model_info.json").write_text(json.dumps(record))
    (given / "a" / "raw_model.obj").write_text(OBJ)
    open_models(given, LABEL_SET, cache)
    (path,) = folder.rglob(file)

    def read() -> None:
        if file != "points-*.npz":
            shutil.rmtree(cache, ignore_errors=True)
        open_models(given, LABEL_SET, cache)

    return path, read


FORMATS["model OBJ"] = partial(model_folder, "raw_model.obj")
FORMATS["model_info.json"] = partial(model_folder, "model_info.json")
FORMATS["CAD cache"] = partial(model_folder, "points-*.npz")


@entry("model GLB")
def model_glb(folder: Path) -> Entry:
    from sceneprior.apps.retrieval.cad_models import open_models

    path = folder / "given" / "wardrobe" / "a.glb"
    path.parent.mkdir(parents=True)
    shutil.copy(scene_file(".glb", folder / "scene")[0], path)
    return path, lambda: open_models(folder / "given", LABEL_SET, folder / "cache")


# -- Captures and data sets ------------------------------------------------------------------------

SCAN = "scans/scene0000_00/scene0000_00"
SCENE, VIEWS = "ai_001_002", "scene_00007/2D_rendering/480/perspective/full"
CAPTURES = {
    "transforms": ["transforms.json", "classes.json", "instances/frame_00001.png"],
    "opencv": ["transforms.json"],
    "colmap": ["sparse/0/images.bin", "sparse/0/cameras.bin"],
    "colmap, text": ["sparse/0/images.txt", "sparse/0/cameras.txt"],
    "polycam": ["keyframes/corrected_cameras/*1.json"],
    "record3d": ["metadata"],
    "sam2": ["003/frame_00001.png"],
    "grounded-sam2": ["json_data/mask_frame_00001.json", "mask_data/mask_frame_00001.npy"],
    "grounded-sam2, images": ["json_data/results_1.json"],
    "coco": ["coco.json"],
    "coco, tracks": ["coco.json"],
    "coco, video": ["instances.json"],
    "panoptic": ["panoptic.json"],
    "scannet": [f"{SCAN}{ending}" for ending in (
        ".sens", ".txt", ".aggregation.json", "_vh_clean_2.0.010000.segs.json",
        "_2d-instance-filt.zip", "_vh_clean_2.ply",
    )],
    "blenderproc": ["model_info.json", "house/1.hdf5", "cam_K.npy"],
    "hypersim": ["metadata_camera_parameters.csv", f"{SCENE}/_detail/metadata_scene.csv",
                 f"{SCENE}/_detail/cam_00/camera_keyframe_positions.hdf5"],
    "structured3d": ["scene_00007/annotation_3d.json", "scene_00007/bbox_3d.json",
                     f"{VIEWS}/0/camera_pose.txt", f"{VIEWS}/1/semantic.png"],
    "scannetpp": ["0a5c01/dslr/nerfstudio/transforms.json", "0a5c01/scans/segments_anno.json"],
    "scannetpp, iphone": ["0a5c01/iphone/pose_intrinsic_imu.json"],
}  # fmt: skip
"""Files of each format that are damaged; those of posed rooms are in `attic`."""


def capture(name: str, file: str, folder: Path) -> Entry:
    from toy_formats import FORMATS as SOURCES

    from data_prep.readers.posed.reader import Posed

    source = SOURCES[name](folder).source
    posed = isinstance(source, Posed)
    path = sorted((folder / ("attic" if posed else "")).glob(file))[0]
    (task,) = source.survey().rooms

    def read() -> None:
        if posed:
            source.found()
            source.assumptions()
        source.settings(None)
        source.rooms(task.house)
        source.prepare(task, None)

    return path, read


for _name, _files in CAPTURES.items():
    FORMATS |= {f"{_name}: {each}": partial(capture, _name, each) for each in _files}


@entry("3D-FRONT house")
def front_house(folder: Path) -> Entry:
    from front_files import FrontFolder, bedroom

    from data_prep.front.furnished import ModelBank
    from data_prep.front.houses import read_house
    from data_prep.front.recipe import broken_rule, load_recipe

    front = FrontFolder(folder)
    for jid, category in (("bed", "King-size Bed"), ("stand", "Nightstand"), ("lamp", None)):
        front.model(jid, category, (0.5, 0.6, 0.4))
    path = Path(front.house("house", bedroom("A"), bedroom("B", bounds=(3.0, -2.0, 7.0, 2.0))))
    data = json.loads(path.read_text())
    data["furniture"][0] |= {"bbox": [1.8, 1.0, 2.0], "category": "King-size Bed"}
    data["furniture"][1] |= {"jid": "gone", "category": "Nightstand"}
    path.write_text(json.dumps(data))
    bank = ModelBank(front.future)
    recipes = load_recipe("bedroom"), load_recipe("atiss_bedroom")

    def read() -> None:
        found = read_house(path, bank, recipes[0])
        reasons = [line.reason for line in found.left_out]
        for one in found.rooms:
            reasons += [broken[1] for each in recipes if (broken := broken_rule(one, each))]
        assert all(why.isprintable() and len(why) < 500 for why in reasons), reasons

    return path, read


@entry("plan.json")
def plan(folder: Path) -> Entry:
    from toy_formats import FORMATS as SOURCES

    from data_prep.engine.build import Job, build_shards
    from data_prep.engine.plan import job_settings, read_plan

    source = SOURCES["coco"](folder).source
    build_shards(Job(source, folder / "out"))
    settings = job_settings(source, None)
    return folder / "out" / "plan.json", lambda: read_plan(folder / "out", source, settings, "auto")


def text_file(name: str, text: str, read: Callable[[Path], object], folder: Path) -> Entry:
    path = folder / name
    path.write_text(text)
    return path, lambda: read(path)


def _labels(path: Path) -> object:
    from data_prep.readers.annotations import read_labels

    return read_labels(path)


def _splits(path: Path) -> object:
    from data_prep.engine.plan import read_splits

    return read_splits(path)


def _label_set(path: Path) -> object:
    from data_prep.readers.posed.formats import read_label_set

    return read_label_set(str(path))


def _classes(path: Path) -> object:
    from sceneprior.core.id_tables import read_class_table

    return read_class_table(path)


def _recipe(path: Path) -> object:
    from data_prep.front.recipe import load_recipe

    return load_recipe(str(path))


def _request(path: Path) -> object:
    from sceneprior.apps.sample import load_request, request_of

    return request_of(load_request(path))


def _intrinsics(path: Path) -> object:
    from sceneprior.apps.reconstruction.own_image import read_intrinsics

    return read_intrinsics(str(path), (48, 64))


def _pose(path: Path) -> object:
    from sceneprior.apps.reconstruction.own_image import read_pose

    return read_pose(path)


_RAW = (
    'id\traw_category\tcategory\tnyu40id\tnyu40class\n1\tbed\tbed\t4\tbed\n2\t5"x\tbox\t29\tbox\n'
)
_CAMERA = [[1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, -1, 2], [0, 0, 0, 1]]
_REQUEST = {
    "format": "sceneprior-request", "version": 1, "floor": "4x3", "openings": ["door@south"],
    "ceiling_m": 2.6,
    "objects": [{"class": "double_bed", "center_m": [0, 0.3, -0.4], "size_m": [1.8, 0.6, 2]}],
    "want": {
        "nightstand": 1,
        "relations": [{"subject": "nightstand", "relation": "near", "target": "double_bed"}],
    },
}  # fmt: skip
_TEXTS: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "ScanNet label table": ("labels.tsv", _RAW, _labels),
    "split table": ("splits.csv", "a,train\nb,test\nc,val\n", _splits),
    "class list": ("classes.txt", "bed\nchair\n# no\nnight stand\n", _label_set),
    "class list JSON": ("classes.json", '["bed", "chair", "night stand"]', _label_set),
    "class table": ("ids.csv", "id,class\n1,bed\n2,chair\n", _classes),
    "class table JSON": ("ids.json", '{"1": "bed", "2": "chair"}', _classes),
    "segments": ("rows.json", '[{"id": 1, "label": "bed"}, {"id": 2, "name": "x"}]', _classes),
    "request": ("request.json", json.dumps(_REQUEST), _request),
    "intrinsics": ("k.json", '{"fx": 50, "fy": 50, "cx": 32, "cy": 24, "width": 64}', _intrinsics),
    "pose": ("pose.json", json.dumps({"camera_to_world": _CAMERA}), _pose),
}
FORMATS |= {name: partial(text_file, *given) for name, given in _TEXTS.items()}


@entry("recipe YAML")
def recipe(folder: Path) -> Entry:
    from data_prep.front.recipe import recipe_text

    return text_file("mine.yaml", recipe_text("bedroom"), _recipe, folder)


@entry("mask PNG of an image")
def mask_png(folder: Path) -> Entry:
    from PIL import Image

    from sceneprior.apps.reconstruction.own_image import read_own_image

    ids = np.zeros((48, 64), np.uint8)
    ids[10:40, 10:30], ids[20:40, 40:60] = 1, 2
    path, classes = folder / "mask.png", folder / "classes.json"
    Image.fromarray(ids).save(path)
    classes.write_text('{"1": "double_bed", "2": "desk"}')
    return path, lambda: read_own_image(path, classes, "fov=60", LABEL_SET, camera_height_m=1.4)


@entry("COCO of an image")
def coco_image(folder: Path) -> Entry:
    from sceneprior.apps.reconstruction.own_image import read_own_image

    bed = [10, 10, 30, 10, 30, 40, 10, 40]
    data = {
        "images": [{"id": 1, "file_name": "a.jpg", "width": 64, "height": 48}],
        "categories": [{"id": 1, "name": "double_bed"}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "segmentation": [bed]}],
    }
    read = lambda path: read_own_image(path, None, "fov=60", LABEL_SET)  # noqa: E731
    return text_file("coco.json", json.dumps(data), read, folder)


# -- Shards ----------------------------------------------------------------------------------------


def shard(folder: Path, rooms: int = 2) -> Path:
    from toy_rooms import make_toy_room, write_shard

    path = folder / "train" / "a.h5"
    path.parent.mkdir(parents=True)
    rng = np.random.default_rng(0)
    write_shard(path, LABEL_SET, [make_toy_room(f"toy/{k}", rng) for k in range(rooms)])
    counts = {"train": {"rooms": rooms, "views": 16, "objects": 7}}
    index = {"label_set": LABEL_SET, "source": "posed", "counts": counts, "recipe": None}
    (folder / "index.json").write_text(json.dumps(index))
    return path


def read_shard(path: Path) -> None:
    """Everything that a shard is asked for."""
    from data_prep.inspection.verify import verify
    from sceneprior.core.dataset import FlatViews
    from sceneprior.core.shards import Shard

    verify(path.parent.parent)
    with Shard(path) as opened:
        for room_id in opened.room_ids:
            views = opened.read_room(room_id, images=True)
            opened.read_room(room_id)
            opened.read_instance_ids(room_id, range(len(views.visible)), step=4)
            opened.read_checksum(room_id)
            if opened.has_ground_truth(room_id):
                opened.read_ground_truth(room_id)
            FlatViews.of([views])


@entry("shard")
def shard_bytes(folder: Path) -> Entry:
    path = shard(folder)
    return path, lambda: read_shard(path)


@entry("shard, its structure")
def shard_structure(folder: Path) -> Entry:
    path = shard(folder)

    def restructured(path: Path, whole: bytes, rng: np.random.Generator) -> bytes:
        path.write_bytes(whole)
        restructure(path, rng)
        return path.read_bytes()

    return path, lambda: read_shard(path), restructured


def _change(group: h5py.Group, name: str, rng: np.random.Generator) -> None:
    """Damage one dataset of a room: its type, shape, values, or the whole of it."""
    old = group[name][()]
    del group[name]
    match int(rng.integers(9)):
        case 0:
            return
        case 1:
            group.create_dataset(name, data=old.astype(rng.choice(["f8", "i8", "u1", "S3", ">i2"])))
        case 2:
            group.create_dataset(name, data=old[..., :-1])
        case 3:
            group.create_dataset(name, data=old[None])
        case 4:
            huge = (2**40, *old.shape[1:])
            group.create_dataset(name, huge, old.dtype, chunks=(1, *old.shape[1:]))
        case 5:
            group.create_group(name)
        case 6:
            group.create_dataset(name, data="text")
        case 7:
            group.create_dataset(name, data=h5py.Empty(old.dtype))
        case _:
            new = old.copy()
            odd = [np.nan, np.inf, -1e30] if old.dtype.kind == "f" else [-1, 99, 30_000]
            with np.errstate(all="ignore"):
                new.flat[rng.integers(0, max(1, old.size), 3)] = np.array(rng.choice(odd)).astype(
                    old.dtype
                )
            group.create_dataset(name, data=new)


def _change_attribute(group: h5py.Group, name: str, rng: np.random.Generator) -> None:
    odd = [1, -1.5, np.nan, "", "text\n", b"\xff\xfe", [1, 2, 3], np.zeros((2, 2)), "[1, {}]"]
    del group.attrs[name]
    if rng.random() < 0.9:
        group.attrs[name] = odd[rng.integers(len(odd))]


def restructure(path: Path, rng: np.random.Generator) -> None:
    """Damage what is in a shard, in a way that HDF5 itself does not notice."""
    with h5py.File(path, "r+") as file:
        rooms = list(file["rooms"].values())
        room = rooms[rng.integers(len(rooms))]
        group = room["ground_truth"] if rng.random() < 0.3 else room
        where = rng.random()
        if where < 0.1:
            _change_attribute(file, str(rng.choice(list(file.attrs))), rng)
        elif where < 0.3:
            _change_attribute(group, str(rng.choice(list(group.attrs))), rng)
        elif where < 0.33:
            del file["rooms"]
        else:
            names = [name for name in group if name != "ground_truth"]
            _change(group, str(rng.choice(names)), rng)


@entry("index.json")
def index(folder: Path) -> Entry:
    from data_prep.inspection.verify import verify
    from sceneprior.apps.priors.card import _splits as counted

    shard(folder, rooms=1)
    return folder / "index.json", lambda: (counted(folder), verify(folder))


@entry("report.json")
def report(folder: Path) -> Entry:
    from data_prep.engine.report import make_report
    from data_prep.engine.source import Line
    from data_prep.inspection.verify import read_conventions

    world = {"file": "transforms.json", "room_from_world": np.eye(4).tolist()}
    lines = [Line("a", "a", "prepared", split="train", cameras=world), Line("b", "b", "failed")]
    text = json.dumps(make_report(lines, {}))
    read = lambda path: read_conventions(path.parent, "posed")  # noqa: E731
    return text_file("report.json", text, read, folder)


def toy_shards(folder: Path) -> Path:
    from toy_rooms import write_toy_shards

    write_toy_shards(folder / "shards")
    return folder / "shards"


@entry("lifted cache")
def lifted_cache(folder: Path) -> Entry:
    from sceneprior.lifted.lifting import ShapeGrid
    from sceneprior.lifted.lifting.dataset import LiftedDataset

    shard(folder, rooms=1)

    def read() -> None:
        LiftedDataset(folder, "train", ShapeGrid(8, 0.1))

    read()
    return folder / "lifted_train.npz", read


# -- Runs ------------------------------------------------------------------------------------------


def toy_run(folder: Path) -> Path:
    from kept_runs import write_kept_run
    from tiny_runs import tiny_config

    write_kept_run("paper", tiny_config(toy_shards(folder), layout__epochs=20), folder / "run")
    return folder / "run"


@entry("settings")
def settings(folder: Path) -> Entry:
    from tiny_runs import write_tiny_config

    from sceneprior.apps.config import load_config

    path = write_tiny_config(folder / "tiny.yaml", folder)
    return path, lambda: load_config(str(path))


@entry("settings of a comparison")
def comparison(folder: Path) -> Entry:
    from made_results import write_comparison

    from sceneprior.apps.experiments.comparison import load_comparison

    path = Path(write_comparison(folder, folder))
    return path, lambda: load_comparison(str(path))


def run_file(file: str, folder: Path) -> Entry:
    from sceneprior.apps.config import load_any_run
    from sceneprior.apps.sample import sample_rooms

    run = toy_run(folder)
    return run / file, lambda: sample_rooms(load_any_run(run), 1, 0)


FORMATS["config.yaml of a run"] = partial(run_file, "config.yaml")
FORMATS["final.ckpt"] = partial(run_file, "shape/final.ckpt")


@entry("metrics.csv")
def metrics(folder: Path) -> Entry:
    from sceneprior.apps.experiments.report import read_curves
    from sceneprior.training.trainer import make_logger

    run = toy_run(folder)
    path = run / "layout" / "metrics.csv"
    path.write_text("epoch,step,train/loss\n0,1,2.5\n1,3,1.25\n2,5,\n")

    def read() -> None:
        read_curves(run)
        whole = path.read_bytes()
        make_logger("csv", path.parent).log_metrics({"train/loss": 1.0}, 7)
        path.write_bytes(whole)

    return path, read


@entry("last.ckpt")
def last_checkpoint(folder: Path) -> Entry:
    from lightning.pytorch.callbacks import Callback
    from tiny_runs import tiny_config

    from sceneprior.training.fit import fit

    class Stop(Callback):
        """Stops after each epoch."""

        def on_train_epoch_end(self, trainer: Any, pl_module: Any) -> None:
            raise KeyboardInterrupt

    shard(folder / "shards", rooms=1)
    config, run = tiny_config(folder / "shards", layout__epochs=3), folder / "run"
    options = {"accelerator": "cpu"}
    with contextlib.suppress(KeyboardInterrupt):
        fit(config, run, trainer_options=options, callbacks=[Stop()], loggers=())
    path = shutil.copy(run / "layout" / "last.ckpt", folder / "kept.ckpt")

    def read() -> None:
        shutil.rmtree(run, ignore_errors=True)
        (run / "layout").mkdir(parents=True)
        shutil.copy(path, run / "layout" / "last.ckpt")
        with contextlib.suppress(KeyboardInterrupt):
            fit(config, run, True, (), options, [Stop()])

    return path, read


def packed(name: str, folder: Path) -> Entry:
    from kept_runs import write_kept_run
    from tiny_runs import tiny_config, tiny_sampler_config

    from sceneprior.apps.config import load_any_run
    from sceneprior.apps.priors.packed import pack, write_packed
    from sceneprior.apps.sample import sample_rooms

    shards, path = toy_shards(folder), folder / "a.prior"
    config = tiny_sampler_config(shards)
    if name == "paper":
        config = tiny_config(shards, layout__epochs=20)
    write_kept_run(name, config, folder / "run")
    write_packed(pack(load_any_run(folder / "run"), "A card.\n", latents=name == "paper"), path)
    return path, lambda: use_scenes(sample_rooms(load_any_run(path), 1, 0), folder)


FORMATS["packed prior"] = partial(packed, "paper")
FORMATS["packed prior with a sampler"] = partial(packed, "sampler")


@entry("latents.npz")
def latents(folder: Path) -> Entry:
    from sceneprior.apps.config import load_any_run
    from sceneprior.apps.sample import sample_rooms
    from sceneprior.paper.sampling import read_latent, write_latents

    trained = load_any_run(toy_run(folder))
    write_latents(folder, sample_rooms(trained, 2, 0))
    path = folder / "latents.npz"
    return path, lambda: (read_latent(trained, str(path)), read_latent(trained, f"{path}:1"))


@entry("scores.json")
def scores(folder: Path) -> Entry:
    from made_results import write_new_rooms

    from sceneprior.apps.priors.card import _scores as on_card
    from sceneprior.evaluation.report import _tiles as tiles
    from sceneprior.evaluation.score_table import headings, print_scores, read_scores, score_rows

    path = folder / "scores.json"
    write_new_rooms(path, 3, "paper", remembers=True)
    relation = {"of": "a", "to": "b", "distance_m": 1, "train_m": 1, "near": 0.5, "near_test": None}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"relations": [relation]}))

    def read() -> None:
        found = read_scores(path, "evaluate again")
        on_card(found), tiles(found), headings(found), score_rows(found), print_scores(found)

    return path, read


def result(name: str, folder: Path) -> Entry:
    from made_results import write_comparison, write_new_rooms, write_views

    from sceneprior.apps.experiments import rows, table
    from sceneprior.apps.experiments.comparison import load_comparison, runs_of, variants_of

    rows.costs_of = lambda run: {"cpu_s": None, "steps": 1, "parameters": 1}
    views = {"task": "single_views", "fits": ["paper"]} if name == "eval-svr" else {}
    comparison = load_comparison(write_comparison(folder, Path("shards"), **views))
    runs = runs_of(comparison, folder / "out")
    for run in runs:
        for k, variant in enumerate(variants_of(comparison, run)):
            if views:
                write_views(variant.result, k, cad=True)
            else:
                write_new_rooms(variant.result, k, "paper", remembers=True)
    path = variants_of(comparison, runs[0])[0].result

    def read() -> None:
        found = [row for run in runs for row in rows.rows_of(comparison, run)]
        table.write_tables(found, rows.form_of(comparison), folder)

    return path, read


FORMATS["result of eval-fid"] = partial(result, "eval-fid")
FORMATS["result of eval-svr"] = partial(result, "eval-svr")


@entry("steps.json")
def steps(folder: Path) -> Entry:
    from sceneprior.apps.experiments.commands import Command, finished_commands, is_done

    noted = {"arguments": ["fit"], "depends_on": [], "cpu_s": 1.5, "wall_s": 2, "finished": True}
    command = Command("fit", ["fit"], folder, [])
    read = lambda path: (finished_commands(path.parent), is_done(command, folder))  # noqa: E731
    return text_file("steps.json", json.dumps({"homes": noted, "fit": noted}), read, folder)
