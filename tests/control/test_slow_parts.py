"""Slow parts beside the loop, in real processes: timing, exactness, and results that do not arrive."""

import os
import signal
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import ImageRgba8U

from tests.control.scripted import PERIOD, ScriptedBridge
from tests.control.slow import SlowScenario, busy, chaotic, deadly, gated, moving, picky, processes
from vtbdrake.common.child_process import ProcessStartError
from vtbdrake.common.frames import pack, unpack
from vtbdrake.control import slow_parts
from vtbdrake.control.background_process import BackgroundProcess
from vtbdrake.control.clock import SimulatedClock, WallClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.slow_parts import SlowParts
from vtbdrake.control.stepping import ChangeKind
from vtbdrake.control.supervisor import SupervisorMessage
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.state import snapshot as snapshots
from vtbdrake.testbed import DpsAlone, SlowPart

PATH = "dps.perception"
TIMEOUT = 60.0  # s; for a computer that is busy with other things
CONTINUITY = {"velocity": ("position", np.inf)}
PATIENT = {"memory": np.array([0.3, 0.6]), "patience": 1e4}  # The worker is never replaced.


class Loop:
    """The DPS alone in its loop, switched to real, with a slow part that is ready; keeps all cycles and states."""

    def __init__(self, scenario, clock, sensors):
        self.scenario = scenario
        self.target = DpsAlone(scenario)
        self.bridge = ScriptedBridge(scenario.interface(), clock, sensors)
        self.runtime = Runtime(self.target, self.bridge, period=PERIOD, clock=clock, continuity=CONTINUITY)
        self.cycles, self.states = [], []

    def begin(self):
        self.runtime.cycle()
        self.runtime.switch("real")
        assert self.wait()
        self.runtime.watch(self.keep)

    def keep(self, cycle):
        self.cycles.append(cycle)
        self.states.append(snapshot(self.target, self.runtime.context))

    @property
    def counts(self):
        return self.runtime.slow_parts.statistics[PATH]

    def wait(self):
        return self.runtime.slow_parts.wait(TIMEOUT)

    def run(self, cycles):
        """Run without waiting for the slow part."""
        self.runtime.run(cycles=cycles)

    def run_patiently(self, cycles):
        self.runtime.run(cycles=cycles, until=lambda: not self.wait())

    def read(self, name):
        return self.target.read(self.runtime.context, f"{PATH}.{name}")


@contextmanager
def loop(*, clock=None, sensors=moving, **settings):
    made = Loop(SlowScenario(**settings), clock or SimulatedClock(), sensors)
    with made.runtime:
        made.begin()
        yield made


def snapshot(target, context):
    return snapshots.take(target.diagram, context, target.variables())


@pytest.fixture
def gate(tmp_path):
    path = tmp_path / "gate"
    os.mkfifo(path)
    return path


@contextmanager
def opened(gate):
    descriptor = os.open(gate, os.O_RDWR)
    yield
    os.close(descriptor)


def replayed(scenario, cycles, *, results):
    """The states after the cycles, from what was fed, with the results that came then or without."""
    target = DpsAlone(scenario)
    simulator = target.simulator()
    context = simulator.get_mutable_context()
    part = target.diagram.GetSubsystemByName("dps").GetSubsystemByName("perception")
    for n, cycle in enumerate(cycles):
        for change in cycle.changes:
            if results and change.kind == ChangeKind.RESULT:
                ((path, arrays),) = change.values.items()
                assert path == PATH
                part.deliver(context, arrays["tick"], {k: v for k, v in arrays.items() if k != "tick"})
        target.diagram.GetInputPort("real.sense.position").FixValue(context, cycle.fed["position"])
        simulator.AdvanceTo((n + 1) * PERIOD)
        yield snapshot(target, context)


@pytest.mark.slow_cases
@pytest.mark.parametrize("latency", [0.01, 0.05])
def test_loop_and_simulation_agree_bit_for_bit(latency):
    with loop(latency=latency) as real:
        real.run_patiently(300)
        assert real.counts.results >= 12 and real.counts.missed == 0
    shown = ["estimate", "sampled_at", "valid", "missed"]
    for n, state in enumerate(replayed(real.scenario, real.cycles, results=False)):
        for name in shown:
            assert np.array_equal(state[f"{PATH}.{name}"], real.states[n][f"{PATH}.{name}"])


