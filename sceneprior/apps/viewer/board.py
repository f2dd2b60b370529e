"""The map of the latent space as a board in the 3D scene, for clicks and drags."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.apps.viewer.latent_map import LatentMap

if TYPE_CHECKING:
    import viser

LEAN_RAD = math.radians(40)
"""Tilt of the board, about the elevation of the page's initial camera."""
_BOARD, _DOT, _PATH, _HERE = (244, 243, 238), (70, 92, 140), (214, 110, 30), (200, 30, 60)

Point = tuple[float, float]


@dataclass(frozen=True)
class BoardPlane:
    """The pose of the square board, and conversions between it and the map."""

    latent_map: LatentMap
    center_m: tuple[float, float, float]
    side_m: float

    @property
    def wxyz(self) -> tuple[float, float, float, float]:
        """Orientation quaternion of the board; its normal, z, is tilted up from the room's z."""
        return (math.cos(LEAN_RAD / 2), -math.sin(LEAN_RAD / 2), 0.0, 0.0)

    def on_board(self, places: Float[Tensor, "n 2"], above_m: float) -> Float[np.ndarray, "n 3"]:
        """Points of the map in the board's frame, `above_m` above its face."""
        latent_map = self.latent_map
        middle = torch.tensor(latent_map.middle, dtype=places.dtype)
        flat = ((places - middle) / latent_map.side * self.side_m).double().numpy()
        return np.hstack([flat, np.full((len(flat), 1), above_m)])

    @property
    def _turn(self) -> Float[np.ndarray, "3 3"]:
        cos, sin = math.cos(LEAN_RAD), math.sin(LEAN_RAD)
        return np.array([[1.0, 0, 0], [0, cos, sin], [0, -sin, cos]])

    def in_scene(self, places: Float[Tensor, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Points of the map in scene coordinates, on the board's face."""
        return self.on_board(places, 0.0) @ self._turn.T + np.array(self.center_m)

    def corners_m(self) -> Float[np.ndarray, "4 3"]:
        """Corners of the board in scene coordinates."""
        half = self.side_m / 2
        flat = np.array([[x, y, 0.0] for x in (-half, half) for y in (-half, half)])
        return flat @ self._turn.T + np.array(self.center_m)

    def hit(self, origin_m: Any, direction: Any) -> Point | None:
        """The map point hit by a ray of the scene, clamped to the board's edge.

        None if the ray is parallel to the board or points away from it.
        """
        start = (np.asarray(origin_m, dtype=np.float64) - np.array(self.center_m)) @ self._turn
        way = np.asarray(direction, dtype=np.float64) @ self._turn
        if start[2] * way[2] >= 0:
            return None
        flat = (start - way * (start[2] / way[2]))[:2] / self.side_m
        x, y = flat.clip(-0.5, 0.5) * self.latent_map.side + np.array(self.latent_map.middle)
        return (float(x), float(y))


class Board:
    """The scene nodes of the board.

    `pointed` is called with a map point and the kind of event: `click`, `drag`, or `end` of a drag.
    """

    def __init__(
        self, server: "viser.ViserServer", plane: BoardPlane, pointed: Callable[[Point, str], None]
    ):
        self.plane, self._scene = plane, server.scene
        side, rooms = plane.side_m, plane.latent_map.rooms
        self.frame = self._scene.add_frame(
            "/map", show_axes=False, wxyz=plane.wxyz, position=plane.center_m
        )
        face = self._scene.add_box(
            "/map/board", color=_BOARD, dimensions=(side, side, 0.02), position=(0, 0, -0.01)
        )
        # Dots are spheres, raised so that they do not intersect the board's face.
        dots = plane.on_board(rooms, 0.02 * side)
        self._scene.add_point_cloud(
            "/map/rooms", dots, np.array(_DOT), point_size=0.014 * side, point_shape="circle",
            point_shading="flat", precision="float32",
        )  # fmt: skip
        self._here = self._scene.add_icosphere(
            "/map/here", radius=0.022 * side, color=_HERE, visible=False
        )
        self._scene.add_label(
            "/map/name", f"latent space: {len(rooms)} training rooms", anchor="bottom-center",
            position=(0, side / 2 + 0.05, 0),
        )  # fmt: skip

        @face.on_click
        async def _(event: Any) -> None:
            if (point := plane.hit(event.ray_origin, event.ray_direction)) is not None:
                pointed(point, "click")

        # Asynchronous callbacks keep events in order; the work is done in a thread.
        @face.on_drag("left")
        async def _(event: Any) -> None:
            eye = event.client.camera.position
            point = plane.hit(eye, np.array(event.end_position) - eye)
            if point is not None:
                pointed(point, "end" if event.phase == "end" else "drag")

    def mark(self, latent: np.ndarray | None) -> None:
        """Mark the point of a latent; None hides the mark."""
        self._here.visible = latent is not None
        if latent is not None:
            place = self.plane.latent_map.place(torch.from_numpy(latent).unsqueeze(0))
            self._here.position = self.plane.on_board(place, 0.02 * self.plane.side_m)[0]

    def draw_path(self, z: Float[Tensor, "steps dimension"]) -> None:
        """Draw the line of a path, in place of the previous one."""
        points = self.plane.on_board(self.plane.latent_map.place(z), 0.03 * self.plane.side_m)
        self._scene.add_line_segments(
            "/map/path", np.stack([points[:-1], points[1:]], axis=1), _PATH, thickness=3,
            thickness_units="screen",
        )  # fmt: skip
