"""Labels the views of one scan and returns the arrays stored in shards."""

import numpy as np

from data_prep.engine.source import PreparedRoom
from data_prep.readers.frames import sampled_lines
from data_prep.readers.scannet.labels import LABEL_SET
from data_prep.readers.scannet.masks import MaskArchive
from data_prep.readers.scannet.occlusion import unoccluded
from data_prep.readers.scannet.scans import Scan
from sceneprior.core.classes import label_set
from sceneprior.core.observations import observe
from sceneprior.core.scene import Mesh
from sceneprior.core.shards import RoomGroundTruth, thinned_stuff


def instance_images(scan: Scan) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Read the instance ids and the stuff of all views, and the object ids missing from the
    aggregation.

    Masks are downsampled without averaging (`sampled_lines`); `scan.intrinsics` accounts for the
    offset of the sampled pixels' centres.

    Returns:
        (views, height, width): 0 = no object or the room's shell, k + 1 = instance k of the scan,
        and len(instances) + 1 = an object id that is missing; indices into `STUFF`, uint8, at the
        pixels of `thinned_stuff`; and the missing ids, ascending.
    """
    table, stuff_table, known = _tables_of_values(scan)
    images, stuff, unlisted = [], [], set()
    with MaskArchive(scan.masks) as masks:
        sizes = zip(masks.image_size, scan.settings.image_size, strict=True)
        lines = np.ix_(*(sampled_lines(*size) for size in sizes))
        for frame in scan.frames:
            values = masks.read(frame)[lines]
            images.append(table[values])
            stuff.append(stuff_table[thinned_stuff(values)])
            unlisted.update(np.setdiff1d(values, known).tolist())
    return np.stack(images), np.stack(stuff), sorted(value - 1 for value in unlisted)


def prepare_scan(scan: Scan) -> PreparedRoom | None:
    """Label all views of a scan; None if no view shows an object.

    An image of ids shows that two objects touch, but not which one is in front. So `sides_clear` is
    defined as for rendered rooms: a side is clear if no other furniture, void included, touches
    it. The room's shell (walls, floor, doors, ...) is ignored because it is nearly always behind;
    a wall corner or an open door that does occlude a side goes unnoticed. The ground truth's
    `unoccluded` accounts for these, but only `inspect --verify` uses it.
    """
    names = label_set(LABEL_SET)
    images, stuff, unlisted = instance_images(scan)
    # The last entry stands for ids without an object, which may occlude others.
    labels = [*(item.label for item in scan.instances), "void"]
    classes = np.array([names.index(label) for label in labels], dtype=np.int16)
    seen = observe(images, classes)
    del images  # `seen` has its own images
    if not len(seen.tracked):
        return None
    notes = scan.notes
    if unlisted:
        listed = ", ".join(map(str, unlisted))
        notes += (f"masks show objects that the aggregation does not have ({listed}): void",)
    views = seen.room_views(scan.scan_id, scan.world_to_camera, scan.intrinsics, stuff)
    order = np.concatenate([seen.tracked, seen.unseen])
    truth, models = _ground_truth(scan, order, classes[order], unoccluded(scan, seen.tracked))
    return PreparedRoom(views, truth, models, notes=notes)


def _tables_of_values(scan: Scan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Our ids and the indices into `STUFF` by mask value, (256,) each, and the mask values known
    to the aggregation."""
    unknown = len(scan.instances) + 1
    table = np.full(256, unknown, dtype=np.uint8 if unknown <= 255 else np.uint16)
    table[0] = 0
    stuff = np.zeros(256, dtype=np.uint8)
    known = [0]
    for k, item in enumerate(scan.instances):
        if item.object_id < 255:  # an 8-bit mask cannot show more
            table[item.object_id + 1] = 0 if item.is_shell else k + 1
            stuff[item.object_id + 1] = item.stuff
            known.append(item.object_id + 1)
    return table, stuff, np.array(known)


def _ground_truth(
    scan: Scan, order: np.ndarray, classes: np.ndarray, whole: np.ndarray
) -> tuple[RoomGroundTruth, dict[str, Mesh]]:
    """Ground truth of these instances, and their surfaces as models centred at the origin."""
    lower = np.array([scan.instances[k].lower_m for k in order])
    upper = np.array([scan.instances[k].upper_m for k in order])
    centers_m = (lower + upper) / 2
    models: dict[str, Mesh] = {}
    model_ids = []
    places = np.tile(np.eye(4), (len(order), 1, 1))
    places[:, :3, 3] = centers_m
    for row, k in enumerate(order):
        item = scan.instances[k]
        if item.surface is None:
            # Without a model, the transform maps the unit cube to the box.
            model_ids.append("")
            places[row, :3, :3] = np.diag(upper[row] - lower[row])
            continue
        model_ids.append(f"{scan.scan_id}_{item.object_id:03d}")
        surface = Mesh(item.surface.vertices_m - centers_m[row], item.surface.faces)
        models[model_ids[-1]] = surface
    truth = RoomGroundTruth(
        object_class=classes,
        centers_m=centers_m.astype(np.float32),
        sizes_m=(upper - lower).astype(np.float32),
        yaw_rad=np.zeros(len(order), dtype=np.float32),
        model_ids=tuple(model_ids),
        model_to_room=places.astype(np.float32),
        floor_m=scan.floor_m.astype(np.float32),
        height_m=scan.height_m,
        unoccluded=whole,
    )
    return truth, models