def test_replay_with_missed_and_late_results_is_exact(gate):
    with loop(function=partial(gated, gate=str(gate)), more=PATIENT) as real:
        real.run(45)
        assert real.counts.missed == 2 and real.counts.late == 0
        with opened(gate):
            assert real.wait()
            real.run_patiently(100)
        assert real.counts.late == 1 and real.counts.results >= 4
    with opened(gate):
        states = list(replayed(real.scenario, real.cycles, results=True))
    assert len(states) == 145
    assert [n for n, state in enumerate(states) if state.compare(real.states[n])] == []
    assert states[-1][f"{PATH}.missed"] == real.counts.missed


def test_memory_of_a_late_result_is_used_next(gate):
    with loop(function=partial(gated, gate=str(gate)), more=PATIENT) as real:
        real.run(30)
        with opened(gate):
            assert real.wait()
            real.run_patiently(30)
        assert real.counts.late == 1 and real.counts.results == 1
        _, memory = chaotic(real.cycles[0].fed["position"], np.array([0.3, 0.6]))
        # The sample at 20 ms, whose turn did not come, is missing for good.
        estimate, _ = chaotic(real.cycles[40].fed["position"], memory)
        assert np.array_equal(real.read("estimate"), estimate)


@pytest.mark.slow
def test_missed_results_are_logged_once_per_second(gate, caplog):
    with loop(function=partial(gated, gate=str(gate)), more=PATIENT) as real:
        real.run(round(1.5 / PERIOD))
    messages = [record.getMessage() for record in caplog.records if "no result within" in record.getMessage()]
    assert len(messages) == 2 and all(f"the slow part {PATH} has no result" in message for message in messages)
    assert "missed so far: 1)" in messages[0]
    assert f"{real.counts.missed} missed" in str(real.counts)


def test_loop_does_not_wait_for_a_function_that_hangs(gate):
    with loop(function=partial(gated, gate=str(gate)), more={"memory": np.zeros(2), "patience": 20.0}) as real:
        real.run(100)
        assert real.runtime.time == 100 * PERIOD and len(real.bridge.sent) == 100
        # Due at 10, 30, 50, 70 and 90 ms.
        assert (real.read("missed"), real.read("valid"), real.counts.missed) == (5.0, 0.0, 5)
        assert np.array_equal(real.read("estimate"), [0.0, 0.0])
        missing = [cycle.time for cycle in real.cycles for change in cycle.changes if change.kind == ChangeKind.RESULT]
        assert missing == pytest.approx([0.01, 0.03, 0.05, 0.07, 0.09])
        # 20 latencies later, another process is started; on a busy computer that one may have been replaced already.
        assert real.wait()
        real.run(1)
        assert real.counts.restarts >= 1 and real.wait()
        with opened(gate):
            real.run_patiently(50)
        assert real.counts.results >= 1 and real.read("valid") == 1.0


def test_worker_that_dies_is_replaced():
    # On a busy computer an answer takes its time: a worker has 3 s. After that time, another one begins.
    with loop(function=processes, more={"patience": 300.0}) as real:
        real.run_patiently(50)
        pid, supervisor = real.read("estimate")
        os.kill(int(pid), signal.SIGKILL)
        while real.counts.restarts == 0:
            real.run(1)
        assert real.wait()
        real.run_patiently(50)
        another, same = real.read("estimate")
        assert another != pid and same == supervisor
        assert real.read("missed") == real.counts.missed
        assert real.runtime.time == pytest.approx(len(real.cycles) * PERIOD)


@pytest.mark.slow
def test_sample_that_kills_the_worker_is_missing(caplog):
    settings = {"function": deadly, "period": 0.3, "latency": 0.25, "more": {"patience": 12.0}}
    with loop(sensors=lambda t: {"position": [t - 0.1, 0.0]}, **settings) as real:
        real.run_patiently(2)
        assert real.counts.restarts == 1 and real.counts.missed == 1
        assert real.wait()
        real.run_patiently(580)
        assert (real.counts.restarts, real.counts.missed, real.counts.results) == (1, 1, 1)
        assert real.read("valid") == 1.0 and real.read("missed") == 1.0
    assert any("died (exit code 7)" in record.getMessage() for record in caplog.records)


