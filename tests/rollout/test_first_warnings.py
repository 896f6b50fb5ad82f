"""Threads whose rollouts bring Drake to a warning that it gives once, in a new process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 120.0

# A slow reader of Drake's messages: meanwhile, the other threads come to the same place.
PROGRAM = """
import logging, time
class Slow(logging.Handler):
    def emit(self, record):
        time.sleep(1.0)
        print(record.getMessage())
logging.getLogger("drake").addHandler(Slow())
from vtbdrake.rollout import RolloutTask, make_executor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake_diagrams.cube_toss import CubeTossScenario

scenario = CubeTossScenario()
task = RolloutTask(scenario=scenario, horizon=0.05)
testbed = scenario.build()
with make_executor("threads", testbed=testbed, rollouts=8, workers=4) as executor:
    results = run_rollouts(executor, task, [{}] * 8, progress=False)
print(*(result.end for result in results))
"""


def test_threads_do_not_wait_for_each_other_at_drakes_warnings() -> None:
    # Drake warns of a half space when the first contexts are made.
    command = [sys.executable, "-c", PROGRAM]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=True)
    warning, ends = ended.stdout.splitlines()
    assert "half spaces are not currently supported" in warning
    assert ends.split() == ["horizon"] * 8
