"""Floor plans: pictures of whole rooms from above, with doors, windows, a scale and a legend.

They are for readers. Metrics use `topdown`, whose window and scale are the same for all rooms.
"""

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from sceneprior.core.cameras import Orthographic
from sceneprior.core.scene import Scene
from sceneprior.render.appearance import BACKGROUND, FLOOR_COLOR, object_colors, scene_meshes
from sceneprior.render.offscreen import SoftwareRenderer
from sceneprior.render.pictures import paint_ids

PLAN_PX, LEGEND_PX, FONT_PX = 512, 150, 13
LEAST_M = 3.0
"""Smallest side of the plan, so that a single chair does not fill it."""
BORDER = 0.05
"""Share of the plan's side that stays free around the room."""
WALL, DOOR, WINDOW = (90, 86, 80), (176, 120, 60), (90, 160, 215)
"""Colours of the floor's outline and of openings in it."""


def floor_plan(scene: Scene) -> UInt8[np.ndarray, "512 662 3"]:
    """Draw a whole room from straight above, scaled to fit the picture; +x is right, +z down.

    Objects have flat class colours and dark borders, and the highest surface hides what is below
    it. To the right stand a legend of the classes and a scale bar.
    """
    center, side_m = _window(scene)
    picture = Image.new("RGB", (PLAN_PX + LEGEND_PX, PLAN_PX), BACKGROUND)
    picture.paste(plan_of(scene, center, side_m))
    _legend(ImageDraw.Draw(picture), scene, PLAN_PX / side_m)
    return np.asarray(picture)


def plan_of(scene: Scene, center: Float[np.ndarray, "2"], side_m: float) -> Image.Image:
    """Draw the square of a room around `center` (x, z), without a legend, 512 x 512 pixels."""
    scale = PLAN_PX / side_m
    ids = np.zeros((PLAN_PX, PLAN_PX), dtype=np.uint16)
    colors = object_colors(scene)
    if scene.objects:
        meshes = scene_meshes(scene)
        height_m = max(float(mesh.vertices_m[:, 1].max()) for mesh in meshes) + 1
        x, z = center
        camera = np.array([[1.0, 0, 0, -x], [0, 0, 1, -z], [0, -1, 0, height_m], [0, 0, 0, 1]])
        ids = SoftwareRenderer().instance_ids(meshes, Orthographic(camera, 1 / scale), ids.shape)
    plan = Image.new("RGB", (PLAN_PX, PLAN_PX), BACKGROUND)
    draw = ImageDraw.Draw(plan)

    def pixels(points_m: Float[np.ndarray, "points 2"]) -> list[tuple[float, float]]:
        return [tuple(point) for point in (points_m - center) * scale + PLAN_PX / 2]

    if scene.floor_m is not None:
        outline = pixels(np.asarray(scene.floor_m, dtype=np.float64))
        draw.polygon(outline, fill=FLOOR_COLOR)
        draw.line([*outline, outline[0]], fill=WALL, width=3)
    for opening in scene.openings:
        ends = pixels(np.array([opening.start_m, opening.end_m]))
        draw.line(ends, fill=DOOR if opening.kind == "door" else WINDOW, width=7)
    painted = Image.fromarray(paint_ids(ids, colors, BACKGROUND))
    plan.paste(painted, mask=Image.fromarray(np.uint8(255) * (ids > 0)))
    return plan


def _window(scene: Scene) -> tuple[Float[np.ndarray, "2"], float]:
    """Centre (x, z) and side in metres of the square that the plan shows."""
    points = [mesh.vertices_m[:, [0, 2]] for mesh in scene_meshes(scene)]
    if scene.floor_m is not None:
        points.append(np.asarray(scene.floor_m, dtype=np.float64))
    every = np.concatenate(points) if points else np.zeros((1, 2))
    low, high = every.min(axis=0), every.max(axis=0)
    side_m = max(float((high - low).max()) / (1 - 2 * BORDER), LEAST_M)
    return (low + high) / 2, side_m


def _legend(draw: ImageDraw.ImageDraw, scene: Scene, scale: float) -> None:
    """Draw a square and a name for each class and kind of opening, and the scale bar below."""
    font = ImageFont.load_default(size=FONT_PX)
    labels = [item.label for item in scene.objects]
    rows: dict[str, tuple[int, ...]] = {}
    for label, color in sorted(zip(labels, object_colors(scene).tolist(), strict=True)):
        count = labels.count(label)
        rows[f"{label} x {count}" if count > 1 else label] = tuple(color)
    for kind, color in (("door", DOOR), ("window", WINDOW)):
        if any(opening.kind == kind for opening in scene.openings):
            rows[kind] = color
    step = min(FONT_PX + 7, (PLAN_PX - 60) // max(len(rows), 1))
    left = PLAN_PX + 8
    for row, (name, color) in enumerate(rows.items()):
        top = 14 + row * step
        draw.rectangle((left, top, left + FONT_PX - 1, top + FONT_PX - 1), fill=color)
        draw.text((left + FONT_PX + 6, top - 2), name, fill="black", font=font)
    bar_m = 1 if scale < LEGEND_PX - 20 else 0.5
    draw.line((left, PLAN_PX - 20, left + bar_m * scale, PLAN_PX - 20), fill="black", width=3)
    draw.text((left, PLAN_PX - 40), f"{bar_m:g} m", fill="black", font=font)
