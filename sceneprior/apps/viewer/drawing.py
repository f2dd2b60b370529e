"""The drawing of a floor plan in the browser: handles at corners, walls to click, doors to drag."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprior.apps.viewer.plan import Plan, Point
from sceneprior.core.shell import slab
from sceneprior.render.floor_plans import DOOR, WALL, WINDOW
from sceneprior.render.topdown import FLOOR_COLOR

if TYPE_CHECKING:
    import viser

HINT = (
    "Seen from above. Drag a dark point to move a corner; drag a light point to make a corner of "
    "it; click a dark point to remove it. Click near a wall to put a door or a window there; drag "
    "it along the walls; click it to remove it."
)
GROUND_M = 60.0
"""Side of the square around the plan that receives clicks."""
_GROUND, _CORNER, _MIDDLE = (250, 249, 246), (60, 70, 90), (160, 172, 196)
_LOW_M, _HIGH_M = 0.02, 0.06
"""Heights above the floor of lines and of handles."""


class Drawing:
    """The scene nodes of a plan, which is hidden until `show`.

    `changed` is called with the new plan after each change by a browser, except during a drag.
    """

    def __init__(self, server: "viser.ViserServer", changed: Callable[[Plan], None]):
        self._scene, self._changed = server.scene, changed
        self.plan: Plan | None = None
        self.kind = "door"
        """Kind of the opening that a click puts on a wall: door or window."""
        self._nodes: dict[str, Any] = {}
        self._dragged: int | None = None
        """Number of the corner that is being dragged."""
        self.frame = self._scene.add_frame("/plan", show_axes=False, visible=False)
        self._scene.add_grid(
            "/plan/grid", GROUND_M, GROUND_M, plane="xz", position=(0.0, -0.03, 0.0),
            cell_size=0.5, section_size=1.0, cell_color=(228, 226, 220),
            section_color=(206, 202, 192),
        )  # fmt: skip
        ground = self._scene.add_box(
            "/plan/ground", color=_GROUND, dimensions=(GROUND_M, 0.02, GROUND_M),
            position=(0, -0.05, 0), cast_shadow=False,
        )  # fmt: skip
        self._on_click(ground, self._with_opening)

    def show(self, plan: Plan | None) -> None:
        """Show a plan to draw on; None hides the drawing."""
        self.plan = plan
        self.frame.visible = plan is not None
        for node in self._nodes.values():
            node.remove()
        self._nodes.clear()
        if plan is not None:
            self._draw(plan)

    def _draw(self, plan: Plan) -> None:
        """All nodes of the plan."""
        self._draw_floor(plan)
        size_m = 0.022 * float(max(np.ptp(plan.outline_m, axis=0).max(), 3.0))
        for row, side in enumerate(plan.sides):
            self._handle(f"corner_{row}", side.start_m, size_m, _CORNER)
            self._handle(f"middle_{row}", (side.start_m + side.end_m) / 2, 0.8 * size_m, _MIDDLE)
        for row in range(len(plan.openings)):
            self._draw_opening(plan, row, 1.6 * size_m)

    def _draw_floor(self, plan: Plan) -> None:
        """The floor, its outline and the lengths of its sides."""
        mesh = slab(plan.outline_m, -0.02, 0.0)
        floor = self._scene.add_mesh_simple(
            "/plan/floor", mesh.vertices_m, mesh.faces, color=FLOOR_COLOR, flat_shading=True,
            cast_shadow=False,
        )  # fmt: skip
        self._on_click(floor, self._with_opening)
        ends = np.array([[side.start_m, side.end_m] for side in plan.sides])
        lines = self._scene.add_line_segments(
            "/plan/outline", np.insert(ends, 1, _LOW_M, axis=2), WALL, thickness=4,
            thickness_units="screen",
        )  # fmt: skip
        labels = []
        for row, side in enumerate(plan.sides):
            x, z = (side.start_m + side.end_m) / 2 - 0.3 * side.inward
            labels.append(
                self._scene.add_label(
                    f"/plan/length_{row}", f"{side.length_m:.2f} m", position=(x, _HIGH_M, z),
                    anchor="center-center",
                )
            )  # fmt: skip
        self._nodes |= {node.name: node for node in (floor, lines, *labels)}

    def _draw_opening(self, plan: Plan, row: int, deep_m: float) -> None:
        opening = plan.openings[row]
        start, end = plan.ends_m(opening)
        x, z = (start + end) / 2
        half = np.arctan2(start[1] - end[1], end[0] - start[0]) / 2
        node = self._scene.add_box(
            f"/plan/opening_{row}", color=DOOR if opening.kind == "door" else WINDOW,
            dimensions=(opening.width_m, 2 * _HIGH_M, deep_m), position=(x, _LOW_M, z),
            wxyz=(np.cos(half), 0.0, np.sin(half), 0.0), cast_shadow=False,
        )  # fmt: skip
        self._nodes[node.name] = node
        self._on_click(node, lambda plan, _: plan.without_opening(row))
        self._on_drag(node, lambda at, end: self._drag_opening(row, at, end))

    def _handle(
        self, name: str, at: np.ndarray, radius_m: float, color: tuple[int, int, int]
    ) -> None:
        node = self._scene.add_icosphere(
            f"/plan/{name}", radius=radius_m, color=color, position=(at[0], _HIGH_M, at[1]),
            cast_shadow=False,
        )  # fmt: skip
        self._nodes[node.name] = node
        kind, _, number = name.partition("_")
        row = int(number)
        self._on_drag(node, lambda at, end: self._drag_corner(kind, row, at, end))
        if kind == "corner":
            self._on_click(node, lambda plan, _: plan.without_corner(row))

    # -- Events: asynchronous callbacks keep their order, and changing a plan takes no time --------

    def _on_click(self, node: Any, changed: Callable[[Plan, Point], Plan]) -> None:
        @node.on_click
        async def _(event: Any) -> None:
            point = ground_point(event.ray_origin, event.ray_direction)
            if point is not None and self.plan is not None:
                self._change(changed(self.plan, point))

    def _on_drag(self, node: Any, task: Callable[[Point, bool], None]) -> None:
        @node.on_drag("left")
        async def _(event: Any) -> None:
            eye = event.client.camera.position
            point = ground_point(eye, np.array(event.end_position) - eye)
            if point is not None and self.plan is not None:
                task(point, event.phase == "end")

    def _change(self, plan: Plan) -> None:
        self.show(plan)
        self._changed(plan)

    def _with_opening(self, plan: Plan, at: Point) -> Plan:
        return plan.with_opening(self.kind, at)

    def _drag_corner(self, kind: str, row: int, at: Point, ends: bool) -> None:
        """Move a corner, or create one by dragging the middle of a side."""
        assert self.plan is not None, "a plan is shown"
        if self._dragged is None:
            if kind == "middle":
                grown = self.plan.with_corner(row, at)
                if grown is not self.plan:  # otherwise the new outline intersects itself
                    self.plan, self._dragged = grown, row + 1
            else:
                self._dragged = row
        elif (corner := self._dragged) is not None:
            self.plan = self.plan.with_moved(corner, at)
        if ends:
            self._dragged = None
            self._change(self.plan)
        elif self._dragged is not None:
            # Handles are kept until the drag ends: browsers drop the drag of a node that is sent
            # again.
            x, z = self.plan.corners[self._dragged]
            self._nodes[f"/plan/{kind}_{row}"].position = (x, _HIGH_M, z)
            self._draw_floor(self.plan)

    def _drag_opening(self, row: int, at: Point, ends: bool) -> None:
        assert self.plan is not None, "a plan is shown"
        self.plan = self.plan.with_opening_moved(row, at)
        if ends:
            self._change(self.plan)
        else:
            x, z = self.plan.ends_m(self.plan.openings[row]).mean(axis=0)
            self._nodes[f"/plan/opening_{row}"].position = (x, _LOW_M, z)


def ground_point(origin_m: Any, direction: Any) -> Point | None:
    """The point x, z of the floor that a ray hits, to the nearest millimetre.

    None if the ray misses the floor, or hits it outside the square of `GROUND_M`.
    """
    start, way = np.asarray(origin_m, dtype=np.float64), np.asarray(direction, dtype=np.float64)
    if start[1] * way[1] >= 0:
        return None
    x, _, z = (start - way * (start[1] / way[1])).round(3)
    return (float(x), float(z)) if max(abs(x), abs(z)) <= GROUND_M / 2 else None
