"""Write reconstructions: scenes, and pictures of the input masks next to the result."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from sceneprior.apps.reconstruction.reconstruct import Reconstruction
from sceneprior.apps.rooms import PAGE_FILE, clear_scenes, write_scene
from sceneprior.core.cameras import Pinhole
from sceneprior.core.classes import label_set
from sceneprior.core.files import write_whole
from sceneprior.core.observed_image import ObservedImage
from sceneprior.core.scene import Scene
from sceneprior.evaluation.page import png_uri, write_rooms_page
from sceneprior.render.appearance import object_colors, quiet_colors, scene_meshes
from sceneprior.render.offscreen import SoftwareRenderer
from sceneprior.render.pictures import paint_ids, png_bytes
from sceneprior.render.topdown import topdown, topdown_protocol

HEIGHT_PX = 360
"""Height of each panel, to which masks are scaled."""
GAP_PX, LINE_PX = 8, 24
PAPER, INK, FRAME = (255, 255, 255), (40, 40, 40), (200, 200, 200)
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
    panels = {
        "masks given": masks_of(image),
        "found, same camera": from_camera(scene, image),
        "found, from above": from_above(scene, image),
    }
    tiles = [_as_tile(panel) for panel in panels.values()]
    width = sum(tile.width for tile in tiles) + GAP_PX * (len(tiles) - 1)
    rows = _legend_rows(found, width)
    sheet = Image.new("RGB", (width, LINE_PX * (1 + len(rows)) + HEIGHT_PX), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    x = 0
    for title, tile in zip(panels, tiles, strict=True):
        draw.text((x + 2, 3), title, INK, font)
        sheet.paste(tile, (x, LINE_PX))
        draw.rectangle((x, LINE_PX, x + tile.width - 1, LINE_PX + HEIGHT_PX - 1), outline=FRAME)
        x += tile.width + GAP_PX
    for line, row in enumerate(rows):
        y = LINE_PX * (1 + line) + HEIGHT_PX
        for x, name, color in row:
            draw.rectangle((x, y + 6, x + 12, y + 18), color)
            draw.text((x + 17, y + 3), name, INK, font)
    return np.asarray(sheet)


def masks_of(image: ObservedImage) -> UInt8[np.ndarray, "height width 3"]:
    """Picture of an image's masks, in the colours of their classes."""
    colors = quiet_colors(label_set(image.label_set))[image.object_class]
    return paint_ids(image.instance_ids.astype(np.int64), colors, PAPER)


def from_camera(scene: Scene, image: ObservedImage) -> UInt8[np.ndarray, "height width 3"]:
    """Shaded picture of a scene from the camera of an image."""
    camera = Pinhole(image.world_to_camera.astype(np.float64), image.intrinsics.astype(np.float64))
    height, width = image.instance_ids.shape
    return SoftwareRenderer().shaded(
        scene_meshes(scene), object_colors(scene), camera, (height, width)
    )


def _as_tile(panel: UInt8[np.ndarray, "height width 3"]) -> Image.Image:
    width = max(round(panel.shape[1] * HEIGHT_PX / panel.shape[0]), 1)
    return Image.fromarray(panel).resize((width, HEIGHT_PX), Image.Resampling.NEAREST)


def _legend_rows(
    found: Reconstruction, width: int
) -> list[list[tuple[int, str, tuple[int, int, int]]]]:
    names = label_set(found.image.label_set)
    shown = {names[index] for index in found.image.object_class} | {
        item.label for item in found.scene.objects
    }
    colors, font = quiet_colors(names), ImageFont.load_default(14)
    rows: list[list[tuple[int, str, tuple[int, int, int]]]] = [[]]
    x = 2
    for index, name in enumerate(names):
        if name not in shown:
            continue
        wide = 17 + round(font.getlength(name)) + 16
        if x + wide > width and rows[-1]:
            rows.append([])
            x = 2
        red, green, blue = (int(value) for value in colors[index])
        rows[-1].append((x, name, (red, green, blue)))
        x += wide
    return rows


def from_above(scene: Scene, image: ObservedImage) -> UInt8[np.ndarray, "height width 3"]:
    """Top-down picture of the reconstruction, with the camera and its field of view."""
    turn, eye = image.world_to_camera[:3, :3].astype(np.float64), image.eye_m
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
    for u in (0, image.instance_ids.shape[1]):
        ray = turn.T @ np.array([(u - image.intrinsics[0, 2]) / image.intrinsics[0, 0], 0, 1])
        draw.line((pixel(eye), pixel(eye + SIGHT_M * ray)), INK, 2)
    x, y = pixel(eye)
    draw.ellipse((x - 4, y - 4, x + 4, y + 4), INK)
    return np.asarray(plan)
