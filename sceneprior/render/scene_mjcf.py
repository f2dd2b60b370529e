"""Scenes as MuJoCo's MJCF: one body per object, convex geoms, z up, metres and kilograms."""

from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from jaxtyping import Float

from sceneprior.core.colliders import colliders, is_fixed, mass_kg, points_of, volume_and_centroid
from sceneprior.core.scene import Mesh, Scene, SceneObject, Solid
from sceneprior.core.shell import Panel, Shell, panels
from sceneprior.render.appearance import FLOOR_COLOR, WALL_COLOR, node_names, object_colors

TIMESTEP_S = 0.001
TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from the room frame (y up) to MuJoCo's axes (z up), for column vectors."""
WALL_OPACITY = 0.35
ROUND = 1e-3
"""Relative difference of a cylinder's widths up to which it counts as circular."""


def scene_to_mjcf(scene: Scene, shell: Shell | None = None) -> str:
    """The scene as the text of an MJCF file that needs no other files.

    Each object is a body at the centre of its box, named `<index>_<class>`, with a free joint
    unless it hangs (`is_fixed`). Its solids become geoms: boxes, cylinders and ellipsoids; domes,
    bowls and cylinders with an oval plan become meshes. The mass is that of `mass_kg`, divided
    among the geoms in proportion to their volumes. The floor is an infinite plane; the walls of
    `shell` are boxes around its doors and windows, half transparent, without a ceiling.
    """
    root = Element("mujoco", model=scene.name)
    SubElement(root, "compiler", angle="radian", autolimits="true")
    SubElement(root, "option", timestep=f"{TIMESTEP_S}", cone="elliptic", impratio="10")
    assets, world = SubElement(root, "asset"), SubElement(root, "worldbody")
    SubElement(world, "light", pos="0 0 6", dir="0 0 -1", diffuse="0.8 0.8 0.8")
    floor_color = _numbers(np.append(np.array(FLOOR_COLOR) / 255, 1))
    SubElement(world, "geom", name="floor", type="plane", size="20 20 0.1", rgba=floor_color)
    for node, item, color in zip(
        node_names(scene), scene.objects, object_colors(scene), strict=True
    ):
        _add_body(world, assets, node, item, color / 255)
    for row, wall in enumerate(shell.walls if shell else ()):
        for number, panel in enumerate(panels(wall, shell.height_m if shell else 0.0)):
            _add_panel(world, f"wall_{row}_{number}", panel)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_body(
    world: Element, assets: Element, name: str, item: SceneObject, color: Float[np.ndarray, "3"]
) -> None:
    center = np.asarray(item.center_m)
    body = SubElement(world, "body", name=name, pos=_numbers(TO_Z_UP @ center))
    if not is_fixed(item):
        SubElement(body, "freejoint")
    bodies = colliders(item)
    volumes = np.array([volume_and_centroid(each)[0] for each in bodies])
    masses = mass_kg(item) * volumes / volumes.sum()
    for number, (each, mass) in enumerate(zip(bodies, masses, strict=True)):
        shape = _shape(each, center, assets, f"{name}_{number}")
        geom = SubElement(body, "geom", shape, name=f"{name}_{number}")
        geom.attrib |= {"mass": f"{mass:.6g}", "rgba": _numbers(np.append(color, 1))}


def _add_panel(world: Element, name: str, panel: Panel) -> None:
    length, height, thickness = panel.size_m
    half = np.array([length, thickness, height]) / 2
    geom = SubElement(world, "geom", name=name, type="box", size=_numbers(half))
    color = np.append(np.array(WALL_COLOR) / 255, WALL_OPACITY)
    turn = np.array([0.0, 0.0, 1.0, panel.yaw_rad])
    geom.attrib |= {
        "pos": _numbers(TO_Z_UP @ panel.center_m), "axisangle": _numbers(turn),
        "rgba": _numbers(color),
    }  # fmt: skip


def _shape(
    body: Solid | Mesh, origin_m: Float[np.ndarray, "3"], assets: Element, name: str
) -> dict[str, str]:
    """Attributes of the geom of a body, at positions relative to `origin_m`."""
    if isinstance(body, Solid):
        low, high = np.array(body.low_m), np.array(body.high_m)
        half = (high - low) / 2
        at = {"pos": _numbers(TO_Z_UP @ ((low + high) / 2 - origin_m))}
        match body.kind:
            case "box" | "ellipsoid":
                return {**at, "type": body.kind, "size": _numbers(half[[0, 2, 1]])}
            case "cylinder" if abs(half[0] - half[2]) <= ROUND * half[0]:
                return {**at, "type": "cylinder", "size": _numbers(half[:2])}
    vertices = (points_of(body) - origin_m) @ TO_Z_UP.T
    SubElement(assets, "mesh", name=name, vertex=_numbers(vertices.ravel()))
    return {"type": "mesh", "mesh": name}


def _numbers(values: Float[np.ndarray, " numbers"]) -> str:
    return " ".join(f"{value:.6g}" for value in values)
