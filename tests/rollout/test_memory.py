"""Two and a half thousand rollouts take no more memory than one thousand."""

import os
from pathlib import Path

import pytest
from pydrake.systems.analysis import SimulatorConfig

from tests.rollout.scenarios import child_pids
from tests.testbeds import PendulumScenario
from vtbdrake.rollout import ProcessExecutor, Quality, RolloutTask, SerialExecutor, ThreadExecutor

THETA = "sim.sys.Pendulum.theta.position"
COARSE = SimulatorConfig(integration_scheme="explicit_euler", max_step_size=0.01, use_error_control=False)
TASK = RolloutTask(PendulumScenario(COARSE), 0.01, Quality(abs, THETA), sample_period=0.01)
# Bytes: two fifths of what the results would take if they were kept.
TOLERANCE = 1e6


def _resident(process):
    """Bytes of memory that a process holds."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _run(executor, count):
    """As a study does: a few points at a time."""
    for i in range(count // 10):
        for _ in executor.run(TASK, [{THETA: 0.1 * j + 1e-3 * i} for j in range(10)]):
            pass


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        SerialExecutor,
        pytest.param(lambda: ThreadExecutor(2), marks=pytest.mark.one_python),
        pytest.param(lambda: ProcessExecutor(2), marks=pytest.mark.one_python),
    ],
)
def test_memory_stays_flat_over_thousands_of_rollouts(make):
    others = set(child_pids())
    with make() as executor:
        _run(executor, 1000)
        processes = [os.getpid(), *(set(child_pids()) - others)]
        before = {process: _resident(process) for process in processes}
        _run(executor, 2500)
        growth = {process: _resident(process) - before[process] for process in processes}
    assert max(growth.values()) < TOLERANCE