def test_loop_goes_on_without_the_processes():
    with loop(function=processes, more={}) as real:
        real.run_patiently(50)
        _, supervisor = real.read("estimate")
        os.kill(int(supervisor), signal.SIGKILL)
        os.waitid(os.P_PID, int(supervisor), os.WEXITED | os.WNOWAIT)
        before = real.counts.results
        real.run(200)
        assert real.counts.results == before and real.counts.missed >= 9
        assert len(real.bridge.sent) == 250


def test_loop_begins_when_its_slow_parts_are_ready():
    protocol = Protocol(
        sense=[iiwa_status({"position": "joint_position_measured"})], act=[iiwa_command({"velocity": "joint_torque"})]
    )
    deployment = Deployment(protocol=protocol, period=PERIOD, continuity={"velocity": None}, check_age=False)
    with SlowScenario().deploy("memq://", deployment=deployment, clock=SimulatedClock()) as runtime:
        assert runtime.slow_parts.wait(0.0)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("prepare", "reason"),
    [(lambda: os._exit(3), r"died \(exit code 3\)"), (signal.pause, r"it is not ready within 0\.5 s")],
)
def test_slow_part_that_does_not_start_is_an_error(prepare, reason):
    class Unprepared:
        def __call__(self, sample):
            raise AssertionError

    function = Unprepared()
    function.prepare = prepare
    target = DpsAlone(SlowScenario(function=function))
    bridge = ScriptedBridge(target.interface, SimulatedClock(), moving)
    with (
        Runtime(target, bridge, period=PERIOD, clock=SimulatedClock()) as runtime,
        pytest.raises(ProcessStartError, match=rf"the slow part dps\.perception does not start: .*{reason}"),
    ):
        runtime.slow_parts.wait_until_ready(0.5 if prepare is signal.pause else TIMEOUT)


def test_slow_parts_share_a_time_out(monkeypatch):
    builder = DiagramBuilder()
    for name in ("left", "right"):
        part = SlowPart(processes, inputs={"position": 1}, outputs={"estimate": 2}, period=0.1, latency=0.05)
        builder.ExportInput(builder.AddNamedSystem(name, part).get_input_port(), name)
    diagram = builder.Build()
    parts = {name: diagram.GetSubsystemByName(name) for name in ("left", "right")}
    now, ready = [0.0], (SupervisorMessage.READY, None)
    answers = [(5.0, []), (5.0, []), (4.0, [ready]), (5.0, [])]  # Each in a time, if it is waited for as long.

    def answered(process, timeout):
        takes, messages = answers.pop(0)
        now[0] += min(takes, timeout)
        return messages

    monkeypatch.setattr(BackgroundProcess, "wait_for_messages", answered)
    monkeypatch.setattr(slow_parts, "time", SimpleNamespace(monotonic=lambda: now[0]))
    context = diagram.CreateDefaultContext()
    served = SlowParts(parts, context, period=0.01, clock=SimulatedClock(), changed=lambda *_: None)
    try:
        assert not served.wait(5.0) and now == [5.0]
        with pytest.raises(ProcessStartError, match="the slow part right .* not ready within 5 s"):
            served.wait_until_ready(5.0)
        assert now == [10.0]
    finally:
        monkeypatch.undo()
        served.close()


def test_no_process_is_left():
    with loop(function=processes, more={}) as real:
        real.run_patiently(50)
        pids = [int(pid) for pid in real.read("estimate")]
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_exception_makes_results_missing_and_is_logged_once(caplog):
    with loop(function=picky, more={}, sensors=lambda t: {"position": [0.055 - t, 1.0]}) as real:
        real.run_patiently(200)
        # It raises from the sample at 60 ms on (one cycle passed before the DPS began).
        assert (real.counts.results, real.counts.errors, real.counts.missed) == (3, 7, 7)
        assert (real.read("sampled_at"), real.read("valid")) == (0.04, 0.0)
        assert real.counts.restarts == 0
    told = [record for record in caplog.records if "where is that?" in record.getMessage()]
    assert len(told) == 1 and PATH in told[0].getMessage()


