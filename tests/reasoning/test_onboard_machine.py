"""A DPS that reasons on the machine: beside its loop, in processes of its own, recorded and replayed."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.cli.program import run
from tests.cli.test_run import PATIENCE, start
from tests.control.scripted import ScriptedBridge
from tests.monitoring.residuals.line import Together
from tests.reasoning.pusher import PLANNER, STATE, PusherScenario
from vtbdrake.control.clock import SimulatedClock, WallClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import Machine, MachineConfig, MachineProcess
from vtbdrake.monitoring.residuals import ResidualConfig, ResidualMonitor
from vtbdrake.recording import read_log
from vtbdrake.recording.replay import replay
from vtbdrake.testbed import DpsAlone

PERIOD = 0.01
PUSHER = "tests.reasoning.pusher:PusherScenario"


def children(pid: int) -> list[int]:
    """Return the processes that this one has started."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:  # It has ended.
                continue
            if parent == pid:
                found.append(int(entry.name))
    return found


class Loop:
    """The DPS alone in its loop on a simulated clock, with a mass that stands still."""

    def __init__(self, scenario):
        self.target = DpsAlone(scenario)
        clock = SimulatedClock()
        bridge = ScriptedBridge(scenario.interface(), clock, lambda t: {"state": [0.1, -0.3]})
        self.before = set(children(os.getpid()))
        self.runtime = Runtime(self.target, bridge, period=PERIOD, clock=clock)
        self.runtime.cycle()
        self.runtime.switch("real")
        self.runtime.write({"u.goal": 0.4})

    def __enter__(self):
        assert self.wait()
        return self

    def __exit__(self, *_):
        self.runtime.close()

    @property
    def counts(self):
        return self.runtime.slow_parts.statistics[PLANNER]

    @property
    def worker(self):
        """The process that reasons."""
        (supervisor,) = set(children(os.getpid())) - self.before
        (worker,) = children(supervisor)
        return worker

    def wait(self):
        return self.runtime.slow_parts.wait(60.0)

    def ask(self, request):
        self.runtime.write({"u.request": request})
        self.runtime.run(cycles=1)

    def run_patiently(self, cycles):
        self.runtime.run(cycles=cycles, until=lambda: not self.wait())

    def read(self, name):
        return self.target.read(self.runtime.context, f"{PLANNER}.{name}")


def test_it_decides_beside_the_loop_as_in_a_simulation():
    # The time of a decision is not what ends it.
    scenario = PusherScenario(rollouts=6, latency=0.5, waits=True)
    with Loop(scenario) as real:
        assert os.getpriority(os.PRIO_PROCESS, real.worker) >= 5
        real.ask(1.0)
        real.run_patiently(60)
        assert (real.counts.results, real.counts.missed) == (1, 0)
        shown = [real.read(name) for name in ("decision", "quality", "rollouts", "valid")]
    target = DpsAlone(scenario)
    context = target.default_context()
    target.diagram.GetInputPort("real.sense.state").FixValue(context, [0.1, -0.3])
    simulator = target.simulator(context)
    target.write(context, {"u.goal": 0.4})
    target.write(context, {"u.request": 1.0})
    simulator.AdvanceTo(0.6)
    assert shown == [target.read(context, f"{PLANNER}.{name}") for name in ("decision", "quality", "rollouts", "valid")]


@pytest.mark.slow
def test_latency_of_three_periods_is_enough() -> None:
    scenario = PusherScenario(rollouts=100_000, latency=0.3)
    clock = WallClock()
    bridge = ScriptedBridge(scenario.interface(), clock, lambda t: {"state": [0.1, -0.3]})
    with Runtime(DpsAlone(scenario), bridge, period=0.1, clock=clock) as runtime:
        runtime.run(cycles=1)
        runtime.switch("real")
        assert runtime.slow_parts.wait(60.0)
        # A computer that is busy may take longer, but not each time.
        request = 0.0
        while not runtime.slow_parts.statistics[PLANNER].results:
            assert runtime.slow_parts.wait(60.0)
            request += 1.0
            runtime.write({"u.request": request})
            runtime.run(cycles=5)
        assert runtime.target.read(runtime.context, f"{PLANNER}.taken") == request


