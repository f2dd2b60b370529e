"""Damages files of every format many times, in a process with limits, and tells what came of it."""

import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

MOST_BYTES = 6 << 30
"""Address space of the process; torch alone reserves some of it."""
MOST_RESIDENT = 2 << 30
SECONDS = 60
"""A case takes milliseconds; machines that tests share may be slow."""


class Outcome(NamedTuple):
    """Results of the mutations of a format."""

    read: int
    refused: int
    faults: list[str]
    """Errors that are not the package's own, hangs, and refusals that are no short sentence."""
    cpu_s: float
    slowest_s: float
    memory: int
    """Most bytes that were resident."""


class Hangs(BaseException):
    """A case takes too long."""


class Fuzzer:
    """A process that damages and reads files; it is started again if it ends."""

    def __init__(self) -> None:
        self._process: subprocess.Popen | None = None

    def run(self, name: str, count: int, seed: int) -> Outcome:
        """Read `count` mutations of a format."""
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, "-c", "import fuzzing; fuzzing.serve()"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"},
            )  # fmt: skip
        process = self._process
        assert process.stdin and process.stdout
        print(json.dumps([name, count, seed]), file=process.stdin, flush=True)
        ready, _, _ = select.select([process.stdout], [], [], SECONDS + count)
        answer = process.stdout.readline() if ready else ""
        if not answer:
            self.end()
            return Outcome(0, 0, [f"the process ended ({process.returncode}) or hung"], 0.0, 0.0, 0)
        return Outcome(*json.loads(answer))

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def serve() -> None:
    """Answer requests on standard input until it ends."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    warnings.simplefilter("ignore")
    for line in sys.stdin:
        with tempfile.TemporaryDirectory() as folder:
            try:
                found = outcome_of(*json.loads(line), Path(folder))
            except Exception:
                found = Outcome(0, 0, [f"no good file: {traceback.format_exc()}"], 0.0, 0.0, 0)
        print(json.dumps(found), file=out, flush=True)


def outcome_of(name: str, count: int, seed: int, folder: Path) -> Outcome:
    """Damage a good file `count` times, and read it each time."""
    from fuzzed_formats import FORMATS
    from mutating import damaged

    path, read, *other = FORMATS[name](folder)
    damage: Any = other[0] if other else damaged
    whole = path.read_bytes()
    read()  # a good file is read
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak of memory
    faults, refused, slowest, start = list[str](), 0, 0.0, time.process_time()
    for case in range(count):
        path.write_bytes(damage(path, whole, np.random.default_rng([seed, case])))
        begun = time.monotonic()
        said = _refusal(read)
        slowest = max(slowest, time.monotonic() - begun)
        refused += said is not None
        if said is not None and (said.startswith("RAW") or len(said) > 2500 or "\n" in said):
            faults.append(f"case {case}: {ascii(said)[:400]}")
    lines = Path("/proc/self/status").read_text().splitlines()
    held = next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))
    return Outcome(
        count - refused, refused - len(faults), faults, time.process_time() - start, slowest, held
    )


def _refusal(read: Any) -> str | None:
    from sceneprior.core.errors import InputError

    def too_long(*_: object) -> None:
        raise Hangs

    signal.signal(signal.SIGALRM, too_long)
    signal.alarm(SECONDS)
    try:
        read()
    except (InputError, FloatingPointError) as error:  # the loss is no number
        return str(error)
    except Exception as error:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        where = "" if trace is None else f" ({trace.tb_frame.f_code.co_qualname})"
        return f"RAW {type(error).__name__}{where}: {error}"
    except Hangs:
        return f"RAW: more than {SECONDS} s"
    finally:
        signal.alarm(0)
    return None
