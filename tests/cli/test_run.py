"""The DPS alone, run from the command line against a machine in another process."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import lcm
import numpy as np
import pytest
from drake import lcmt_iiwa_command

from tests.cli.program import ROOT, error_of, run
from tests.control.scripted import PERIOD
from tests.control.servo_machine import COMMAND, PATIENCE, ServoMachineScenario
from tests.control.test_loop import Ear
from vtbdrake.control.statistics import LoopStatistics
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.recording.log_events import LogEvents
from vtbdrake.recording.log_format import CYCLE
from vtbdrake.recording.log_reader import read_log
from vtbdrake.state import Snapshot
from vtbdrake_diagrams.manipulator import ManipulatorScenario

SERVO = "tests.control.servo_machine:ServoMachineScenario"
CYCLES = 60
# What a robot has no use for, by the beginnings of the modules' names.
USELESS = ("pydrake.geometry", "pydrake.multibody", "pydrake.systems.sensors", "pydrake.visualization", "matplotlib")
FAR = ("--set", "u.target=[0.1,-0.05]", "--set", "dps.gain=0.01")


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


def start(*arguments: object, priority: int = 0, group: bool = False) -> subprocess.Popen[str]:
    """``vtbdrake run`` in a process (or group) of its own, which tells in its last line what it had imported."""
    program = (
        "import sys; from vtbdrake.cli import main\n"
        "try: main(prog_name='vtbdrake')\n"
        "finally: print(*sorted(sys.modules))"
    )
    command = [sys.executable, "-u", "-c", program, "run", *map(str, arguments), "--priority", str(priority)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True, start_new_session=group)


def snapshot_in_motion(path: Path, *, lock_step: bool = False) -> Snapshot:
    """A state of the whole testbed, where its DPS has been at work for a while."""
    testbed = ServoMachineScenario(lock_step=lock_step).build()
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), {"u.target": [0.1, -0.05], "dps.gain": 3.0})
    simulator.AdvanceTo(0.05)
    snapshot = testbed.snapshot(simulator.get_context())
    snapshot.save(path)
    return snapshot


def commands_of_the_whole_testbed(hub: Hub, snapshot: Snapshot) -> list[float]:
    scenario = ServoMachineScenario(lock_step=True)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.restore(context, snapshot)
    with (
        MachineProcess(scenario, hub.url, lock_step=True),
        scenario.deploy(hub.url, target=testbed, context=context) as runtime,
    ):
        ear = Ear(hub.url)
        while not all(received.count for received in runtime.bridge.sensed.values()):
            assert runtime.bridge.poll(PATIENCE)
        runtime.switch("real")
        runtime.cycle()
        runtime.run(cycles=CYCLES - 1)
        ear.listen(lambda: len(ear.torques) >= 2 * CYCLES)
    return ear.torques[: 2 * CYCLES]


@pytest.mark.slow
def test_dps_alone_commands_like_the_testbed(tmp_path: Path) -> None:
    snapshot, lock_step = snapshot_in_motion(tmp_path / "s", lock_step=True), ("--field", "lock_step=true")
    with Hub(port=0) as hub:
        expected = commands_of_the_whole_testbed(hub, snapshot)
    with Hub(port=0) as hub, MachineProcess(ServoMachineScenario(), hub.url, lock_step=True):
        ear = Ear(hub.url)
        with start(SERVO, *lock_step, "--url", hub.url, "--snapshot", tmp_path / "s") as program:
            ear.listen(lambda: len(ear.torques) >= 2 * CYCLES)
            program.send_signal(signal.SIGINT)
            output, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, errors
    assert ear.torques[: 2 * CYCLES] == expected
    assert np.ptp(expected) > 0.05
    modules = output.splitlines()[-1].split()
    assert [module for module in modules if module.startswith(USELESS)] == []
    assert not {"vtbdrake.rollout", "vtbdrake.optimization", "vtbdrake.visualization", "scipy"} & set(modules)
    assert "the DPS commands; its time is 0.051 s" in errors
    assert "SCHED_FIFO" not in output and "locked memory: " in output
    assert "deadlines missed" in output


@pytest.mark.slow
def test_the_arm_is_run_without_its_plant() -> None:
    program = (
        "import sys; from vtbdrake_diagrams.manipulator import ManipulatorScenario as S; import vtbdrake.cli.run;"
        "from vtbdrake.testbed import DpsAlone; from vtbdrake.deployment import Deployment;"
        "Deployment.of(S()); DpsAlone(S()); print(*sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    # Its scenario has a MultibodyPlantConfig, and its DPS knows the inertias of the links: these import what they need.
    useless = {
        "pydrake.multibody.parsing",
        "scipy.optimize",
        "vtbdrake_diagrams.manipulator.world",
        "pydrake.visualization",
    }
    assert useless & set(found.stdout.split()) == set()
    assert Deployment.of(ManipulatorScenario()).continuity.keys() == {"joint_torque"}


@pytest.mark.slow
@pytest.mark.parametrize("ending", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_in_the_end_the_fallback_goes_out_once(hub: Hub, ending: signal.Signals) -> None:
    with MachineProcess(ServoMachineScenario(rate=0.0), hub.url):
        ear = Ear(hub.url)
        with start(SERVO, "--field", "rate=0.0", "--url", hub.url, *FAR, "--no-live") as program:
            ear.listen(lambda: len(ear.torques) >= 40)
            program.send_signal(ending)
            _, errors = program.communicate(timeout=PATIENCE)
        heard = np.array(ear.listen()).reshape(-1, 2)
    assert program.returncode == 0, errors
    # No velocity; before that the DPS is on its way.
    assert np.flatnonzero((heard == 0.0).all(axis=1)).tolist() == [len(heard) - 1]


@pytest.mark.slow
@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_log_holds_the_last_commands_when_the_whole_group_is_ended(
    hub: Hub, tmp_path: Path, ending: signal.Signals
) -> None:
    """systemd and ``timeout`` end a whole group so; ``timeout`` sends its signal twice."""
    path = tmp_path / "log.lcm"
    fields = ("--field", "leave_time=0.5", "--set", "u.target=[0.1,-0.05]", "--set", "dps.gain=2.0")
    with MachineProcess(ServoMachineScenario(), hub.url):
        ear = Ear(hub.url)
        with start(SERVO, "--url", hub.url, "--record", path, *fields, group=True) as program:
            ear.listen(lambda: len(ear.torques) >= 40)
            os.killpg(program.pid, ending)
            os.killpg(program.pid, ending)
            _, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, errors
    assert f"recorded to {path}, without a loss" in errors
    events = LogEvents(path)
    sent = [lcmt_iiwa_command.decode(events.data(begin, end)) for _, _, begin, end in events.on(COMMAND)]
    after = [
        message.joint_torque for message, (n, *_) in zip(sent, events.on(COMMAND), strict=True) if n > last(events)
    ]
    ear.listen(lambda: sent[-1].utime in ear.utimes)
    assert [message.utime for message in sent if message.utime in ear.utimes] == ear.utimes
    speeds = np.abs(after).max(axis=1)
    assert len(after) > 10 and (np.diff(speeds) <= 0.0).all() and speeds[-1] == 0.0 < speeds[0]
    assert read_log(path).closed


def last(events: LogEvents) -> int:
    """Return the number of the event of the last cycle."""
    return int(events.places(CYCLE)[-1, 0])


@contextmanager
def intruder(url: str) -> Iterator[None]:
    """Somebody else who publishes on the command channel again and again."""
    bus, over = lcm.LCM(url), threading.Event()

    def intrude() -> None:
        while not over.wait(0.01):
            bus.publish(COMMAND, b"somebody else")

    thread = threading.Thread(target=intrude)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.slow
def test_second_publisher_delays_switch_and_alarms(hub: Hub) -> None:
    options = ("--url", hub.url, "--no-live", *FAR)
    with MachineProcess(ServoMachineScenario(), hub.url), ExitStack() as stack:
        with intruder(hub.url):
            program = stack.enter_context(start(SERVO, *options))
            assert program.stderr is not None
            blocked = f"waiting: another client publishes commands on {COMMAND}: only one may command a machine"
            assert any(blocked in line for line in program.stderr)
        assert any("the DPS commands" in line for line in program.stderr)
        with intruder(hub.url):
            assert any(f"ALARM: another client publishes commands on {COMMAND}" in line for line in program.stderr)
        program.send_signal(signal.SIGINT)
        output, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, errors
    assert "ALARM: other publishers commanded the machine, too" in output


def may_have_priority() -> bool:
    """Whether a process may have SCHED_FIFO here; asked in a process of its own."""
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    return subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not may_have_priority(), reason="needs the right to SCHED_FIFO")
def test_endless_step_sends_the_fallback(hub: Hub) -> None:
    with MachineProcess(ServoMachineScenario(rate=0.0), hub.url):
        ear = Ear(hub.url)
        endless = "tests.cli.endless:EndlessScenario"
        with start(endless, "--url", hub.url, "--no-live", *FAR, priority=1) as program:
            _, errors = program.communicate(timeout=PATIENCE)
        heard = np.array(ear.listen()).reshape(-1, 2)
    assert program.returncode == 1, errors
    last = errors.splitlines()[-1]
    assert last.startswith("Error: a real-time thread has computed for 2 s without waiting: its step does not end")
    assert np.flatnonzero((heard == 0.0).all(axis=1)).tolist() == [len(heard) - 1]


@pytest.mark.slow
def test_run_ends_in_time_and_writes_files(hub: Hub, tmp_path: Path) -> None:
    files = ("--statistics", tmp_path / "s.json", "--record", tmp_path / "log.lcm")
    with MachineProcess(ServoMachineScenario(), hub.url):
        ear = Ear(hub.url)
        with start(SERVO, "--url", hub.url, "--seconds", 0.2, "--no-live", *files, *FAR) as program:
            output, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, errors
    told = LoopStatistics.from_dict(json.loads((tmp_path / "s.json").read_text()))
    assert told.period == PERIOD
    # One command in each cycle but those before the machine spoke, and the farewell.
    assert told.cycles + 1 >= len(ear.listen()) / 2 > 1
    assert f"recorded to {tmp_path / 'log.lcm'}, without a loss" in errors
    assert (tmp_path / "log.lcm").stat().st_size > 0


@pytest.mark.slow
def test_log_that_lacks_cycles_is_an_error(hub: Hub, tmp_path: Path) -> None:
    with MachineProcess(ServoMachineScenario(), hub.url):
        options = ("--url", hub.url, "--seconds", 1.0, "--no-live", "--record", tmp_path / "log.lcm")
        with start(SERVO, *options, *FAR) as program:
            resource.prlimit(program.pid, resource.RLIMIT_FSIZE, (40_000, 40_000))  # as a disk that is full
            output, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 1
    assert "deadlines missed" in output
    assert re.search(r"^Error: \d+ of \d+ cycles of the loop are not in the log .*log\.lcm$", errors, re.MULTILINE)


@pytest.mark.slow
def test_a_dps_that_runs_is_read_set_and_watched(hub: Hub) -> None:
    with MachineProcess(ServoMachineScenario(), hub.url), start(SERVO, "--url", hub.url, *FAR) as program:
        try:
            patience = ("--url", hub.url, "--timeout", PATIENCE)
            before = run("get", "dps.gain", "u.target", *patience)
            changed = run("set", "dps.gain=0.5", "u.target=[0.2,0.1]", *patience)
            after = run("watch", "dps.gain", "u.target", "--every", 5, "--count", 3, *patience)
            refused = run("set", "dps.gian=1", *patience)
        finally:
            program.send_signal(signal.SIGTERM)
            _, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, errors
    assert before.stdout == "dps.gain = 0.01\nu.target = [0.1, -0.05]\n"
    assert (changed.exit_code, changed.stdout, changed.stderr) == (0, "", "")
    lines = [json.loads(line) for line in after.stdout.splitlines()]
    assert [(line["dps.gain"], line["u.target"]) for line in lines] == [(0.5, [0.2, 0.1])] * 3
    assert refused.exit_code == 1
    assert refused.stderr.startswith("Error: there is no variable") and "did you mean dps.gain" in refused.stderr


@pytest.mark.slow
def test_a_stopped_dps_goes_on_with_the_machine_back(hub: Hub) -> None:
    options = ("--url", hub.url, "--field", "max_age=0.2", "--pace", "", *FAR)
    patience = ("--url", hub.url, "--timeout", PATIENCE)
    with MachineProcess(ServoMachineScenario(), hub.url) as machine, start(SERVO, *options) as program:
        assert program.stderr is not None
        assert any("the DPS commands" in line for line in program.stderr)
        machine.pause()
        assert any("the fallbacks command from now on" in line for line in program.stderr)
        limit = time.monotonic() + PATIENCE
        # An earlier fault, of a computer that is busy, is over: its reset is accepted.
        while not (refused := run("reset", *patience)).exit_code:
            assert time.monotonic() < limit
        machine.resume()
        while (released := run("reset", *patience)).exit_code:
            assert time.monotonic() < limit, released.stderr
        program.send_signal(signal.SIGTERM)
        program.communicate(timeout=PATIENCE)
    assert refused.exit_code == 1
    assert "is stale" in refused.stderr
    assert "this fault is over: sensor signal position is stale" in released.stdout


def test_silent_machine_is_given_up(hub: Hub) -> None:
    with start(SERVO, "--url", hub.url, "--wait", 1.0, "--no-live", "--pace", "") as program:
        _, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 1
    assert "waiting: " in errors
    last = errors.splitlines()[-1]
    assert re.match(r"Error: not switched to the machine after \d+\.\d s: ", last)
    assert "position" in last and "speed" in last


@pytest.mark.slow
def test_a_frozen_owner_of_the_commands_is_succeeded_only_on_request() -> None:
    with Hub(port=0, protect=[COMMAND], lease=0.05) as hub:
        owner, options = lcm.LCM(hub.url), ("--url", hub.url, "--no-live", "--pace", "", *FAR)
        owner.publish(COMMAND, b"the last one before it froze")

        def refusal(wait: float) -> str:
            with start(SERVO, *options, "--wait", wait) as program:
                _, errors = program.communicate(timeout=2 * PATIENCE)
            assert program.returncode == 1
            return errors.splitlines()[-1]

        # On a computer that is busy, the hub may say so only after the first wait.
        assert any(f"the hub protects {COMMAND} for another client" in refusal(wait) for wait in (1.0, 10.0, PATIENCE))
        ear = Ear(hub.url)
        with MachineProcess(ServoMachineScenario(), hub.url), start(SERVO, *options, "--take-over") as program:
            ear.listen(lambda: len(ear.torques) >= 40)
            program.send_signal(signal.SIGINT)
            _, errors = program.communicate(timeout=PATIENCE)
        assert program.returncode == 0, errors


def another_snapshot(folder: Path) -> Path:
    testbed = ServoMachineScenario(rate=7.0).build()
    testbed.snapshot(testbed.default_context()).save(folder / "other")
    return folder / "other"


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("scenario", "options", "code", "message"),
    [
        ("tests.testbeds:AcrobotScenario", (), 2, "has no protocol for its machine"),
        ("tests.cli.careless:CarelessScenario", (), 2, "CarelessScenario cannot run on its machine: the actuator"),
        (SERVO, ("--set", "dps.gian=1"), 2, "did you mean dps.gain"),
        (SERVO, ("--field", "rtae=1"), 2, "no field 'rtae'"),
        (SERVO, ("--field", "rate=fast"), 2, "must be a finite number"),
        (SERVO, ("--pace", "posture"), 2, "paced by a sensor signal (position, speed), not by 'posture'"),
        (SERVO, ("--period", "0"), 2, "positive"),
        (SERVO, ("--url", "tcpq://127.0.0.1:1"), 1, "no LCM bus at tcpq://127.0.0.1:1"),
        (SERVO, ("--snapshot", "none.vtb"), 2, "none.vtb: No such file"),
        (SERVO, ("--snapshot", another_snapshot), 2, "of another scenario (rate: 7.0 there, 2.0 here)"),
    ],
)
def test_bad_input_is_one_line(
    hub: Hub, tmp_path: Path, scenario: str, options: tuple[object, ...], code: int, message: str
) -> None:
    given = [option(tmp_path) if callable(option) else option for option in options]
    assert message in error_of("run", scenario, "--url", hub.url, *given, code=code)


@pytest.mark.parametrize("ending", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_run_that_ends_in_the_fallbacks_has_failed(hub: Hub, ending: signal.Signals) -> None:
    options = ("--url", hub.url, "--field", "max_age=0.05", "--pace", "", "--no-live", *FAR)
    with MachineProcess(ServoMachineScenario(), hub.url) as machine, start(SERVO, *options) as program:
        assert program.stderr is not None
        assert any("the DPS commands" in line for line in program.stderr)
        machine.kill()
        # It goes on, with what is safe.
        assert any("the fallbacks command from now on" in line for line in program.stderr)
        assert program.poll() is None
        program.send_signal(ending)
        output, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 1
    assert "Error: the fallbacks took over: " in errors
    assert "sensor signal position is stale" in output


@pytest.mark.slow
def test_ctrl_c_before_the_first_cycle_is_a_proper_end(hub: Hub) -> None:
    program = (
        "import os, signal; import vtbdrake.cli.run as command\n"
        "command.show = lambda *_: os.kill(os.getpid(), signal.SIGINT)\n"
        "from vtbdrake.cli import main; main(prog_name='vtbdrake')"
    )
    command = [sys.executable, "-c", program, "run", SERVO, "--url", hub.url, "--priority", "0"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    assert "interrupted" in ended.stderr
