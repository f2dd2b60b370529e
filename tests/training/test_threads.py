"""Effect of the number of torch's threads: the last bits of gradients, and nothing else."""

import os
import subprocess
import sys


def test_threads_wait_without_spinning_unless_the_user_says_otherwise():
    say = [sys.executable, "-c", "import sceneprior, os; print(os.environ['OMP_WAIT_POLICY'])"]
    for own, wanted in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"} | own
        said = subprocess.run(say, capture_output=True, text=True, check=True, env=environment)
        assert said.stdout.strip() == wanted
