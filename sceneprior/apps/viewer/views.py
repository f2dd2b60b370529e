"""Cameras of the page: from outside and from above the room, and a walker's inside it."""

import math
from typing import Literal

import numpy as np
from jaxtyping import Float

from sceneprior.core.cameras import framed
from sceneprior.core.scene import Scene
from sceneprior.core.shell import shell_of
from sceneprior.render.appearance import scene_meshes

View = Literal["From outside", "From above", "Walk in"]
VIEWS: tuple[View, ...] = ("From outside", "From above", "Walk in")
FOV_RAD = {"From outside": 0.75, "From above": 0.25, "Walk in": 1.2}
"""Vertical fields of view of the cameras."""
CORNER = np.array([-0.42, -0.62, -0.66])
"""Viewing direction from outside, as in the pictures of rooms."""
DOWN = np.array([0.0, -1.0, -0.001])
EYE_M, STEP_M = 1.6, 0.35
"""Height of a walker's eyes, and distance from the door or corner where the walker stands."""
PHONE = (600, 0.7)
"""Width in pixels and aspect ratio of the canvas below which the panel is a drawer over it."""
DRAWER = 0.46
"""Share of a phone's height that the drawer covers (as in page.css)."""
Camera = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
"""Eye and target of a camera, in metres."""


def overview(
    points_m: Float[np.ndarray, "points 3"], view: View, width_px: int, height_px: int
) -> Camera:
    """The camera that shows all points from outside or from above; on a phone, above the drawer."""
    direction = DOWN if view == "From above" else CORNER
    slope, aspect, share = math.tan(FOV_RAD[view] / 2), width_px / height_px, 1.0
    if width_px < PHONE[0] and aspect < PHONE[1]:
        share = 1 - DRAWER
    # The points are framed for the part of the canvas above the drawer. Its middle is above that of
    # the canvas, so the camera is moved down.
    eye, target = framed(points_m, direction, 2 * math.atan(slope * share), aspect / share)
    ahead = target - eye
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    up = np.cross(right / np.linalg.norm(right), ahead)  # as long as `ahead`
    down = slope * (1 - share) * up
    return eye - down, target - down


def walker(scene: Scene) -> Camera:
    """The camera of a walker, who stands in a door, or else in a corner, where there is most space,
    and looks across the room."""
    shell = shell_of(scene)
    middle, doors = shell.outline_m.mean(axis=0), list[np.ndarray]()
    for wall in shell.walls:
        for start, end, bottom, _ in wall.openings:
            if bottom < STEP_M:
                middle_m = wall.start_m + wall.direction * (start + end) / 2
                doors.append(middle_m + wall.inward * STEP_M)
    places = np.array(doors or shell.outline_m * 0.8 + middle * 0.2)
    apart = np.abs(places[:, None] - scene.centers_m[:, [0, 2]]) - scene.sizes_m[:, [0, 2]] / 2
    x, z = places[apart.max(axis=-1).min(axis=1, initial=math.inf).argmax()]
    return np.array([x, EYE_M, z]), np.array([middle[0], 1.1, middle[1]])


def room_points(scene: Scene, with_walls: bool) -> Float[np.ndarray, "points 3"]:
    """Vertices of the furniture, and corners of the floor and of the tops of the walls."""
    shell, points = shell_of(scene), [mesh.vertices_m for mesh in scene_meshes(scene)]
    for height_m in (0.0, shell.height_m)[: 1 + with_walls]:
        points.append(np.insert(shell.outline_m, 1, height_m, axis=1))
    return np.concatenate(points)
