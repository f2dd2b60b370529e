"""Pictures of scenes: straight from above, as scores compare them, and from above a corner."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float, UInt8

from sceneprior.classes import class_colors, label_set
from sceneprior.errors import InputError
from sceneprior.geometry.corners import box_corners
from sceneprior.offscreen import Orthographic, Pinhole, Renderer
from sceneprior.scene import Mesh, Scene

BACKGROUND = (255, 255, 255)
"""White: no class colour comes near it, and a page prints it as paper."""


@dataclass(frozen=True)
class TopDownProtocol:
    """Everything that decides what a top-down picture shows."""

    image_size: tuple[int, int] = (512, 512)
    """(height, width) in pixels, as in the paper."""
    window_m: float = 6.4
    """Width and height of the square of floor in the picture; what lies beyond is cut."""
    camera_height_m: float = 10.0
    """The camera's height over the floor; nothing above it is seen."""
    background: tuple[int, int, int] = BACKGROUND
    """RGB where there is no object. The floor is not drawn: a generated room has none."""

    @property
    def metres_per_pixel(self) -> float:
        """Side of the square that a pixel covers."""
        return self.window_m / self.image_size[1]

    def as_dict(self) -> dict[str, object]:
        """The protocol as it stands in a result file."""
        return {**asdict(self), "metres_per_pixel": self.metres_per_pixel}


_WINDOWS_M = {"front3d_bedroom": 6.4, "front3d_living": 12.8, "scannet": 12.8}


def topdown_protocol(label_set_name: str) -> TopDownProtocol:
    """The protocol of a label set: 12.5 mm a pixel for bedrooms, 25 mm for the other sets.

    The windows hold the largest rooms that ATISS's filter lets through (6 x 6 m bedrooms,
    12 x 12 m living rooms). The user's label sets have the larger one.

    Raises:
        InputError: no label set has this name.
    """
    label_set(label_set_name)
    return TopDownProtocol(window_m=_WINDOWS_M.get(label_set_name, 12.8))


def box_mesh(center_m: Sequence[float], size_m: Sequence[float]) -> Mesh:
    """The box itself as 12 triangles that face outwards."""
    faces = np.array(
        [
            [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
            [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
        ]
    )  # fmt: skip
    return Mesh(box_corners(np.asarray(center_m), np.asarray(size_m)), faces)


def scene_meshes(scene: Scene) -> list[Mesh]:
    """One mesh per object; an object without a mesh is drawn as its box."""
    return [
        item.mesh if item.mesh is not None else box_mesh(item.center_m, item.size_m)
        for item in scene.objects
    ]


def object_colors(scene: Scene) -> UInt8[np.ndarray, "objects 3"]:
    """The flat RGB class colour of each object."""
    return class_colors(len(label_set(scene.label_set)))[scene.class_indices]


def topdown(
    scene: Scene,
    renderer: Renderer,
    protocol: TopDownProtocol | None = None,
    outlines: bool = False,
) -> UInt8[np.ndarray, "height width 3"]:
    """Look straight down on a room: one flat colour per class, exact, without shading.

    Image right is +x, image down is +z, the room's origin is the centre of the image, and
    what is nearest to the ceiling wins.

    Args:
        scene: The room; its floor is not drawn.
        protocol: None takes the one of the scene's label set.
        outlines: Darken the border between two objects: for people, never for scores.

    Source:
        The paper, section 4.2: 512 x 512, orthographic, a colour per category.
    """
    protocol = protocol or topdown_protocol(scene.label_set)
    ids = _instance_ids(scene, renderer, protocol)
    palette = np.concatenate([[protocol.background], object_colors(scene)]).astype(np.uint8)
    image = palette[ids]
    if outlines:
        border = np.zeros(ids.shape, dtype=bool)
        border[:, 1:] |= ids[:, 1:] != ids[:, :-1]
        border[1:] |= ids[1:] != ids[:-1]
        image[border] = image[border] // 2
    return image


def _instance_ids(scene: Scene, renderer: Renderer, protocol: TopDownProtocol) -> np.ndarray:
    if not scene.objects:
        return np.zeros(protocol.image_size, dtype=np.uint16)
    height = protocol.camera_height_m
    world_to_camera = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, height], [0, 0, 0, 1]])
    camera = Orthographic(world_to_camera, protocol.metres_per_pixel)
    return renderer.instance_ids(scene_meshes(scene), camera, protocol.image_size)


