"""Pictures of scenes: from straight above, floor plans, and from above a corner.

Metrics use `topdown`, whose window and scale are the same for all rooms; a floor plan shows a whole
room with its doors, windows, a scale and a legend.
"""

import base64
import html
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from PIL import Image, ImageDraw, ImageFont

from sceneprior.core.cameras import Orthographic, Pinhole, look_at
from sceneprior.core.classes import class_colors, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh, Scene
from sceneprior.core.shell import ShellName, floor_rectangle, rectangle, shell_of, slab
from sceneprior.render.appearance import (
    BACKGROUND,
    FLOOR_COLOR,
    WALL_COLOR,
    object_colors,
    paint_ids,
    png_bytes,
    scene_meshes,
)
from sceneprior.render.offscreen import SoftwareRenderer

DIRECTION = np.array([0.42, 0.62, 0.66])
"""Unit vector from a room towards the camera of `perspective`; 3D models start in this view."""


@dataclass(frozen=True)
class TopDownProtocol:
    """The settings of a top-down picture."""

    image_size: tuple[int, int] = (512, 512)
    """(height, width) in pixels, as in the paper."""
    window_m: float = 6.4
    """Side of the square of floor in the picture; objects outside are cut off."""
    camera_height_m: float = 10.0
    """The camera's height above the floor; nothing above it is drawn."""
    background: tuple[int, int, int] = BACKGROUND
    """RGB of pixels without an object. The floor is not drawn: not all methods generate one."""

    @property
    def metres_per_pixel(self) -> float:
        """Side of the square that a pixel covers."""
        return self.window_m / self.image_size[1]

    def as_dict(self) -> dict[str, object]:
        """The protocol, for a result file."""
        return {**asdict(self), "metres_per_pixel": self.metres_per_pixel}


def topdown_protocol(label_set_name: str) -> TopDownProtocol:
    """The protocol of a label set: 12.5 mm per pixel for bedrooms, 25 mm for all other sets.

    The windows hold the largest rooms that ATISS's filter accepts (6 x 6 m bedrooms, 12 x 12 m
    living rooms).
    """
    label_set(label_set_name)
    return TopDownProtocol(window_m=6.4 if label_set_name == "front3d_bedroom" else 12.8)


def topdown(
    scene: Scene,
    protocol: TopDownProtocol | None = None,
    outlines: bool = False,
) -> UInt8[np.ndarray, "height width 3"]:
    """Orthographic picture of a room from above: one flat colour per class, without shading.

    Image right is +x, image down is +z, and the room's origin is the centre of the image. Where
    objects overlap, the highest surface is drawn. If `protocol` is None, the protocol of the
    scene's label set is used. `outlines` darkens the borders between objects and uses muted
    colours; such pictures are for readers, not for metrics.

    Source:
        The paper, section 4.2: 512 x 512, orthographic, a colour per category.
    """
    protocol = protocol or topdown_protocol(scene.label_set)
    scale, height_m = protocol.metres_per_pixel, protocol.camera_height_m
    ids = _ids_from_above(scene, np.zeros(2), height_m, scale, protocol.image_size)
    if outlines:
        return paint_ids(ids, object_colors(scene), protocol.background)
    colors = class_colors(len(label_set(scene.label_set)))[scene.class_indices]
    return np.concatenate([[protocol.background], colors]).astype(np.uint8).take(ids, axis=0)


def _ids_from_above(
    scene: Scene,
    center: Float[np.ndarray, "2"],
    height_m: float,
    metres_per_pixel: float,
    image_size: tuple[int, int],
) -> UInt16[np.ndarray, "height width"]:
    """Instance ids seen by an orthographic camera above `center` (x, z)."""
    if not scene.objects:
        return np.zeros(image_size, dtype=np.uint16)
    x, z = center
    pose = np.array([[1.0, 0, 0, -x], [0, 0, 1, -z], [0, -1, 0, height_m], [0, 0, 0, 1]])
    camera = Orthographic(pose, metres_per_pixel)
    return SoftwareRenderer().instance_ids(scene_meshes(scene), camera, image_size)


@dataclass(frozen=True)
class CornerView:
    """The camera of `perspective`, and the floor and walls that it draws."""

    camera: Pinhole
    image_size: tuple[int, int]
    floor: Mesh
    walls: tuple[Mesh, ...] = ()
    """Walls of a single room that lie behind its furniture, as seen from the camera."""


def shows_walls(scene: Scene, shell: ShellName) -> bool:
    """True if pictures of a room show walls: if `shell` does, or the room has doors or windows."""
    return shell == "walls" or bool(scene.openings)


def view_of(scene: Scene, image_size: tuple[int, int], shell: ShellName = "none") -> CornerView:
    """A view of a room from outside, above a corner, that just contains it.

    It shows the floor and the furniture. With walls (`shows_walls`), it also shows those that lie
    behind the furniture as seen from the camera; the other walls are left out.
    """
    if not shows_walls(scene, shell):
        return corner_view([scene], image_size)
    around = shell_of(scene)
    meshes, toward = around.meshes(), DIRECTION[[0, 2]]
    behind = [row for row, wall in enumerate(around.walls) if wall.outward @ toward < 0]
    walls = tuple(meshes[f"wall_{row}"] for row in behind)
    floor = meshes["floor"]
    return _fitted([floor, *walls, *scene_meshes(scene)], image_size, floor, walls)


