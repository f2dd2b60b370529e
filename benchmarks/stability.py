"""Share of furniture that does not move in MuJoCo, as generated and after `make_stable`.

python benchmarks/stability.py procthor-bedroom procthor-living demo-bedroom --count 40 --seed 1
"""

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneprior.apps.api import load
from sceneprior.core.contact_resolution import make_stable
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metrics.physics import Settled, settle
from sceneprior.render.scene_files import load_scene_folder


def main() -> None:
    """Print a row for each prior, and the classes of objects that are not stable."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sources", nargs="+", help="names of priors, or folders of scenes")
    parser.add_argument("--count", type=int, default=40, help="rooms drawn from each prior")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for source in options.sources:
        rooms = _rooms(source, options.count, options.seed)
        start = time.perf_counter()
        standing = [make_stable(room) for room in rooms]
        seconds = (time.perf_counter() - start) / len(rooms)
        told = sum((each.changes for each in standing), Counter[str]())
        before = [settle(room) for room in rooms]
        after = [settle(each.scene) for each in standing]
        print(
            f"{source}: {sum(len(room.objects) for room in rooms)} objects, stable as generated "
            f"{_share(before):.3f}, standing {_share(after):.3f}; deepest overlap at the start "
            f"{1000 * max(one.penetration_m for one in after):.3f} mm; {dict(told)}; "
            f"{seconds:.3f} s a room to stand"
        )
        fallen = Counter(
            each.scene.objects[row].label
            for each, one in zip(standing, after, strict=True)
            for row in np.flatnonzero(~one.stable)
        )
        if fallen:
            print(f"  not stable: {dict(fallen)}")


def _rooms(source: str, count: int, seed: int) -> Sequence[Scene]:
    if Path(source).is_dir() and any(Path(source).glob("*.json")):
        return load_scene_folder(Path(source))[:count]
    return load(source).sample(count, seed)


def _share(found: Sequence[Settled]) -> float:
    return float(np.concatenate([one.stable for one in found]).mean())


if __name__ == "__main__":
    main()