@pytest.mark.slow
def test_alarm_of_the_residuals_asks_for_a_decision() -> None:
    scenario = PusherScenario(rollouts=6, latency=0.5, waits=True)
    machine = Machine(scenario, MachineConfig(period=PERIOD))
    together = Together(scenario, machine, values={"u.goal": 0.4})
    runtime = together.driver
    config = ResidualConfig(period=PERIOD, tolerance={"sense.state": 1e-3})

    def ask(cycle: Cycle) -> None:
        if monitor.alarms:
            runtime.request(partial(runtime.write, {"u.request": float(len(monitor.alarms))}))

    with runtime, ResidualMonitor(runtime, "twin", config=config, worker=False) as monitor:
        runtime.watch(ask)
        assert runtime.slow_parts.wait(60.0)
        together.run(200)
        assert runtime.target.read(runtime.context, f"{PLANNER}.taken") == 0.0 and not monitor.alarms
        machine.write({STATE: [0.3, 0.0]})  # A push that the model does not know.
        for _ in range(200):
            together.run(1)
            assert runtime.slow_parts.wait(60.0)
        read = {name: runtime.target.read(runtime.context, f"{PLANNER}.{name}") for name in ("taken", "valid")}
    assert monitor.alarms and read["taken"] >= 1.0 and read["valid"] == 1.0


@pytest.mark.slow
def test_worker_that_is_killed_while_it_thinks_is_a_missing_decision():
    with Loop(PusherScenario(rollouts=100_000, latency=0.5)) as real:
        worker = real.worker
        real.ask(1.0)
        os.kill(worker, signal.SIGKILL)
        while not real.counts.restarts:
            real.runtime.run(cycles=1)
        # The loop goes on, and the plan stays.
        real.runtime.run(cycles=60)
        assert (real.counts.missed, real.read("missed"), real.read("valid")) == (1, 1.0, 0.0)
        assert real.read("decision") == 0.0 and not real.runtime.guards.latched
        request = 1.0
        while not real.counts.results:
            request += 1.0
            assert real.wait()
            real.ask(request)
            real.run_patiently(60)
        assert (real.read("valid"), real.read("taken")) == (1.0, request)
        # The time is over long before the rollouts are.
        assert 1.0 <= real.read("rollouts") < 100_000.0
        assert real.worker != worker


@pytest.mark.slow
def test_dps_that_reasons_decides_acts_and_is_replayed(tmp_path: Path) -> None:
    log_file, options = tmp_path / "pusher.lcm", ("--field", "latency=0.5", "--set", "u.goal=0.4")
    with (
        Hub(port=0) as hub,
        MachineProcess(PusherScenario(), hub.url),
        start(PUSHER, "--url", hub.url, "--record", log_file, *options) as program,
    ):
        patience = ("--url", hub.url, "--timeout", PATIENCE)
        assert program.stderr is not None
        assert any("the DPS commands" in line for line in program.stderr)

        def read(name: str) -> float:
            return float(run("get", f"{PLANNER}.{name}", *patience).stdout.split("=")[1])

        # Decisions are missing while the reasoner starts, and may be on a computer that is busy; or it has time for the
        # plan in use alone, which is to stay.
        request, answers = 0, None
        while not read("decision"):
            if answers != (answers := (read("missed"), read("sampled_at"))):
                request += 1
                run("set", f"u.request={request}", *patience)
        run("watch", "dps.law.force", "--every", 100, "--count", 12, *patience)
        program.send_signal(signal.SIGTERM)
        _, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, errors
    log = read_log(log_file)
    results = [(i, change.values[PLANNER]) for i, change in log.changes if change.kind == "result"]
    first, decision = next((i, values["decision"]) for i, values in results if values.get("decision"))
    force = log.actuation["force"][:, 0]
    # The mass is at rest at the origin until the decision acts: then its spring pulls.
    assert np.nanmax(np.abs(force[:first])) < 1e-9 < 0.1 < np.abs(force[first:]).max()
    np.testing.assert_allclose(force[first:][np.abs(force[first:]) > 1e-9][:1], 9.0 * decision)
    report = replay(log)
    assert report.identical and report.digests > 0, report
