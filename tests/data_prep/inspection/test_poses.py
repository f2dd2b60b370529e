"""Wrong cameras under right checksums: `inspect --verify` fails and names what is wrong.

The whole sentences are in tests/golden/data_prep/verified.json.
"""

import numpy as np
import pytest
from golden_values import hold
from mutations import KINDS, OPENGL, longer, mutated, scaled, swapped

from data_prep.inspection.causes import GIVEN
from data_prep.inspection.verify import agreement_of, evidence_of, verify

Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
WRONG = {
    "homes: inverted": {"poses": np.linalg.inv},
    "homes: opengl": {"poses": lambda poses: OPENGL @ poses},
    "homes: longer lens": {"lenses": longer(1.5)},
    "homes: next frames": {"poses": lambda poses: np.roll(poses, 1, axis=0)},
    "homes: z up": {"poses": lambda poses: poses @ Z_UP},
    "homes: larger": {"poses": scaled(1.3)},
    "homes: centimetres": {"poses": scaled(100)},
    "homes: two frames swapped in a room": {"poses": swapped, "rooms": 1},
    "scans: two frames swapped in a room": {"poses": swapped, "rooms": 1},
    "homes: one room inverted": {"poses": np.linalg.inv, "rooms": 1},
    "posed: 100 times": {"poses": scaled(100)},
    "posed: a tenth": {"poses": scaled(0.1)},
}


@pytest.fixture
def shards(made_once):
    """Kind of data -> a right folder of it, which tests only read."""
    return lambda kind: made_once(f"verified_{kind}", KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_right_cameras_pass(shards, kind):
    found = verify(shards(kind))
    assert found.problems == ()
    evidence = evidence_of(found.every)
    assert evidence.share(GIVEN) > 0.75 or evidence.spare < 12
    if kind != "posed":
        (tally,) = agreement_of(found.every).values()
        # Also masks that something hides in part, and those at the image's border.
        assert tally.masks > 2 * tally.whole > 0 and tally.share == 1.0


@pytest.mark.parametrize("name", WRONG)
def test_wrong_cameras_are_named(shards, name, tmp_path):
    folder = mutated(shards(name.partition(":")[0]), tmp_path / "wrong", **WRONG[name])
    said = list(verify(folder).problems)
    hold("verified", {name: said}, slack=0.02, tmp=tmp_path)
