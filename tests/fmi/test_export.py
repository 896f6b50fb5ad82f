"""Exported FMUs: FMPy finds nothing wrong in them, and their trajectories equal ours."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import Sine, ZeroOrderHold

from tests.fmi.testbed import TankScenario
from vtbdrake.compiled import UnsupportedTestbedError
from vtbdrake.components.casadi_system.compiler import CompilerError, compiler_command
from vtbdrake.fmi import FmuSystem, export_fmu
from vtbdrake.testbed import DpsAlone, Interface, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake.testbed.instants import sample_instants
from vtbdrake.testbed.parts import WorldAlone
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cube_toss import CubeTossScenario

pytestmark = pytest.mark.skipif(shutil.which(compiler_command()[0]) is None, reason="there is no C compiler")

MASS = "sim.sys.cart_pole.pole.mass"
ANGLE = "sim.sys.cart_pole.pole_pin.position"
RATE = "sim.sys.cart_pole.pole_pin.velocity"
OUTPUTS = ["plant.state", "dps.force"]
PLAN = np.array([0.0, *np.random.default_rng(0).uniform(-60.0, 60.0, 10)])
START = {MASS: 1.3, ANGLE: 0.4, "u.plan": PLAN}


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("native") / "cart_pole.fmu"
    return export_fmu(CartPoleScenario(), path, outputs=OUTPUTS, parameters=[MASS, ANGLE, RATE])


@pytest.fixture(scope="module")
def dps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_fmu(CartPoleScenario(), tmp_path_factory.mktemp("dps") / "dps.fmu", part="dps")


@pytest.fixture(scope="module")
def coupled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("coupled") / "cart_pole.fmu"
    return export_fmu(CartPoleScenario(), path, outputs=OUTPUTS, parameters=[MASS, ANGLE], kind="coupled")


@contextmanager
def slave(path: Path, values: dict[str, Any]) -> Iterator[tuple[Any, Any, list[str]]]:
    """An initialized instance, a function (name) -> value reference, and what it logs."""
    folder, description, said = fmpy.extract(str(path)), fmpy.read_model_description(str(path)), []
    instance = fmpy.simulation.instantiate_fmu(folder, description, logger=lambda *a: said.append(a[-1].decode()))
    reference = {v.name: v.valueReference for v in description.modelVariables}.__getitem__
    try:
        for name, value in values.items():
            instance.setFloat64([reference(name)], np.ravel(value))
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        yield instance, reference, said
    finally:
        instance.freeInstance()
        shutil.rmtree(folder)


def steps(instance: Any, reference: Any, begin: int, end: int) -> np.ndarray:
    """The state of the plant after each step of 0.05 s."""
    rows = []
    for k in range(begin, end):
        instance.doStep(0.05 * k, 0.05)
        rows.append(instance.getFloat64([reference("plant.state")], 4))
    return np.array(rows)


def ours(end: float) -> dict[str, np.ndarray]:
    """The trajectories in Drake, sampled each 0.05 s."""
    testbed = CartPoleScenario().build()
    context = testbed.default_context()
    testbed.write(context, START)
    simulator = testbed.simulator(context)
    simulator.Initialize()
    rows: dict[str, list[Any]] = {name: [testbed.read(context, name)] for name in OUTPUTS}
    times = np.arange(round(end / 0.05) + 1) * 0.05
    for instant in sample_instants(times, 0.0, testbed.event_timings())[1:]:
        simulator.AdvanceTo(instant)
        for name in OUTPUTS:
            rows[name].append(testbed.read(context, name))
    return {name: np.array(values) for name, values in rows.items()}


def test_nothing_is_wrong_with_exported_files(native: Path, dps: Path) -> None:
    assert validate_fmu(str(native)) == [] and validate_fmu(str(dps)) == []
    description = fmpy.read_model_description(str(native))
    variables = {v.name: v for v in description.modelVariables}
    assert {name: v.causality for name, v in variables.items()} == {
        "time": "independent",
        "u.plan": "input",
        MASS: "parameter",
        ANGLE: "parameter",
        RATE: "parameter",
        "plant.state": "output",
        "dps.force": "output",
    }
    assert [variables[name].variability for name in (MASS, ANGLE)] == ["tunable", "fixed"]
    assert variables[MASS].unit == "kg" and variables["u.plan"].shape == (11,)
    assert description.defaultExperiment.stepSize == "0.005"


def test_native_trajectories_equal_the_compiled_ones_to_the_last_bit(native: Path) -> None:
    result = fmpy.simulate_fmu(str(native), stop_time=1.0, output_interval=0.05, start_values=START, output=OUTPUTS)
    rollouts = (
        CartPoleScenario()
        .build()
        .compiled(horizon=1.0, sample_period=0.05, parameters=[MASS], outputs=OUTPUTS, check=False)
    )
    batch = rollouts(START)
    np.testing.assert_array_equal(result["time"], batch.times)
    np.testing.assert_array_equal(result["plant.state"], batch.outputs["plant.state"][0])
    np.testing.assert_array_equal(result["dps.force"], batch.outputs["dps.force"][0, :, 0])
    drake = ours(1.0)
    np.testing.assert_allclose(result["plant.state"], drake["plant.state"], atol=1e-11)


def test_a_saved_state_continues_to_the_last_bit(native: Path) -> None:
    with slave(native, START) as (instance, reference, _):
        steps(instance, reference, 0, 6)
        state = instance.getFMUState()
        data = instance.serializeFMUState(state)
        expected = steps(instance, reference, 6, 12)
        instance.setFMUState(state)
        np.testing.assert_array_equal(steps(instance, reference, 6, 12), expected)
        instance.freeFMUState(state)
    with slave(native, {}) as (other, reference, said):
        state = other.deserializeFMUState(data)
        other.setFMUState(state)
        np.testing.assert_array_equal(steps(other, reference, 6, 12), expected)
        other.freeFMUState(state)
        with pytest.raises(fmpy.fmi1.FMICallException):
            other.deserializeFMUState(data[:-1])
        assert "are a state of another FMU, or damaged" in said[-1]


def test_a_dps_reads_its_sensors_and_commands(dps: Path) -> None:
    times = np.linspace(0.0, 0.4, 21)
    positions = np.column_stack([0.1 * times, 3.0 + times])
    signals = np.zeros(21, dtype=[("time", float), ("joint_position", float, 2), ("joint_velocity", float, 2)])
    signals["time"], signals["joint_position"], signals["joint_velocity"] = times, positions, 0.5
    plan = {"u.plan": PLAN}
    with slave(dps, plan) as (instance, reference, _):
        forces = []
        for k in range(20):
            instance.setFloat64([reference("joint_position")], positions[k])
            instance.doStep(0.02 * k, 0.02)
            forces.append(instance.getFloat64([reference("force")])[0])
    alone = DpsAlone(CartPoleScenario())
    context = alone.default_context()
    alone.write(context, plan)
    velocity = alone.diagram.GetInputPort("real.sense.joint_velocity")
    position = alone.diagram.GetInputPort("real.sense.joint_position")
    velocity.FixValue(context, [0.0, 0.0])
    simulator, expected = alone.simulator(context), []
    for k in range(20):
        position.FixValue(context, positions[k])
        simulator.AdvanceTo(0.02 * (k + 1))
        expected.append(alone.read(context, "real.act.force").item())
    assert np.ptp(forces) > 10.0
    np.testing.assert_allclose(forces, expected, atol=1e-11)


def test_a_world_takes_commands_and_shows_its_sensors(tmp_path: Path) -> None:
    path = export_fmu(CartPoleScenario(), tmp_path / "world.fmu", part="world", parameters={"angle": ANGLE})
    assert validate_fmu(str(path)) == []
    forces = 20.0 * np.sin(np.arange(40))
    measured = []
    with slave(path, {"angle": START[ANGLE]}) as (instance, reference, _):
        for k, force in enumerate(forces):
            instance.setFloat64([reference("force")], [force])
            instance.doStep(0.02 * k, 0.02)
            measured.append(instance.getFloat64([reference("joint_position")], 2))
    world = WorldAlone(CartPoleScenario())
    context = world.default_context()
    world.write(context, {ANGLE: START[ANGLE]})
    simulator, expected = world.simulator(context), []
    for instant, force in zip(
        sample_instants(0.02 * np.arange(41), 0.0, world.event_timings())[1:], forces, strict=True
    ):
        world.actuate(context, "force", force)
        simulator.AdvanceTo(instant)
        expected.append(world.diagram.GetOutputPort("sense.joint_position").Eval(context))
    np.testing.assert_allclose(measured, expected, atol=1e-11)


def test_what_does_not_fit_is_refused_with_a_sentence(native: Path) -> None:
    with slave(native, {}) as (instance, reference, said):
        refused: list[tuple[Callable[[], Any], str]] = [
            (lambda: instance.setFloat64([reference(MASS)], [-1.0]), f"{MASS} must be finite and lie in"),
            (lambda: instance.setFloat64([reference("u.plan")], [np.nan] * 11), "u.plan must be finite"),
            (lambda: instance.setFloat64([reference("u.plan")], [0.0]), "u.plan has 11 values, but there are 1"),
            (lambda: instance.setFloat64([reference(ANGLE)], [0.0]), "until the end of the initialization only"),
            (lambda: instance.setFloat64([reference("dps.force")], [0.0]), "is no input and no parameter"),
            (lambda: instance.getFloat64([99]), "there is no variable with the value reference 99"),
            (lambda: instance.doStep(0.3, 0.1), "the step begins at t = 0.3 s, but the FMU is at 0 s"),
            (lambda: instance.doStep(0.0, -0.1), "a step lasts a positive time in s, not -0.1"),
            (lambda: instance.fmi3SetTime(instance.component, 0.0), "fmi3SetTime is not supported by this FMU"),
        ]
        for call, sentence in refused:
            with pytest.raises(fmpy.fmi1.FMICallException):
                call()
            assert sentence in said[-1]


def test_a_state_that_departs_from_drakes_is_an_error_that_names_the_time(native: Path) -> None:
    with slave(native, {RATE: 1e200}) as (instance, reference, said):
        with pytest.raises(fmpy.fmi1.FMICallException):
            steps(instance, reference, 0, 2)
        assert "is not finite at t = 0 s, which is not compiled: export the FMU with kind='coupled'" in said[-1]


def test_an_exported_testbed_is_imported_again(native: Path) -> None:
    system = FmuSystem(native, period=0.05, parameters={MASS: START[MASS], ANGLE: START[ANGLE]})
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("u.plan").FixValue(context, PLAN)
    simulator.AdvanceTo(0.5)
    fork = context.Clone()
    simulator.AdvanceTo(1.0)
    Simulator(system, fork).AdvanceTo(1.0)
    state = system.GetOutputPort("plant.state")
    np.testing.assert_array_equal(state.Eval(fork), state.Eval(context))
    np.testing.assert_allclose(state.Eval(context), ours(1.0)["plant.state"][-1], atol=1e-11)


@dataclass(repr=False, eq=False)
class WaveScenario(Scenario):
    """A DPS that samples a sine of the time, and a world without anything."""

    def interface(self) -> Interface:
        return Interface(sense=[], act=[Signal("wave", 1, idle=[0.0])])

    def make_dps(self) -> System:
        builder = DiagramBuilder()
        sine = builder.AddNamedSystem("sine", Sine(1.0, 7.0, 0.3, 1))
        hold = builder.AddNamedSystem("hold", ZeroOrderHold(0.1, 1))
        builder.Connect(sine.get_output_port(0), hold.get_input_port())
        builder.ExportOutput(hold.get_output_port(), "wave")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        gain = builder.add("act", "wheel", ZeroOrderHold(0.05, 1))
        builder.sim_actuator("wave", gain.get_input_port())


def test_steps_that_add_up_with_rounding_meet_every_update(tmp_path: Path) -> None:
    path = export_fmu(WaveScenario(), tmp_path / "wave.fmu", part="dps")
    with slave(path, {}) as (instance, reference, _):
        time, values = 0.0, []
        for _ in range(60):  # 0.05 + 0.05 + ... is not k * 0.05
            instance.doStep(time, 0.05)
            time += 0.05
            values.append(instance.getFloat64([reference("wave")])[0])
    expected = np.sin(7.0 * 0.1 * np.floor(np.arange(60) / 2) + 0.3)
    np.testing.assert_allclose(values, expected, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({}, ValueError, "name in outputs what the FMU is to show"),
        ({"outputs": ["dps.forc"]}, ValueError, "there is no variable and no port 'dps.forc'; did you mean dps.force"),
        ({"outputs": OUTPUTS, "parameters": ["plant.mas"]}, ValueError, "plant.mas"),
        ({"outputs": OUTPUTS, "inputs": {"plant.state": "u.plan"}}, ValueError, "the name 'plant.state' is there"),
        ({"outputs": OUTPUTS, "inputs": ["time"]}, ValueError, "cannot be the input 'time'"),
        ({"outputs": OUTPUTS, "parameters": ["T_act.force"]}, ValueError, "cannot be varied"),
        ({"outputs": OUTPUTS, "part": "sim"}, ValueError, "part is testbed, dps, world, not 'sim'"),
        ({"outputs": OUTPUTS, "kind": "source"}, ValueError, "kind is native or coupled, not 'source'"),
        ({"outputs": OUTPUTS, "step": 0.0}, ValueError, "step is a positive time in s, not 0.0"),
    ],
)  # fmt: skip
def test_exports_that_make_no_sense_are_refused(
    tmp_path: Path, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        export_fmu(CartPoleScenario(), tmp_path / "x.fmu", **arguments)
    assert not list(tmp_path.iterdir())


def test_what_is_not_compiled_names_the_other_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = "sim.sense.joint_position.noise"
    with pytest.raises(
        UnsupportedTestbedError, match=r"sim.sense.joint_position draws .*; or export it with kind='coupled'"
    ):
        export_fmu(CartPoleScenario(), tmp_path / "x.fmu", outputs=OUTPUTS, parameters=[noise])
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(CompilerError, match=r"there is no 'no-such-compiler'"):
        export_fmu(CartPoleScenario(), tmp_path / "x.fmu", outputs=OUTPUTS)


@pytest.mark.slow
def test_contact_is_part_of_a_native_fmu(tmp_path: Path) -> None:
    pose, velocity = "sim.sys.cube.position", "sim.sys.cube.velocity"
    # The plant's updates are unrestricted, and come before the ones of the hold, which coincide with them at 0 s.
    outputs = ["plant.state", "dps.sense.y"]
    path = export_fmu(CubeTossScenario(), tmp_path / "cube.fmu", outputs=outputs, parameters=[pose, velocity])
    toss = {pose: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2], velocity: [3.0, 1.0, 2.0, 0.5, 0.0, 0.0]}
    result = fmpy.simulate_fmu(str(path), stop_time=0.5, output_interval=0.005, start_values=toss)
    rollouts = CubeTossScenario().build().compiled(horizon=0.5, sample_period=0.005, outputs=outputs, check=False)
    batch = rollouts(toss)
    assert batch.valid.all() and 0.0 < result["plant.state"][-1][6] < 0.15  # it has fallen, and lies on the ground
    for name in outputs:
        np.testing.assert_array_equal(result[name], batch.outputs[name][0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["native", "coupled"])
def test_entries_of_arrays_are_scalars(tmp_path: Path, kind: str) -> None:
    names = {"inputs": {"first": "u.plan[1]", "second": "u.plan[2]"}, "outputs": {"force": "dps.force"}}
    scenario = CartPoleScenario()
    path = export_fmu(scenario, tmp_path / "entries.fmu", kind=kind, **names)
    result = fmpy.simulate_fmu(
        str(path), stop_time=0.5, output_interval=0.05, start_values={"first": 30.0, "second": -20.0}
    )
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"u.plan": [0.0, 30.0, -20.0, *[0.0] * 8]})
    simulator = testbed.simulator(context)
    for instant, force in zip(
        sample_instants(result["time"], 0.0, testbed.event_timings())[1:], result["force"][1:], strict=True
    ):
        simulator.AdvanceTo(instant)
        np.testing.assert_allclose(force, testbed.read(context, "dps.force").item(), atol=1e-12)
    assert np.ptp(result["force"]) > 20.0


def test_a_scenario_that_no_process_can_import_is_not_coupled(tmp_path: Path) -> None:
    class LocalScenario(WaveScenario):
        """A scenario within a function."""

    with pytest.raises(ValueError, match=r"cannot import .*LocalScenario: define the scenario in a module"):
        export_fmu(LocalScenario(), tmp_path / "x.fmu", part="dps", kind="coupled")


@pytest.mark.slow
def test_coupled_trajectories_equal_drakes(coupled: Path) -> None:
    assert validate_fmu(str(coupled)) == []
    assert fmpy.read_model_description(str(coupled)).coSimulation.needsExecutionTool
    result = fmpy.simulate_fmu(str(coupled), stop_time=1.0, output_interval=0.05, start_values=START, output=OUTPUTS)
    drake = ours(1.0)
    np.testing.assert_allclose(result["plant.state"], drake["plant.state"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(result["dps.force"], drake["dps.force"][:, 0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_coupled_fmu_saves_its_state_and_tells_its_errors(coupled: Path) -> None:
    with slave(coupled, START) as (instance, reference, said):
        steps(instance, reference, 0, 6)
        state = instance.getFMUState()
        data = instance.serializeFMUState(state)
        expected = steps(instance, reference, 6, 12)
        instance.freeFMUState(state)
        other = instance.deserializeFMUState(data)
        instance.setFMUState(other)
        np.testing.assert_array_equal(steps(instance, reference, 6, 12), expected)
        with pytest.raises(fmpy.fmi1.FMICallException):
            instance.setFloat64([reference(MASS)], [-1.0])
        assert f"{MASS} must be finite and lie in" in said[-1]


def children() -> set[str]:
    return {pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


@pytest.mark.slow
def test_the_process_of_a_coupled_fmu_ends_with_it_and_its_death_is_an_error(coupled: Path) -> None:
    before = children()
    with slave(coupled, {}) as (instance, reference, said):
        (child,) = children() - before
        os.kill(int(child), signal.SIGKILL)
        with pytest.raises(fmpy.fmi1.FMICallException):
            steps(instance, reference, 0, 1)
        assert "the Python process of the FMU has ended" in said[-1]
    with slave(coupled, {}) as (instance, reference, _):
        steps(instance, reference, 0, 1)
        (child,) = children() - before
    assert child not in children()


@pytest.mark.slow
def test_a_coupled_fmu_holds_a_world_that_is_an_fmu(fmu: Callable[[str], Path], tmp_path: Path) -> None:
    scenario = TankScenario(path=str(fmu("Integrator")))
    with pytest.raises(UnsupportedTestbedError, match=r"sim.sys.tank: .*kind='coupled'"):
        export_fmu(scenario, tmp_path / "tank.fmu", outputs={"level": "sim.sys.tank.x"})
    names = {"outputs": {"level": "sim.sys.tank.x"}, "parameters": {"gain": "sim.sys.tank.k"}}
    path = export_fmu(scenario, tmp_path / "tank.fmu", kind="coupled", **names)
    result = fmpy.simulate_fmu(str(path), stop_time=0.5, output_interval=0.1, start_values={"gain": 1.0})
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"sim.sys.tank.k": 1.0})
    testbed.simulator(context).AdvanceTo(0.5)
    assert result["level"][-1] == testbed.read(context, "sim.sys.tank.x").item()
