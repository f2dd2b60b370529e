"""Time of short commands, from start to end.

    python benchmarks/bench_startup.py [--run demo-bedroom] [--rooms 1000] [--json FILE]

The commands are `help`, `import_torch` (a lower limit for the others), `synthesize` of 4 rooms and
of many, and `view` until it prints the page's address. Values are wall-clock and CPU seconds (user
and system), medians of 3 new processes. `synthesize_first` starts with an empty Numba cache, as
after an installation, and compiles the rendering kernels. On a busy machine, rely on CPU seconds.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from harness import children_cpu_s

REPEATS = 3
PORT = "8089"


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    options.add_argument("--run", default="demo-bedroom")
    options.add_argument("--rooms", type=int, default=1000, help="rooms of the large set")
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    measured: dict[str, object] = {"cores": os.cpu_count(), "load": os.getloadavg()[0]}

    def note(name: str, *arguments: str, **settings: bool) -> None:
        measured[name] = timed(*arguments, **settings)
        print(name, json.dumps(measured[name]), flush=True)

    make = ("-m", "sceneprior", "synthesize", "--run", given.run, "--out", "ROOMS", "-n")
    note("help", "-m", "sceneprior", "--help")
    note("import_torch", "-c", "import torch")
    note("synthesize", *make, "4")
    note("synthesize_first", *make, "4", new_kernels=True)
    note(f"synthesize_{given.rooms}", *make, str(given.rooms))
    note("view", "-m", "sceneprior", "view", given.run, "--port", PORT, until_said=True)
    if given.json:
        given.json.write_text(json.dumps(measured, indent=1) + "\n")


def timed(*arguments: str, new_kernels: bool = False, until_said: bool = False) -> dict[str, float]:
    """Median seconds of Python with these arguments, in which `ROOMS` is replaced by a new folder.

    `new_kernels` starts with an empty Numba cache; `until_said` stops at the first line of output.
    """
    walls, cpus = [], []
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, *(a.replace("ROOMS", f"{folder}/rooms") for a in arguments)]
            kernels = {"NUMBA_CACHE_DIR": f"{folder}/kernels"} if new_kernels else {}
            wall, cpu = time.perf_counter(), children_cpu_s()
            process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                env=os.environ | kernels,
            )  # fmt: skip
            assert process.stdout is not None
            if until_said:
                assert process.stdout.readline().startswith("Open http")
                walls.append(time.perf_counter() - wall)
                process.terminate()
                process.wait()
            else:
                process.communicate()
                assert process.returncode == 0, command
                walls.append(time.perf_counter() - wall)
            cpus.append(children_cpu_s() - cpu)
    return {"wall_s": round(median(walls), 2), "cpu_s": round(median(cpus), 2)}


if __name__ == "__main__":
    main()
