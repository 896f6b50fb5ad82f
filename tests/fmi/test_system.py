"""FMUs as Drake systems: their numbers against known solutions, their state in the Context, and what is refused."""

from __future__ import annotations

import gc
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold
from scipy.integrate import solve_ivp

import vtbdrake as vtb
from tests.fmi.testbed import FilteringScenario, TankScenario
from tests.recording.servo import Servo
from vtbdrake.fmi import FmuSystem
from vtbdrake.fmi.extraction import ExtractionFolder
from vtbdrake.fmi.instances import FmuError
from vtbdrake.rollout import ThreadExecutor
from vtbdrake.state.snapshot import SnapshotError
from vtbdrake.testbed import DpsAlone
from vtbdrake.testing import check_scenario

Fmu = Callable[[str], Path]


def run(system: FmuSystem, end: float, **inputs: Any) -> tuple[Simulator, Any]:
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for port, value in inputs.items():
        system.GetInputPort(port).FixValue(context, value)
    simulator.AdvanceTo(end)
    return simulator, context


def out(system: FmuSystem, context: Any, port: str) -> Any:
    value = system.GetOutputPort(port).Eval(context)
    return value.item() if value.size == 1 else value


def test_samples_show_the_fmu_at_their_time_and_tunable_parameters_change(fmu: Fmu) -> None:
    system = FmuSystem(fmu("Integrator"), parameters={"k": 3.0})
    assert [(v.name, v.shape, v.bounds) for v in system.variables] == [("k", (), (0.0, 9.0))]
    simulator, context = run(system, 1.0, u=[0.5])
    np.testing.assert_allclose(out(system, context, "x"), 1.5, rtol=1e-13)
    context.get_mutable_numeric_parameter(0).SetFromVector([1.0])
    simulator.AdvanceTo(2.0)
    np.testing.assert_allclose(out(system, context, "x"), 2.0, rtol=1e-13)


def test_bouncing_ball_is_the_geometric_series(fmu: Fmu) -> None:
    e, g = 0.5, 9.81
    system = FmuSystem(fmu("BouncingBall"), period=0.05, parameters={"h": 2.0, "e": e})
    assert out(system, system.CreateDefaultContext(), "h") == 2.0
    _, context = run(system, 1.25)
    # The n-th impact is at t0 (1 + 2 e + 2 e^2 + ...), with the velocity e^n g t0 afterwards.
    t0 = np.sqrt(2 * 2.0 / g)
    impacts = t0 * np.cumsum([1.0, *(2 * e**n for n in range(1, 8))])
    n = int(np.sum(impacts < 1.25))
    since, v0 = 1.25 - impacts[n - 1], e**n * g * t0
    assert n >= 1 and out(system, context, "bounces") == n
    np.testing.assert_allclose(out(system, context, "h"), v0 * since - 0.5 * g * since**2, atol=1e-12)
    np.testing.assert_allclose(out(system, context, "v"), v0 - g * since, atol=1e-12)


