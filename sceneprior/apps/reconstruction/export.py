"""Write reconstructions: scenes, and pictures of the input masks next to the result."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from sceneprior.apps.reconstruction.reconstruct import Reconstruction
from sceneprior.apps.rooms import PAGE_FILE, clear_scenes, write_scene
from sceneprior.core.cameras import Pinhole, pixel_rays
from sceneprior.core.classes import label_set
from sceneprior.core.files import write_whole
from sceneprior.core.scene import Scene
from sceneprior.core.views import ObservedImage
from sceneprior.evaluation.page import png_uri, write_rooms_page
from sceneprior.render.appearance import (
    contact_sheet,
    object_colors,
    paint_ids,
    png_bytes,
    quiet_colors,
    scene_meshes,
)
from sceneprior.render.offscreen import SoftwareRenderer
from sceneprior.render.topdown import topdown, topdown_protocol

HEIGHT_PX = 360
"""Height of each panel, to which masks are scaled."""
GAP_PX, LINE_PX, COLUMN_PX = 8, 24, 170
"""Gap between panels; height and width of an entry of the legend."""
PAPER, INK = (255, 255, 255), (40, 40, 40)
MARGIN_M = 0.3
"""Smallest margin around the camera in the top view."""
SIGHT_M = 0.8
"""Length of the lines that show the field of view in the top view."""


def write_reconstructions(found: Sequence[Reconstruction], folder: Path) -> None:
    """Write `<name>.json`, `.glb` and `.png`, and `<name>_seen.png`, for each image.

    The JSON's `extra` holds the image's room and view, its camera, and the scores of the fit.
    """
    clear_scenes(folder)
    for one in found:
        image = one.image
        extra = {
            "room_id": image.room_id,
            "view": image.view,
            "world_to_camera": image.world_to_camera.tolist(),
            "intrinsics": image.intrinsics.tolist(),
            "image_size": list(image.instance_ids.shape),
            "score": round(one.score, 5),
            "mask_iou": None if one.mask_iou is None else round(one.mask_iou, 4),
            "steps": one.steps,
            "taken_for": one.taken_for,
        }
        write_whole(Path(folder) / f"{image.name}_seen.png", png_bytes(picture(one)))
        write_scene(replace(one.scene, extra=extra), folder, image.name)


def write_page(found: Reconstruction, folder: Path) -> None:
    """Write `rooms.html` to the folder of `write_reconstructions`."""
    seen = png_uri(Image.fromarray(picture(found)))
    write_rooms_page(
        Path(folder) / PAGE_FILE,
        [found.scene],
        title=found.image.name,
        subtitle="A room from the masks of one image",
        pictures=[("The masks, the reconstruction from the same camera, and from above", seen)],
    )


def picture(found: Reconstruction) -> UInt8[np.ndarray, "height width 3"]:
    """Three panels (masks, camera view, top view) with titles and a legend, coloured by class."""
    image, scene = found.image, found.scene
    names = label_set(image.label_set)
    colors = quiet_colors(names)
    camera = Pinhole(image.world_to_camera.astype(np.float64), image.intrinsics.astype(np.float64))
    panels = {
        "masks given": paint_ids(
            image.instance_ids.astype(np.int64), colors[image.object_class], PAPER
        ),
        "found, same camera": SoftwareRenderer().shaded(
            scene_meshes(scene), object_colors(scene), camera, image.instance_ids.shape
        ),
        "found, from above": from_above(scene, image),
    }
    sheet = contact_sheet([_scaled(panel) for panel in panels.values()], 3, list(panels), GAP_PX)
    shown = {names[index] for index in image.object_class} | {each.label for each in scene.objects}
    rows = [index for index, name in enumerate(names) if name in shown]
    return np.concatenate([sheet, _legend([names[row] for row in rows], colors[rows], sheet)])


def _scaled(panel: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "tall wide 3"]:
    width = max(round(panel.shape[1] * HEIGHT_PX / panel.shape[0]), 1)
    scaled = Image.fromarray(panel).resize((width, HEIGHT_PX), Image.Resampling.NEAREST)
    return np.asarray(scaled)


def _legend(
    names: Sequence[str],
    colors: UInt8[np.ndarray, "classes 3"],
    above: UInt8[np.ndarray, "_ width 3"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Colours of classes, in columns below a picture of the same width."""
    columns = max(above.shape[1] // COLUMN_PX, 1)
    legend = Image.new("RGB", (above.shape[1], LINE_PX * -(-len(names) // columns)), PAPER)
    draw, font = ImageDraw.Draw(legend), ImageFont.load_default(14)
    for place, (name, color) in enumerate(zip(names, colors.tolist(), strict=True)):
        y, x = LINE_PX * (place // columns), COLUMN_PX * (place % columns) + GAP_PX
        draw.rectangle((x, y + 6, x + 12, y + 18), tuple(color))
        draw.text((x + 17, y + 3), name, INK, font)
    return np.asarray(legend)


def from_above(scene: Scene, image: ObservedImage) -> UInt8[np.ndarray, "height width 3"]:
    """Top-down picture of the reconstruction, with the camera and its field of view."""
    eye = image.eye_m
    reach_m = [np.abs(scene.centers_m) + scene.sizes_m / 2, np.abs(eye) + MARGIN_M]
    widest_m = 2 * float(np.concatenate([part.reshape(-1, 3) for part in reach_m])[:, [0, 2]].max())
    protocol = topdown_protocol(scene.label_set)
    window_m = max(protocol.window_m, widest_m)  # unlike in metrics, nothing is cut off
    protocol = replace(protocol, image_size=(HEIGHT_PX, HEIGHT_PX), window_m=window_m)
    plan = Image.fromarray(topdown(scene, protocol, outlines=True))

    def pixel(point_m: np.ndarray) -> tuple[float, float]:
        x, z = point_m[[0, 2]] / protocol.metres_per_pixel + HEIGHT_PX / 2
        return float(x), float(z)

    draw = ImageDraw.Draw(plan)
    middle = image.intrinsics[1, 2]
    sides = np.array([[0, middle], [image.instance_ids.shape[1], middle]])
    for ray in pixel_rays(sides, image.world_to_camera, image.intrinsics):
        draw.line((pixel(eye), pixel(eye + SIGHT_M * ray)), INK, 2)
    x, y = pixel(eye)
    draw.ellipse((x - 4, y - 4, x + 4, y + 4), INK)
    return np.asarray(plan)
