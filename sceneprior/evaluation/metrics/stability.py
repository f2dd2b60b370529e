"""Share of objects that stay where they are under gravity, simulated by MuJoCo."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import USED, Counts, metric
from sceneprior.render.scene_simulators import TIMESTEP_S, scene_to_mjcf

SECONDS = 5.0
MOVED_M, TURNED_RAD = 0.01, 0.1
"""Largest displacement and rotation of a stable object."""


@dataclass(frozen=True)
class Settled:
    """Motion of a scene's objects during a physics simulation, and how far they overlap at its
    start."""

    moved_m: Float[np.ndarray, " objects"]
    turned_rad: Float[np.ndarray, " objects"]
    penetration_m: float
    """Largest penetration depth of two objects, or of an object and the room, at the start."""

    @property
    def stable(self) -> Bool[np.ndarray, " objects"]:
        """True for objects that moved at most 1 cm and turned at most 0.1 rad."""
        return (self.moved_m <= MOVED_M) & (self.turned_rad <= TURNED_RAD)


def settle(scene: Scene, seconds: float = SECONDS) -> Settled:
    """Simulate a scene with gravity, in steps of 1 ms, as `scene_to_mjcf` describes it.

    Objects that hang are held in place and count as stable.

    Raises:
        InputError: `mujoco` is not installed.

    Source:
        The stability of nepfaff/SceneEval: 5 s, and an object is stable if it moved at most 1 cm
        and turned at most 0.1 rad. There, every object weighs 1 kg; here, masses are those of
        `core/colliders.py`.
    """
    mujoco = _mujoco()
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene))
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    depth = max((-float(contact.dist) for contact in state.contact), default=0.0)
    # Body 0 is the world; the objects follow in their order.
    bodies = slice(1, 1 + len(scene.objects))
    start, turned = state.xpos[bodies].copy(), state.xquat[bodies].copy()
    for _ in range(round(seconds / TIMESTEP_S)):
        mujoco.mj_step(model, state)
    moved = np.linalg.norm(state.xpos[bodies] - start, axis=1)
    alike = np.abs((state.xquat[bodies] * turned).sum(axis=1)).clip(max=1)
    return Settled(moved, 2 * np.arccos(alike), max(depth, 0.0))


@metric(
    "stable_share", "Stable for 5 s in MuJoCo, as generated", "share of objects", "higher", USED,
    needs="solids of the objects (--settle all divides meshes, a minute or two each)",
    protocol={
        "stability": f"{SECONDS:g} s of MuJoCo in the rooms as they are, without walls; "
        f"moved at most {MOVED_M} m, turned at most {TURNED_RAD} rad"
    },
)  # fmt: skip
def stable_count(scene: Scene) -> Counts:
    """Numbers of stable objects and of all objects of a scene, for `stable_share`."""
    stable = settle(scene).stable if scene.objects else np.zeros(0)
    return {"stable_share": (float(stable.sum()), float(len(stable)))}


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError:
        raise InputError(
            "Simulating rooms needs one more package: pip install 'sceneprior[sim]'."
        ) from None
    return mujoco
