"""A source of boxes that draws nothing: what a new data set has to bring, and what may go wrong."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from toy_rooms import LABEL_SET, make_toy_room

from data_prep.engine.source import Line, PreparedRoom, RoomTask, Survey
from sceneprior.core.errors import InputError
from sceneprior.core.parallel import run_tasks
from sceneprior.core.scene import Mesh

TRIANGLE = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.int32))


@dataclass(frozen=True)
class ToySource:
    """`rooms` rooms, one in five for testing; `trouble` says which of them misbehave, and how."""

    rooms: int = 10
    trouble: dict[int, str] = field(default_factory=dict)
    name: str = "toy"
    label_set: str = LABEL_SET
    room_type: str = "toys"
    draws: bool = False
    official: None = None
    only: str | None = None

    def settings(self, only: str | None) -> dict[str, Any]:
        return {"rooms": self.rooms}

    def survey(self) -> Survey:
        parts = run_tasks(_list, {"few": (0, 5), "others": (5, self.rooms)})
        ids = [room_id for part in parts for room_id in part]
        lost = [ids[k] for k, trouble in self.trouble.items() if trouble == "survey"]
        tasks = (
            RoomTask(room_id, "box", "test" if k % 5 == 4 else "train", extra={"number": k})
            for k, room_id in enumerate(ids)
            if room_id not in lost
        )
        failed = (Line(room_id, "box", "failed", reason="it is cut") for room_id in lost)
        odd = Line("box_x", "box", "filtered", "odd", "it is odd")
        return Survey(tuple(tasks), (odd, *failed))

    def prepare(self, task: RoomTask, renderer: Any) -> PreparedRoom | Line:
        assert renderer is None
        number = task.extra["number"]
        views, truth = make_toy_room(task.room_id, np.random.default_rng(number))
        made = PreparedRoom(views, truth, {"toy": TRIANGLE})
        match self.trouble.get(number):
            case None:
                return made
            case "filtered":
                return Line(task.room_id, task.house, "filtered", "light", "it is dark")
            case "sentence":
                raise InputError("its file is truncated")
            case "unforeseen":
                return {}["surprise"]
            case "unreadable":
                return open("/nowhere/at/all")  # noqa: PTH123
            case "shapes":
                return replace(made, views=replace(views, boxes=views.boxes[:1]))
            case "intrinsics":
                return replace(made, views=replace(views, intrinsics=views.intrinsics * np.nan))
            case "centers_m":
                return replace(made, truth=replace(truth, centers_m=truth.centers_m * np.nan))
        raise AssertionError


def _list(start: int, end: int) -> list[str]:
    return [f"box_{k}" for k in range(start, end)]