def test_van_der_pol_and_dahlquist_are_their_solutions(fmu: Fmu) -> None:
    system = FmuSystem(fmu("VanDerPol"), period=0.02, parameters={"mu": 1.5})
    _, context = run(system, 3.0)
    exact = solve_ivp(
        lambda t, x: [x[1], 1.5 * (1 - x[0] ** 2) * x[1] - x[0]], (0, 3), [2.0, 0.0], rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose([out(system, context, "x0"), out(system, context, "x1")], exact.y[:, -1], atol=1e-8)
    euler = FmuSystem(fmu("Dahlquist"), parameters={"k": 0.5})  # its file proposes steps of 0.1 s
    _, context = run(euler, 1.0)
    np.testing.assert_allclose(out(euler, context, "x"), 0.95**10, rtol=1e-14)


def test_arrays_are_vectors_row_after_row(fmu: Fmu) -> None:
    A = np.array([[0.5, 0.25, 0.0], [-0.5, 0.5, 1.0]])
    system = FmuSystem(fmu("Linear"), period=0.5, parameters={"A": A})
    assert system.variables[0].shape == (2, 3)
    _, context = run(system, 2.0, u=[1.0, -2.0])
    y = np.zeros(3)
    for _ in range(4):
        y = np.append(A @ y + [1.0, -2.0], y[2] + 1)
    np.testing.assert_array_equal(out(system, context, "y"), y)


def test_whole_numbers_flags_and_choices_are_numbers_on_ports(fmu: Fmu) -> None:
    system = FmuSystem(fmu("Types"), period=1.0, inputs={"counts": ["whole", "small"], "flag": "flag", "gear": "gear"})
    _, context = run(system, 0.5, counts=[-7.0, 255.0], flag=[1.0], gear=[1.0])
    assert [out(system, context, name) for name in ("twice", "inverse", "next")] == [241, 0, 2]
    for inputs in ({"counts": [0.5, 0.0]}, {"counts": [0.0, 256.0]}, {"counts": [0.0, np.nan]}, {"flag": [2.0]}):
        with pytest.raises(ValueError, match=r"takes whole numbers from (-2147483648|0) to (2147483647|255|1), not "):
            run(system, 0.5, **inputs)
    assert run(FmuSystem(fmu("Types"), period=1.0, parameters={"label": "four"}), 0.5)


def test_fmi_2_runs_too(fmu: Fmu) -> None:
    system = FmuSystem(fmu("Integrator2"), period=0.1, parameters={"k": 4.0})
    simulator, context = run(system, 1.0, u=[0.5], n=[2.0])
    np.testing.assert_allclose(out(system, context, "x"), 10.0, rtol=1e-13)
    fork = context.Clone()
    simulator.AdvanceTo(2.0)
    system.GetInputPort("on").FixValue(fork, [0.0])
    Simulator(system, fork).AdvanceTo(2.0)
    np.testing.assert_allclose([out(system, context, "x"), out(system, fork, "x")], [20.0, 10.0], rtol=1e-13)


SLAVE = '''
from pythonfmu3 import Fmi3Causality, Fmi3Slave, Float64

class Filter(Fmi3Slave):
    """y' = u - y by explicit Euler."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.u, self.y = 0.0, 0.0, 0.0
        self.register_variable(Float64("time", causality=Fmi3Causality.independent))
        self.register_variable(Float64("u", causality=Fmi3Causality.input, start=0.0))
        self.register_variable(Float64("y", causality=Fmi3Causality.output))

    def do_step(self, time, step):
        self.y += step * (self.u - self.y)
        return True
'''


def test_an_fmu_of_pythonfmu3_forks(tmp_path: Path) -> None:
    builder = pytest.importorskip("pythonfmu3.builder")
    script = tmp_path / "filter.py"
    script.write_text(SLAVE)
    path = builder.FmuBuilder.build_FMU(script, tmp_path, canGetAndSetFMUState=True, canSerializeFMUState=True)
    system = FmuSystem(path, period=0.1)
    simulator, context = run(system, 0.5, u=[1.0])
    fork = context.Clone()
    system.GetInputPort("u").FixValue(fork, [0.0])
    simulator.AdvanceTo(1.0)
    Simulator(system, fork).AdvanceTo(1.0)
    half = 1 - 0.9**5
    np.testing.assert_allclose(out(system, context, "y"), 1 - 0.9**10, rtol=1e-13)
    np.testing.assert_allclose(out(system, fork, "y"), half * 0.9**5, rtol=1e-13)


def test_contexts_in_threads_are_independent(fmu: Fmu) -> None:
    system = FmuSystem(fmu("Integrator"), period=0.01)
    contexts = [system.CreateDefaultContext() for _ in range(4)]
    for k, context in enumerate(contexts):
        system.GetInputPort("u").FixValue(context, [float(k)])

    def simulate(context: Any) -> None:
        simulator = Simulator(system, context)
        for k in range(1, 5):
            simulator.AdvanceTo(0.25 * k)

    threads = [threading.Thread(target=simulate, args=(context,)) for context in contexts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_allclose([out(system, c, "x") for c in contexts], [0.0, 2.0, 4.0, 6.0], rtol=1e-12)


def test_a_snapshot_of_a_testbed_continues_in_another_build(fmu: Fmu, tmp_path: Path) -> None:
    scenario = TankScenario(path=str(fmu("Integrator")))
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"u.goal": 1.0, "sim.sys.tank.k": 1.0})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(0.5)
    testbed.fork(simulator).save(tmp_path / "half.vtbs")
    simulator.AdvanceTo(1.0)
    level = testbed.read(context, "sim.sys.tank.x")
    assert 0.5 < level < 1.0
    other = scenario.build()
    restored = other.default_context()
    other.restore(restored, vtb.Snapshot.load(tmp_path / "half.vtbs"))
    other.simulator(restored, restored=True).AdvanceTo(1.0)
    assert other.read(restored, "sim.sys.tank.x") == level
    assert other.snapshot(restored) == testbed.snapshot(context)


