"""A scan in, its labelled views out, in the arrays that shards store."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from data_prep.engine.source import PreparedRoom
from data_prep.frames import sampled_lines
from data_prep.scannet.labels import LABEL_SET
from data_prep.scannet.masks import MaskArchive
from data_prep.scannet.scans import Scan
from sceneprior.classes import label_set
from sceneprior.instances.observations import observe
from sceneprior.shards import RoomGroundTruth, RoomViews


@dataclass(frozen=True)
class LabelledView:
    """What one frame shows."""

    frame: int
    """Number in the recording."""
    world_to_camera: np.ndarray
    """(4, 4) float64."""
    ids: np.ndarray
    """(height, width): 0 = nothing or the room's shell, k + 1 = instance k of the scan, and
    len(instances) + 1 = an id that the aggregation does not have."""
    unknown: tuple[int, ...]
    """Such object ids."""


def labelled_views(scan: Scan) -> Iterator[LabelledView]:
    """The scan's views in the order of their frames, one mask in memory at a time.

    Masks are sampled, never averaged, at `sampled_lines`; `scan.intrinsics` knows where the
    sampled pixels' centres are.

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
            strange = np.setdiff1d(np.unique(values), known)
            yield LabelledView(
                frame, world_to_camera, table[values], tuple((strange.astype(int) - 1).tolist())
            )


def prepare_scan(scan: Scan) -> PreparedRoom | None:
    """Label all views of a scan; None if no view shows an object.

    An image of ids alone says that two objects touch, not which of them is in front. So
    `sides_clear` treats ScanNet as it does drawn rooms: a side is the object's own where no other
    thing touches it, and a thing is furniture, also of no class (`void`). The room's shell (walls,
    floor, doors, ...) surrounds everything and stands behind it, so it counts as nothing; a corner
    of a wall or an open door that does hide an object's side goes unnoticed.

    Raises:
        InputError: a mask is damaged, or of another size than the first.
    """
    names = label_set(LABEL_SET)
    images: list[np.ndarray] = []
    unknown: set[int] = set()
    for view in labelled_views(scan):
        images.append(view.ids)
        unknown.update(view.unknown)
    # The last entry stands for ids without an object: they hide what is behind them.
    is_object = np.array([item.label != "void" for item in scan.instances] + [False])
    seen = observe(np.stack(images), is_object)
    if not len(seen.tracked):
        return None
    unseen = np.setdiff1d(np.flatnonzero(is_object), seen.tracked)
    order = [*seen.tracked.tolist(), *unseen.tolist()]
    classes = np.array([names.index(scan.instances[k].label) for k in order], dtype=np.int16)
    notes = scan.notes
    if unknown:
        listed = ", ".join(map(str, sorted(unknown)))
        notes += (f"masks show objects that the aggregation does not have ({listed}): void",)
    return PreparedRoom(
        RoomViews(
            room_id=scan.scan_id,
            object_class=classes[: len(seen.tracked)],
            world_to_camera=scan.world_to_camera.astype(np.float32),
            intrinsics=np.repeat(scan.intrinsics.astype(np.float32)[None], len(images), axis=0),
            boxes=seen.boxes,
            visible=seen.visible,
            mask_pixels=seen.mask_pixels,
            sides_clear=seen.sides_clear,
            instance_ids=seen.instance_ids,
            image_size=scan.settings.image_size,
        ),
        _ground_truth(scan, order, classes),
        notes=notes,
    )


def _ids_of_values(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """(256,) our id of each mask value, and the values that the aggregation explains."""
    unknown = len(scan.instances) + 1
    table = np.full(256, unknown, dtype=np.uint8 if unknown <= 255 else np.uint16)
    table[0] = 0
    known = [0]
    for k, item in enumerate(scan.instances):
        if item.object_id < 255:  # an 8-bit mask cannot show more
            table[item.object_id + 1] = 0 if item.is_shell else k + 1
            known.append(item.object_id + 1)
    return table, np.array(known)


def _ground_truth(scan: Scan, order: list[int], classes: np.ndarray) -> RoomGroundTruth:
    lower = np.array([scan.instances[k].lower_m for k in order])
    upper = np.array([scan.instances[k].upper_m for k in order])
    places = np.zeros((len(order), 4, 4))
    # No model is known: the unit cube stands for it, and fills the box.
    places[:, (0, 1, 2), (0, 1, 2)] = upper - lower
    places[:, :3, 3] = (lower + upper) / 2
    places[:, 3, 3] = 1
    return RoomGroundTruth(
        object_class=classes,
        centers_m=((lower + upper) / 2).astype(np.float32),
        sizes_m=(upper - lower).astype(np.float32),
        yaw_rad=np.zeros(len(order), dtype=np.float32),
        model_ids=("",) * len(order),
        model_to_room=places.astype(np.float32),
        floor_m=scan.floor_m.astype(np.float32),
        height_m=scan.height_m,
    )
