"""A station simulates what Drake's hardware_sim simulates of the same file, and its states continue exactly."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from drake import lcmt_schunk_wsg_command
from pydrake.systems.analysis import InitializeParams
from pydrake.systems.framework import Context, DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

import vtbdrake as vtb
from benchmarks import hardware_sim_loop
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.station import FILE, HOME, ArmStation

TIMES = np.arange(1, 31) * 0.02
ARM = [f"sim.sys.iiwa.iiwa_joint_{k}.position" for k in range(1, 8)]
FINGER = "sim.sys.wsg.right_finger_sliding_joint.position"


def swing(around: np.ndarray | float, size: float) -> TrajectorySource:
    """Return a smooth motion that depends on the time alone."""
    times = np.linspace(0.0, 1.0, 6)
    samples = around + size * np.sin(5.0 * times + np.arange(7)[:, None])
    return TrajectorySource(PiecewisePolynomial.CubicShapePreserving(times, samples, zero_end_point_derivatives=True))


def sources(key: str) -> dict[str, System]:
    by_port: dict[str, System] = {}
    if key != "Torque":
        by_port["position"] = swing(HOME[:, None], 0.02)
    if key != "Position":
        by_port["torque"] = swing(0.0, 5.0)
    return by_port


def commander(key: str, opening: float, force: float) -> Callable[[vtb.Station], System]:
    def make_dps(station: vtb.Station) -> System:
        builder = DiagramBuilder()
        systems = {f"iiwa_{name}": source for name, source in sources(key).items()}
        systems |= {
            "wsg_position": ConstantVectorSource([opening]),
            "wsg_force_limit": ConstantVectorSource([force]),
        }
        for name, system in systems.items():
            builder.AddNamedSystem(name, system)
            builder.ExportOutput(system.get_output_port(), name)
        return builder.Build()

    return make_dps


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("key", "opening", "gains"),
    [
        ("Torque", 0.1, ""),
        ("Position", 0.01, ""),
        ("PositionAndTorque", 0.039, ""),
        ("Torque", 0.06, "pid_gains: [7200.0, 3000.0, 5.0]"),
    ],
)
def test_motion_is_that_of_hardware_sim_bit_for_bit(key: str, opening: float, gains: str, tmp_path: Path) -> None:
    shutil.copytree(FILE.parent, tmp_path / "station")
    file = tmp_path / "station" / FILE.name
    file.write_text(FILE.read_text().replace("!SchunkWsgDriver {}", f"!SchunkWsgDriver {{ {gains} }}"))
    grip = lcmt_schunk_wsg_command()
    grip.utime, grip.target_position_mm, grip.force = 1, 1e3 * opening, 30.0
    urls = {"iiwa": "memq://null", "wsg": "memq://wsg"}
    reference = hardware_sim_loop.build(file, key, urls=urls, grip=grip, sources=sources(key))
    expected = reference.states(TIMES)

    testbed = vtb.Station(f"{file}#{key}", dps=commander(key, opening, 30.0)).build()
    simulator = testbed.simulator()
    context = testbed.plant.GetMyContextFromRoot(simulator.get_context())
    for time, state in zip(TIMES, expected, strict=True):
        simulator.AdvanceTo(time)
        np.testing.assert_array_equal(testbed.plant.GetPositionsAndVelocities(context), state)
    finger = reference.plant.GetJointByName("right_finger_sliding_joint").position_start()
    assert expected[-1, finger] == pytest.approx(opening / 2, abs=1e-3)
    assert np.ptp(expected[:, : reference.plant.num_positions()], axis=0).max() > 0.01


@pytest.mark.slow_cases
@pytest.mark.parametrize("key", ["Torque", "Position"])
def test_fork_is_the_future(key: str) -> None:
    scenario = ArmStation(f"{FILE}#{key}")
    testbed = scenario.build()
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    testbed.write(context, {"u.target": HOME + 0.1, "u.opening": 0.1})
    simulator.AdvanceTo(0.13)  # The fingers move, and the block has hit the table.
    task = RolloutTask(scenario, 0.3, record=[*ARM, FINGER], sample_period=0.05, start=testbed.fork(simulator))
    forecast = RolloutRunner(task).run({}).record
    future: dict[str, list[float]] = {name: [testbed.read(context, name)] for name in (*ARM, FINGER)}
    for instant in task.instants(0.13, testbed.event_timings())[1:]:
        simulator.AdvanceTo(instant)
        for name, values in future.items():
            values.append(testbed.read(context, name))
    for name, values in future.items():
        np.testing.assert_array_equal(forecast[name], values, err_msg=name)
    assert np.ptp(future[FINGER]) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("key", ["Torque", "Position"])
def test_snapshot_continues_in_another_build(key: str, tmp_path: Path) -> None:
    def motion(testbed: VirtualTestbed, context: Context) -> np.ndarray:
        simulator = testbed.simulator(context)
        simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        states = []
        for time in 0.13 + TIMES:
            simulator.AdvanceTo(time)
            states.append(np.array([testbed.read(context, name) for name in (*ARM, FINGER)]))
        return np.array(states)

    first = ArmStation(f"{FILE}#{key}").build()
    context = first.default_context()
    first.write(context, {"u.target": HOME + 0.1, "u.opening": 0.1})
    first.simulator(context).AdvanceTo(0.13)
    first.snapshot(context).save(tmp_path / "at")
    there = motion(first, context)
    for _ in range(2):
        another = ArmStation(f"{FILE}#{key}").build()
        resumed = another.default_context()
        another.restore(resumed, vtb.Snapshot.load(tmp_path / "at"))
        np.testing.assert_array_equal(motion(another, resumed), there)
    assert np.ptp(there, axis=0).min() > 0.001


@pytest.mark.slow
def test_contexts_run_side_by_side() -> None:
    testbed = ArmStation().build()

    def motion(opening: float) -> list[float]:
        context = testbed.default_context()
        testbed.write(context, {"u.opening": opening})
        simulator = testbed.simulator(context)
        positions = []
        for time in TIMES:
            simulator.AdvanceTo(time)
            positions.append(testbed.read(context, FINGER))
        return positions

    openings = [0.02, 0.06, 0.1, 0.06]
    one_by_one = [motion(opening) for opening in openings]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(motion, openings)) == one_by_one
    assert one_by_one[1] == one_by_one[3] != one_by_one[2]


@pytest.mark.slow_cases
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("signal", ["iiwa_torque", "wsg_position", "wsg_force_limit"])
def test_command_that_is_not_finite_ends_the_simulation(signal: str, value: float) -> None:
    def make_dps(station: vtb.Station) -> System:
        builder = DiagramBuilder()
        for name, command in (("iiwa_torque", np.zeros(7)), ("wsg_position", [0.05]), ("wsg_force_limit", [30.0])):
            values = np.array(command, dtype=float)
            values[0] = value if name == signal else values[0]
            source = builder.AddNamedSystem(name, ConstantVectorSource(values))
            builder.ExportOutput(source.get_output_port(), name)
        return builder.Build()

    testbed = vtb.Station(f"{FILE}#Torque", dps=make_dps).build()
    with pytest.raises(ValueError, match=f"the DPS commands {signal} = .* not finite"):
        testbed.simulator().AdvanceTo(0.06)


def test_entries_are_named_after_the_joints_of_their_arm() -> None:
    joints = tuple(f"iiwa_joint_{k}" for k in range(1, 8))
    commands = {"iiwa_goal": vtb.StationCommand(default=list(HOME)), "opening": vtb.StationCommand(default=[0.05])}
    station = vtb.Station(f"{FILE}#Position", dps=commander("Position", 0.05, 40.0), commands=commands)
    interface = station.interface()
    names = {signal.name: signal.entry_names for signal in (*interface.sense, *interface.act, *interface.commands)}
    for signal in ("iiwa_position_measured", "iiwa_position", "iiwa_goal"):
        assert names[signal] == joints
    assert names["wsg_position"] == names["opening"] == ()