def tank_problem(fmu: Fmu) -> vtb.Problem:
    return vtb.Problem(
        scenario=TankScenario(path=str(fmu("Integrator"))),
        parameters=[vtb.Parameter("sim.sys.tank.k", 0.5, 4.0)],
        quality=vtb.Quality(lambda x: x[0], of="sim.sys.tank.x", reading="end"),
        horizon=0.4,
    )


def test_rollouts_in_threads_equal_serial_ones_and_vary_parameters(fmu: Fmu) -> None:
    problem = tank_problem(fmu)
    serial = problem.sweep(3, executor="serial", progress=False)
    with ThreadExecutor(2) as executor:
        threads = problem.sweep(3, executor=executor, progress=False)
    values = [rollout.value for rollout in serial.rollouts]
    assert values == [rollout.value for rollout in threads.rollouts]
    assert values == sorted(values) and values[0] < values[-1]


def test_what_is_sampled_with_a_step_sees_the_outputs_before_it(fmu: Fmu) -> None:
    builder = DiagramBuilder()
    system = builder.AddSystem(FmuSystem(fmu("Integrator"), period=0.1, parameters={"x": 5.0}))
    hold = builder.AddSystem(ZeroOrderHold(0.1, 1))
    other = builder.AddSystem(FmuSystem(fmu("Integrator"), period=0.1))
    for reader in (hold, other):
        builder.Connect(system.get_output_port(), reader.get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    system.get_input_port().FixValue(system.GetMyMutableContextFromRoot(context), [1.0])
    for k in range(1, 4):
        simulator.AdvanceTo(0.1 * k - 0.05)
        values = [s.get_output_port().Eval(s.GetMyContextFromRoot(context)).item() for s in (system, hold, other)]
        x = [5.0 + 0.2 * j for j in range(k + 1)]  # the outputs at 0, 0.1, ... s
        np.testing.assert_allclose(values, [x[k], x[k - 1], 0.2 * sum(x[:k])], rtol=1e-13)


@pytest.mark.slow
def test_a_scenario_with_an_fmu_passes_all_checks(fmu: Fmu) -> None:
    check_scenario(TankScenario(path=str(fmu("Integrator"))))


@pytest.mark.slow
def test_rollouts_in_processes_equal_serial_ones(fmu: Fmu) -> None:
    problem = tank_problem(fmu)
    serial = problem.sweep(3, executor="serial", progress=False)
    processes = problem.sweep(3, executor="processes", progress=False)
    assert [r.value for r in serial.rollouts] == [r.value for r in processes.rollouts]


def test_a_recorded_loop_with_an_fmu_in_its_dps_is_replayed_identically(fmu: Fmu, tmp_path: Path) -> None:
    servo = Servo(scenario=FilteringScenario(rate=0.0, path=str(fmu("Integrator"))))
    with vtb.Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=40)
    assert np.ptp(servo.commands[2:]) > 1e-3
    report = vtb.replay(tmp_path / "run.lcm", DpsAlone(servo.scenario))
    assert report.identical and report.cycles == 40


def test_an_fmu_without_saved_state_is_refused_or_runs_in_one_context(fmu: Fmu) -> None:
    path = fmu("Stateless")
    with pytest.raises(ValueError, match=r"Stateless.fmu cannot save and restore its state .* or give fork=False"):
        FmuSystem(path)
    system = FmuSystem(path, fork=False)
    for _ in range(2):  # the second one begins anew
        simulator, context = run(system, 1.0, u=[2.0])
        np.testing.assert_allclose(out(system, context, "x"), 2.0, rtol=1e-12)
    fork = context.Clone()
    simulator.AdvanceTo(1.5)
    with pytest.raises(FmuError, match=r"has gone on from this state, to which it cannot return \(fork=False\)"):
        Simulator(system, fork).AdvanceTo(1.5)
    testbed = TankScenario(path=str(fmu("Integrator")), fork=False).build()
    tank = testbed.default_context()
    testbed.snapshot(tank)
    testbed.simulator(tank).AdvanceTo(0.1)
    with pytest.raises(SnapshotError, match=r"cannot save its state \(fork=False\): take snapshots at the start only"):
        testbed.snapshot(tank)


def test_a_failing_step_names_the_time_and_what_the_fmu_says(fmu: Fmu) -> None:
    system = FmuSystem(fmu("Failing"))
    simulator, context = run(system, 0.35)
    before = context.Clone()
    with pytest.raises(
        FmuError, match=r"Failing.fmu fails at t = 0.6 s: fmi3DoStep failed with status 3 \(error\): the tank is empty"
    ):
        simulator.AdvanceTo(1.0)
    # Other contexts go on.
    Simulator(system, before).AdvanceTo(0.45)
    assert out(system, before, "x") == 0.4


