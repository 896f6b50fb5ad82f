"""Decisions after a worker process was lost: its replacement prepares itself while the others decide."""

import os
import signal
import time
from dataclasses import dataclass
from math import inf
from pathlib import Path

import pytest

from tests.reasoning.scenarios import MassScenario
from tests.reasoning.test_reasoner import make
from tests.rollout.scenarios import child_pids
from vtbdrake.reasoning import Belief, Budget
from vtbdrake.rollout import worker_processes

# So long a worker waits at the gate, at most, in s; so that a test that fails ends.
PATIENCE = 60.0


@dataclass
class GatedScenario(MassScenario):
    """A testbed whose workers cannot finish building it while the file ``gate`` exists; one that gives up tells."""

    gate: str = ""

    def add_world(self, builder):
        super().add_world(builder)
        end = time.monotonic() + PATIENCE
        while os.path.exists(self.gate) and time.monotonic() < end:
            time.sleep(0.01)
        if os.path.exists(self.gate):
            Path(f"{self.gate}.ignored").touch()


@pytest.fixture
def gated(tmp_path):
    """A belief, a reasoner with two warm workers, their process ids, and the gate for those to come, which is open."""
    scenario = GatedScenario(gate=str(tmp_path / "gate"))
    testbed = scenario.build()
    others = set(child_pids())
    with make(scenario, executor="processes", workers=2, budget=Budget(rollouts=6)) as reasoner:
        reasoner.warm_up()
        belief = Belief.perfect(testbed, testbed.default_context())
        yield belief, reasoner, lambda: set(child_pids()) - others, Path(scenario.gate)
    assert not Path(f"{scenario.gate}.ignored").exists(), "a decision has waited for a worker that was building"


@pytest.mark.slow
def test_after_a_killed_worker_the_other_one_decides(gated):
    belief, reasoner, workers, gate = gated
    expected = reasoner.decide(belief)
    first, second = workers()
    gate.touch()
    os.kill(first, signal.SIGKILL)
    decision = reasoner.decide(belief)
    assert (decision.values, decision.health.rollouts, decision.warnings) == (expected.values, 6, ())
    # Its replacement is under way, and there is one only.
    (replacement,) = workers() - {first, second}
    assert reasoner.decide(belief).values == expected.values
    assert workers() == {second, replacement}
    gate.unlink()
    # If none is left, the decision waits for the one that comes.
    os.kill(second, signal.SIGKILL)
    decision = reasoner.decide(belief)
    assert (decision.values, decision.warnings) == (expected.values, ())
    assert replacement in workers() and len(workers()) == 2
    # With a budget of wall time, no longer than that.
    gate.touch()
    for worker in workers():
        os.kill(worker, signal.SIGKILL)
        # It is dead before the decision begins, and nothing is sent to it; `WNOWAIT` leaves it to the executor.
        os.waitid(os.P_PID, worker, os.WEXITED | os.WNOWAIT)
    decision = reasoner.decide(belief, budget=Budget(seconds=0.1))
    assert not decision
    assert "not even of the plan in use" in decision.warnings[0]


def test_after_a_hung_worker_the_other_one_decides(gated, monkeypatch):
    monkeypatch.setattr(worker_processes, "GRACE", 3.0)  # s; the other one keeps to it on a computer that is busy.
    belief, reasoner, workers, gate = gated
    first, second = workers()
    gate.touch()
    os.kill(first, signal.SIGSTOP)
    # Some time after the end of its budget the worker is given up.
    assert reasoner.decide(belief, budget=Budget(seconds=0.1)).end == "time"
    assert first not in workers()
    decision = reasoner.decide(belief)
    assert (decision.health.rollouts, decision.warnings) == (6, ())
    assert second in workers()


@pytest.mark.slow
def test_after_an_interrupted_decision_new_workers_warm_up(gated, monkeypatch):
    belief, reasoner, workers, _ = gated
    run, before, calls = reasoner.executor.run, workers(), []

    def interrupted(*arguments, **options):
        results = run(*arguments, **options)
        os.kill(min(before), signal.SIGSTOP)  # Its rollout is under way when Ctrl-C comes.
        yield next(results)
        raise KeyboardInterrupt

    def recorded(task, points, *, start=None, cutoff=None):
        calls.append(cutoff.deadline)
        return run(task, points, start=start, cutoff=cutoff)

    monkeypatch.setattr(reasoner.executor, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reasoner.decide(belief)
    assert min(before) not in workers()
    monkeypatch.setattr(reasoner.executor, "run", recorded)
    assert reasoner.decide(belief, budget=Budget(seconds=1e4, rollouts=6)).health.rollouts == 6
    assert calls[0] == -inf < calls[1]  # The budget begins when both are warm.
    assert len(workers()) == 2
