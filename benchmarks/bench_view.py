"""Responsiveness of the viewer while dragging over the map (bench_startup.py times its start).

    python benchmarks/bench_view.py RUN [--rooms 200] [--json FILE]

Rooms are requested along a circle on the map, among the training rooms. `cold` and `warm` are
rounds without a browser, in which rooms are decoded, meshed and queued; the first round also
extracts the meshes of new shapes. `drag` is a third round over a websocket, with an event every
50 ms as from a browser's drag; it measures the rooms that arrive completely, and their delay. CPU
time is listed with the wall clock, since the two differ on a busy machine; the browser's drawing is
not included.
"""

import argparse
import json
import math
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
import torch
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from sceneprior.apps.api import load
from sceneprior.apps.viewer.explorer import Explorer
from sceneprior.apps.viewer.page import Page
from sceneprior.apps.viewer.server import serving

EVENT_S = 0.05
"""Shortest interval between the drag events of a browser."""
RADIUS = 0.35
"""Radius of the circle, relative to the side of the map."""


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    options.add_argument("run", help="run or prior, as for `sceneprior view`")
    options.add_argument("--rooms", type=int, default=200, help="rooms along the circle, per round")
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    measured: dict[str, Any] = {"cores": os.cpu_count(), "load": os.getloadavg()[0]}
    torch.set_num_threads(1)  # as in `sceneprior view`
    explorer = Explorer(load(given.run))
    with serving("127.0.0.1", 0) as server:
        page = Page(server, explorer)
        assert explorer.map is not None, "the run has training rooms"
        middle, side = explorer.map.middle, RADIUS * explorer.map.side
        points = [
            (middle[0] + side * math.cos(angle), middle[1] + side * math.sin(angle))
            for angle in (2 * math.pi * k / given.rooms for k in range(given.rooms))
        ]

        def go_round() -> None:
            for point in points:
                page.show(explorer.at(page.shown, point), settled=False)

        measured["cold"] = timed(go_round, given.rooms)
        measured["warm"] = timed(go_round, given.rooms)
        measured["drag"] = dragged(page, points)
    print(json.dumps(measured, indent=1))
    if given.json:
        given.json.write_text(json.dumps(measured, indent=1) + "\n")


def timed(task: Callable[[], None], rooms: int) -> dict[str, float]:
    """Rates of a task that shows `rooms` rooms."""
    wall, cpu = time.perf_counter(), time.process_time()
    task()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "rooms_per_s": round(rooms / wall, 1),
        "rooms_per_cpu_s": round(rooms / cpu, 1),
        "cpu_ms": round(1000 * cpu / rooms, 1),
    }


def dragged(page: Page, points: list[tuple[float, float]]) -> dict[str, float]:
    """Rates and delays of rooms that arrive at a client while it drags over the board."""
    assert page.board is not None, "the run has a map"
    eye = (0.0, 8.0, 10.0)
    camera = {
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": eye, "fov": 0.75,
        "near": 0.01, "far": 1000.0, "image_height": 720, "image_width": 960,
        "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 1.0, 0.0),
    }  # fmt: skip
    target = page.board.in_scene(page.board.on_board(torch.tensor(points))).tolist()
    came: list[tuple[float, str, int]] = []
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    url = f"ws://127.0.0.1:{page.server.get_port()}"
    with connect(url, subprotocols=[protocol], max_size=None, compression=None) as client:
        reader = threading.Thread(target=_read, args=(client, came), daemon=True)
        reader.start()
        client.send(msgspec.msgpack.encode(camera))
        while not page.server.get_clients():
            time.sleep(0.01)
        time.sleep(1)  # until the initial messages have arrived
        came.clear()
        sent, cpu, start = {}, time.process_time(), time.perf_counter()
        for number, (point, place) in enumerate(zip(target, points, strict=True)):
            drag = {
                "type": "SceneNodeDragMessage", "name": "/map/board", "instance_index": None,
                "phase": "update" if number else "start", "start_position": target[0],
                "start_screen_pos": (0.5, 0.5), "end_position": point,
                "end_screen_pos": (0.5, 0.5), "button": "left", "modifier": None, "owner": "",
            }  # fmt: skip
            sent[place] = time.perf_counter()
            client.send(msgspec.msgpack.encode(drag))
            time.sleep(max(0.0, start + EVENT_S * (number + 1) - time.perf_counter()))
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        time.sleep(1)
    assert came, "rooms arrive"
    late = []
    for at, said, _ in came:
        if said:
            x, y = map(float, said.split(","))
            late.append(at - sent[min(sent, key=lambda point: math.dist(point, (x, y)))])
    return {
        "events_per_s": round(len(points) / wall, 1),
        "rooms_per_s": round(len(late) / wall, 1),
        "cpu_ms": round(1000 * cpu / len(late), 1),
        "median_delay_ms": round(1000 * median(late)),
        "kb_per_room": round(sum(size for *_, size in came) / len(late) / 1000, 1),
    }


def _read(client: ClientConnection, came: list[tuple[float, str, int]]) -> None:
    """Record each message's arrival time, room text (if any) and size in bytes."""
    unpack = zstandard.ZstdDecompressor()
    for data in client:
        assert isinstance(data, bytes)
        packed = int.from_bytes(data[8:16], "little")
        window = msgspec.msgpack.decode(unpack.decompress(data[16 : 16 + packed]))
        words = [text for m in window["messages"] for text in m.get("updates", {}).values()]
        said = re.findall(r"<b>map ([-+.\d]+, [-+.\d]+)</b>", " ".join(map(str, words)))
        came.append((time.perf_counter(), said[-1] if said else "", len(data)))


if __name__ == "__main__":
    main()