def test_an_fmu_can_end_the_simulation(fmu: Fmu) -> None:
    system = FmuSystem(fmu("Ending"))
    status = Simulator(system).AdvanceTo(2.0)
    assert status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
    assert status.return_time() == 0.5
    assert "the FMU asks to end the simulation at t = 0.5 s" in status.FormatMessage()


def test_instances_are_freed_with_their_system(fmu: Fmu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    freed = tmp_path / "freed"
    monkeypatch.setenv("FREED", str(freed))
    system = FmuSystem(fmu("Counted"))
    simulator, context = run(system, 0.1)
    assert not freed.exists() or "Counted" not in freed.read_text()
    del system, simulator, context
    gc.collect()
    assert freed.read_text().split().count("Counted") == 1


def test_folders_of_killed_processes_are_removed(fmu: Fmu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    alive = ExtractionFolder()
    abandoned, unmarked = tmp_path / "vtbdrake-fmu-abandoned", tmp_path / "vtbdrake-fmu-unmarked"
    for folder in (abandoned, unmarked):
        folder.mkdir()
    (abandoned / "lock").touch()
    other = ExtractionFolder()
    assert sorted(tmp_path.iterdir()) == sorted([Path(alive.path), Path(other.path), unmarked])
    alive.remove()
    other.remove()
    assert list(tmp_path.iterdir()) == [unmarked]


def test_files_that_are_no_fmu_for_this_computer_are_refused(fmu: Fmu, tmp_path: Path) -> None:
    with pytest.raises(
        ValueError,
        match=r"has no binaries/x86_64-linux/Foreign.so, which this computer needs, but binaries for x86_64-windows",
    ):
        FmuSystem(fmu("Foreign"))
    with pytest.raises(ValueError, match=r"is no FMU for co-simulation, but for model exchange"):
        FmuSystem(fmu("Exchange"))
    with pytest.raises(FileNotFoundError, match=r"there is no FMU .*absent.fmu"):
        FmuSystem(tmp_path / "absent.fmu")
    here = Path.cwd()
    with pytest.raises(FmuError, match=r"Broken.fmu cannot be loaded: .*undefined symbol: nobody"):
        FmuSystem(fmu("Broken"))
    assert Path.cwd() == here  # which FMPy changes
    (tmp_path / "text.fmu").write_text("no zip")
    with pytest.raises(ValueError, match=r"text.fmu is no FMU that FMPy can read: "):
        FmuSystem(tmp_path / "text.fmu")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"inputs": ["v"]}, r"'v' is none of the inputs of Integrator.fmu, but no such variable; it has u"),
        (
            {"outputs": ["u"]},
            r"'u' is none of the outputs of Integrator.fmu, but one with the causality input; it has x",
        ),
        ({"inputs": "u"}, r"inputs are names in a list, not 'u'"),
        ({"inputs": {"a": "u", "b": "u"}}, r"the input 'u' of Integrator.fmu is named twice"),
        ({"parameters": {"K": 1.0}}, r"'K' is none of the parameters and start values of Integrator.fmu.*it has k, x"),
        ({"parameters": {"u": 1.0}}, r"'u' is none of .*, but one with the causality input"),
        ({"parameters": {"k": [1.0, 2.0]}}, r"'k' of Integrator.fmu has the shape \(\), not \(2,\)"),
        ({"parameters": {"k": "much"}}, r"'k' of Integrator.fmu must be a number or several, not 'much'"),
        ({"period": 0.0}, r"period is positive and finite, in s, not 0.0"),
        ({"fork": 1}, r"fork must be True or False, not 1"),
    ],
)
def test_arguments_that_do_not_fit_get_one_sentence(fmu: Fmu, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FmuSystem(fmu("Integrator"), **arguments)


def test_what_ports_cannot_carry_and_fixed_parameters_are_refused(fmu: Fmu) -> None:
    with pytest.raises(ValueError, match=r"'label' of Types.fmu is a text, not 3"):
        FmuSystem(fmu("Types"), parameters={"label": 3})
    system = FmuSystem(fmu("Dahlquist"), parameters={"k": 1.0})
    simulator, context = run(system, 0.5)
    context.get_mutable_numeric_parameter(0).SetFromVector([2.0])
    with pytest.raises(ValueError, match=r"the parameter k of Dahlquist.fmu is fixed, and cannot change once"):
        simulator.AdvanceTo(1.0)