def test_copy_of_a_running_context_computes_itself(gate):
    function = partial(gated, gate=str(gate))
    with loop(function=function, more=PATIENT) as real:
        real.run(25)
        target = DpsAlone(real.scenario)
        copy = target.default_context()
        target.copier_from(real.target).copy(real.runtime.context, copy)
    target.diagram.GetInputPort("real.sense.position").FixValue(copy, [0.0, 0.0])
    with opened(gate):
        target.simulator(copy, restored=True).AdvanceTo(0.035)
    # The first result was declared missing; the second sample, at 20 ms, is under way.
    estimate, _ = chaotic(real.cycles[20].fed["position"], np.array([0.3, 0.6]))
    assert np.array_equal(target.read(copy, f"{PATH}.estimate"), estimate)
    assert target.read(copy, f"{PATH}.missed") == 1.0


@pytest.mark.slow
def test_function_of_50_ms_runs_beside_a_loop_of_1_ms():
    settings = {"function": busy, "period": 0.1, "latency": 0.4, "more": {}}
    with loop(clock=WallClock(), **settings) as real:
        real.runtime.run(cycles=60_000, until=lambda: real.counts.results >= 3)
        assert real.counts.results == 3
        while not real.read("valid"):
            real.run(1)
        cycles = len(real.cycles)
        assert real.runtime.time == cycles * PERIOD and len(real.bridge.sent) == cycles
        # While it computed, the loop ran.
        begins = [n for n, cycle in enumerate(real.cycles) if any(c.kind == ChangeKind.RESULT for c in cycle.changes)]
        assert begins[0] > 1
    for n, state in enumerate(replayed(real.scenario, real.cycles, results=True)):
        assert not state.compare(real.states[n])


def mean_colour(camera):
    return {"colour": camera.data.mean(axis=(0, 1)), "mirrored": camera.data[:, ::-1]}


def test_images_are_sent_both_ways():
    image = ImageRgba8U(640, 480)
    image.mutable_data[:] = np.random.default_rng(1).integers(0, 256, size=(480, 640, 4), dtype=np.uint8)
    builder = DiagramBuilder()
    outputs = {"colour": 4, "mirrored": np.zeros((480, 640, 4), np.uint8)}
    part = SlowPart(mean_colour, inputs={"camera": ImageRgba8U(640, 480)}, outputs=outputs, period=0.1, latency=0.05)
    builder.AddNamedSystem("dps", part)
    source = builder.AddNamedSystem("camera", ConstantValueSource(Value(image)))
    builder.Connect(source.get_output_port(), part.GetInputPort("camera"))
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    changes = []
    parts = SlowParts(
        {"dps": part}, context, period=0.01, clock=SimulatedClock(), changed=lambda *change: changes.append(change)
    )
    try:
        for n in range(1, 7):
            assert parts.wait(TIMEOUT)
            parts.receive()
            simulator.AdvanceTo(n * 0.01)
            parts.send()
    finally:
        parts.close()
    assert parts.statistics["dps"].results == 1
    own = part.GetMyContextFromRoot(context)
    assert np.array_equal(part.GetOutputPort("colour").Eval(own), image.data.mean(axis=(0, 1)))
    assert np.array_equal(part.GetOutputPort("mirrored").Eval(own), image.data[:, ::-1])
    ((kind, values),) = changes
    assert kind == ChangeKind.RESULT and {k: np.shape(v) for k, v in values["dps"].items()} == {
        "tick": (),
        "colour": (4,),
        "mirrored": (480, 640, 4),
    }


class Stubborn:
    """Goes nowhere."""

    def __deepcopy__(self, memo):
        return self

    def __reduce__(self):
        raise TypeError("not me")


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"latency": 0.0019}, "it takes at least 0.002 s for a result to come back"),
        ({"function": partial(chaotic, own=Stubborn())}, "the function of the slow part dps.perception cannot"),
    ],
)
def test_impossible_slow_part_is_refused(settings, told):
    with pytest.raises(ValueError) as error:
        Loop(SlowScenario(**settings), SimulatedClock(), moving)
    assert told in str(error.value)


def test_messages_keep_arrays():
    rng = np.random.default_rng(2)
    arrays = {
        "image": rng.integers(0, 255, size=(48, 64, 3), dtype=np.uint8),
        "fortran": np.asfortranarray(rng.normal(size=(3, 4))),
        "turned": rng.normal(size=(3, 4, 5)).transpose(2, 0, 1),
        "empty": np.zeros((0, 3)),
        "number": np.array(7),
        "flags": np.array([True, False]),
    }
    tick, back = unpack(b"".join(pack((12, arrays))))
    assert tick == 12 and back.keys() == arrays.keys()
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype and np.array_equal(back[name], array)