def corner_view(scenes: Sequence[Scene], image_size: tuple[int, int] = (360, 480)) -> CornerView:
    """A view from outside, above a corner, that just contains all given rooms.

    The floor is that of the room's outline; without an outline, and for several rooms, it is the
    rectangle around outlines and objects.
    """
    floors = np.array([floor_rectangle(scene) for scene in scenes])
    low, high = floors[:, 0].min(axis=0), floors[:, 1].max(axis=0)
    # Top face 2 cm below y = 0, so that objects on the floor do not z-fight with it.
    outline = scenes[0].floor_m if len(scenes) == 1 else None
    floor = slab(rectangle(low, high) if outline is None else outline, -0.04, -0.02)
    meshes = [floor, *(mesh for scene in scenes for mesh in scene_meshes(scene))]
    return _fitted(meshes, image_size, floor)


def _fitted(
    meshes: Sequence[Mesh],
    image_size: tuple[int, int],
    floor: Mesh,
    walls: tuple[Mesh, ...] = (),
) -> CornerView:
    """The view into which these meshes just fit; the camera is two diagonals away."""
    points = np.concatenate([mesh.vertices_m for mesh in meshes])
    target, diagonal = (points.min(0) + points.max(0)) / 2, np.linalg.norm(np.ptp(points, axis=0))
    world_to_camera = look_at(target + 2 * diagonal * DIRECTION, target)
    x, y, z = world_to_camera[:3, :3] @ points.T + world_to_camera[:3, 3:]
    across, down = x / z, y / z
    height, width = image_size
    focal = 0.96 * min(width / np.ptp(across), height / np.ptp(down))  # a margin of 4%
    x_px, y_px = (
        side / 2 - focal * (seen.min() + seen.max()) / 2
        for side, seen in ((width, across), (height, down))
    )
    intrinsics = np.array([[focal, 0, x_px], [0, focal, y_px], [0, 0, 1]])
    return CornerView(Pinhole(world_to_camera, intrinsics), image_size, floor, walls)


def perspective(
    scene: Scene,
    image_size: tuple[int, int] = (360, 480),
    view: CornerView | None = None,
    colors: UInt8[np.ndarray, "objects 3"] | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a room with soft shadows, seen from outside and above a corner. Report pages show these
    pictures; no metric uses them.

    If `view` is None, `view_of` fits one of `image_size` to the room; with a common view, pictures
    of several rooms can be compared. If `colors` is None, objects have their classes' colours.
    """
    view = view or view_of(scene, image_size)
    colors = object_colors(scene) if colors is None else colors
    walls = [WALL_COLOR] * len(view.walls)
    colors = np.concatenate([colors, [FLOOR_COLOR], *([walls] if walls else [])]).astype(np.uint8)
    meshes = [*scene_meshes(scene), view.floor, *view.walls]
    # Walls cast no shadows: they would darken the whole room.
    shadowed = len(meshes) - len(walls)
    return SoftwareRenderer().shaded(
        meshes, colors, view.camera, view.image_size, BACKGROUND, shadowed
    )


def html_of(scene: Scene) -> str:
    """HTML for notebooks: a picture of the scene and its number of objects per class.

    >>> "no objects" in html_of(Scene("empty", "front3d_bedroom"))
    True
    """
    picture = base64.b64encode(png_bytes(perspective(scene))).decode()
    return (
        f'<figure><img src="data:image/png;base64,{picture}" alt="a room">'
        f"<figcaption>{html.escape(f'{scene.name}: {scene.contents}')}</figcaption></figure>"
    )


def show(scene: Scene) -> None:
    """Display a scene in a notebook, from any line of a cell; elsewhere an `InputError`."""
    notebook = sys.modules.get("IPython")
    if notebook is None or notebook.get_ipython() is None:
        raise InputError(
            "show() draws in a notebook, and this is none; save(scene, 'room.png') writes a "
            "picture, and 'room.glb' a model."
        )
    notebook.display.display(notebook.display.HTML(html_of(scene)))


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
    points = [mesh.vertices_m[:, [0, 2]] for mesh in scene_meshes(scene)]
    if scene.floor_m is not None:
        points.append(np.asarray(scene.floor_m, dtype=np.float64))
    every = np.concatenate(points) if points else np.zeros((1, 2))
    low, high = every.min(axis=0), every.max(axis=0)
    center = (low + high) / 2
    side_m = max(float((high - low).max()) / (1 - 2 * BORDER), LEAST_M)
    picture = Image.new("RGB", (PLAN_PX + LEGEND_PX, PLAN_PX), BACKGROUND)
    picture.paste(plan_of(scene, center, side_m))
    _legend(ImageDraw.Draw(picture), scene, PLAN_PX / side_m)
    return np.asarray(picture)


def plan_of(scene: Scene, center: Float[np.ndarray, "2"], side_m: float) -> Image.Image:
    """Draw the square of a room around `center` (x, z), without a legend, 512 x 512 pixels."""
    scale = PLAN_PX / side_m
    tops = [float(mesh.vertices_m[:, 1].max()) for mesh in scene_meshes(scene)]
    height_m = max(tops, default=0.0) + 1
    ids = _ids_from_above(scene, center, height_m, 1 / scale, (PLAN_PX, PLAN_PX))
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
    painted = Image.fromarray(paint_ids(ids, object_colors(scene), BACKGROUND))
    plan.paste(painted, mask=Image.fromarray(np.uint8(255) * (ids > 0)))
    return plan


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
