"""Labels the views of one scan and returns the arrays stored in shards."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from data_prep.engine.source import PreparedRoom
from data_prep.frames import sampled_lines
from data_prep.scannet.labels import LABEL_SET
from data_prep.scannet.masks import MaskArchive
from data_prep.scannet.occlusion import unoccluded
from data_prep.scannet.scans import Scan
from sceneprior.core.classes import label_set
from sceneprior.core.instances.observations import observe
from sceneprior.core.scene import Mesh
from sceneprior.core.shards import RoomGroundTruth


@dataclass(frozen=True)
class LabelledView:
    """Instance ids of one frame."""

    frame: int
    """Number of the frame in the recording."""
    world_to_camera: np.ndarray
    """(4, 4) float64."""
    ids: np.ndarray
    """(height, width): 0 = no object or the room's shell, k + 1 = instance k of the scan, and
    len(instances) + 1 = an object id that is missing from the aggregation."""
    unlisted: tuple[int, ...]
    """Object ids in the mask that are missing from the aggregation."""


def labelled_views(scan: Scan) -> Iterator[LabelledView]:
    """Read the scan's views in the order of their frames, one mask in memory at a time.

    Masks are downsampled without averaging (`sampled_lines`); `scan.intrinsics` accounts for the
    offset of the sampled pixels' centres.

    Raises:
        InputError: a mask is damaged, or of another size than the first.
    """
    table, known = _ids_of_values(scan)
    with MaskArchive(scan.masks) as masks:
        height, width = scan.settings.image_size
        rows = sampled_lines(masks.image_size[0], height)
        columns = sampled_lines(masks.image_size[1], width)
        for frame, world_to_camera in zip(scan.frames, scan.world_to_camera, strict=True):
            values = masks.read(frame)[np.ix_(rows, columns)]
            unlisted = np.setdiff1d(np.unique(values), known)
            yield LabelledView(
                frame, world_to_camera, table[values], tuple((unlisted.astype(int) - 1).tolist())
            )


def prepare_scan(scan: Scan) -> PreparedRoom | None:
    """Label all views of a scan; None if no view shows an object.

    An image of ids shows that two objects touch, but not which one is in front. So `sides_clear` is
    defined as for rendered rooms: a side is clear if no other furniture, void included, touches
    it. The room's shell (walls, floor, doors, ...) is ignored because it is nearly always behind;
    a wall corner or an open door that does occlude a side goes unnoticed. The ground truth's
    `unoccluded` accounts for these, but only `inspect --verify` uses it.

    Raises:
        InputError: a mask is damaged, or of another size than the first.
    """
    names = label_set(LABEL_SET)
    images: list[np.ndarray] = []
    unlisted: set[int] = set()
    for view in labelled_views(scan):
        images.append(view.ids)
        unlisted.update(view.unlisted)
    # The last entry stands for ids without an object, which may occlude others.
    labels = [*(item.label for item in scan.instances), "void"]
    classes = np.array([names.index(label) for label in labels], dtype=np.int16)
    seen = observe(np.stack(images), classes)
    del images  # `seen` has its own
    if not len(seen.tracked):
        return None
    notes = scan.notes
    if unlisted:
        listed = ", ".join(map(str, sorted(unlisted)))
        notes += (f"masks show objects that the aggregation does not have ({listed}): void",)
    views = seen.room_views(scan.scan_id, scan.world_to_camera, scan.intrinsics)
    order = np.concatenate([seen.tracked, seen.unseen])
    truth, models = _ground_truth(scan, order, classes[order])
    truth = replace(truth, unoccluded=unoccluded(scan, seen.tracked))
    return PreparedRoom(views, truth, models, notes=notes)


def _ids_of_values(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Table of our ids by mask value, (256,), and the mask values known to the aggregation."""
    unknown = len(scan.instances) + 1
    table = np.full(256, unknown, dtype=np.uint8 if unknown <= 255 else np.uint16)
    table[0] = 0
    known = [0]
    for k, item in enumerate(scan.instances):
        if item.object_id < 255:  # an 8-bit mask cannot show more
            table[item.object_id + 1] = 0 if item.is_shell else k + 1
            known.append(item.object_id + 1)
    return table, np.array(known)


def _ground_truth(
    scan: Scan, order: np.ndarray, classes: np.ndarray
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
    )
    return truth, models