def look_at(
    eye_m: Float[np.ndarray, "3"], target_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """`world_to_camera` of a camera at `eye_m` that looks at `target_m`, y up in the image.

    Raises:
        InputError: the camera would look straight up or down, or the points coincide.
    """
    forward = target_m - eye_m
    right = np.cross(forward, [0.0, 1.0, 0.0])
    if np.linalg.norm(right) < 1e-9:
        raise InputError(
            f"A camera at {eye_m.tolist()} cannot look at {target_m.tolist()} with y up; "
            "move one of the points sideways."
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye_m
    return matrix


@dataclass(frozen=True)
class CornerView:
    """Where `perspective` looks from, and the floor it draws."""

    camera: Pinhole
    image_size: tuple[int, int]
    floor: Mesh


def corner_view(scenes: Sequence[Scene], image_size: tuple[int, int] = (360, 480)) -> CornerView:
    """From above a corner, outside: one view into which all these rooms just fit.

    The camera stands two diagonals away. The floor is the rectangle around the known outlines,
    or, where they are not known, around the objects.

    Args:
        scenes: At least one room.
        image_size: (height, width) in pixels.
    """
    floors = np.array([_floor_rectangle(scene) for scene in scenes])
    low, high = floors[:, 0].min(axis=0), floors[:, 1].max(axis=0)
    # 2 cm below y = 0, so that feet that stand on the floor do not flicker into it.
    center = ((low[0] + high[0]) / 2, -0.03, (low[1] + high[1]) / 2)
    floor = box_mesh(center, (high[0] - low[0], 0.02, high[1] - low[1]))
    meshes = [floor, *(mesh for scene in scenes for mesh in scene_meshes(scene))]
    points = np.concatenate([mesh.vertices_m for mesh in meshes])
    target, diagonal = (points.min(0) + points.max(0)) / 2, np.linalg.norm(np.ptp(points, axis=0))
    direction = np.array([0.42, 0.62, 0.66])  # of length 1.0
    world_to_camera = look_at(target + 2 * diagonal * direction, target)
    x, y, z = world_to_camera[:3, :3] @ points.T + world_to_camera[:3, 3:]
    across, down = x / z, y / z
    height, width = image_size
    focal = 0.96 * min(width / np.ptp(across), height / np.ptp(down))  # 4% of air around it
    intrinsics = np.array(
        [
            [focal, 0, width / 2 - focal * (across.min() + across.max()) / 2],
            [0, focal, height / 2 - focal * (down.min() + down.max()) / 2],
            [0, 0, 1],
        ]
    )
    return CornerView(Pinhole(world_to_camera, intrinsics), image_size, floor)


def perspective(
    scene: Scene,
    renderer: Renderer,
    image_size: tuple[int, int] = (360, 480),
    view: CornerView | None = None,
    colors: UInt8[np.ndarray, "objects 3"] | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """A shaded picture from above a corner, outside the room: for pages, not for scores.

    Args:
        image_size: (height, width) in pixels, where no view is given.
        view: None takes the room's own; one view for several rooms lets them be compared.
        colors: Of the objects; None takes those of their classes.
    """
    view = view or corner_view([scene], image_size)
    colors = object_colors(scene) if colors is None else colors
    colors = np.concatenate([colors, [[232, 228, 220]]]).astype(np.uint8)
    meshes = [*scene_meshes(scene), view.floor]
    return renderer.shaded(meshes, colors, view.camera, view.image_size, BACKGROUND)


def _floor_rectangle(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    if scene.floor_m is not None and len(scene.floor_m):
        outline = np.asarray(scene.floor_m, dtype=np.float64)
        return outline.min(0), outline.max(0)
    if not scene.objects:
        return np.array([-1.5, -1.5]), np.array([1.5, 1.5])
    flat, half = scene.centers_m[:, [0, 2]], scene.sizes_m[:, [0, 2]] / 2
    return (flat - half).min(0) - 0.2, (flat + half).max(0) + 0.2
