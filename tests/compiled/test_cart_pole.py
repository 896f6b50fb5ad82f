"""The cart-pole's testbed, compiled with its sensors and its DPS."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import casadi
import numpy as np
import pytest
from pydrake.systems.framework import Context

from vtbdrake.compiled import CompiledRollouts, UnsupportedTestbedError, program
from vtbdrake.compiled.compiled_rollouts import CompiledBatch
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.rollout import RolloutTask, SerialExecutor
from vtbdrake.rollout.executor import Parameters
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake_diagrams.cart_pole import CartPoleScenario

HORIZON, SAMPLE_PERIOD = 1.0, 0.03
OUTPUTS = ("plant.state", "dps.force", "dps.env.discrete_state_0", "sim.sys.cart_pole.pole_pin.position", "time")
ANGLE = "sim.sys.cart_pole.pole_pin.position"
MASS, DAMPING, BIAS = (
    "sim.sys.cart_pole.pole.mass",
    "sim.sys.cart_pole.pole_pin.damping",
    "sim.sense.joint_position.bias",
)

ERRORS = ErrorModel(
    noise=0.01,
    bias=0.1,
    drift=0.02,
    quantization=0.003,
    latency=2,
    dropout=0.2,
    outlier_probability=0.2,
    outlier_size=0.5,
)
SCENARIOS = {
    "exact": CartPoleScenario(),
    "mental": CartPoleScenario().mental(),
    "errors": CartPoleScenario(position_errors=ERRORS, velocity_errors=replace(ERRORS, seed=1, latency=0)),
}


def plans(n: int) -> np.ndarray:
    knots = np.random.default_rng(0).uniform(-60.0, 60.0, (n, 10))
    return np.column_stack([np.zeros(n), knots])


_BUILT: dict[int, tuple[Scenario, VirtualTestbed]] = {}


def built(scenario: Scenario) -> VirtualTestbed:
    """Return the testbed of a scenario, which all tests share."""
    if id(scenario) not in _BUILT:
        _BUILT[id(scenario)] = scenario, scenario.build()
    return _BUILT[id(scenario)][1]


def compiled(scenario: Scenario, **options) -> CompiledRollouts:
    arguments = {"horizon": HORIZON, "sample_period": SAMPLE_PERIOD, "outputs": OUTPUTS, "compile": False}
    return built(scenario).compiled(**{**arguments, **options})


def assert_equals_drake(batch: CompiledBatch, task: RolloutTask, points: Sequence[Parameters]) -> None:
    """Check the recorded outputs of all rollouts, which are valid."""
    with SerialExecutor() as executor:
        for i, result in executor.run(task, points):
            for address in task.record:
                np.testing.assert_allclose(batch.outputs[address][i], result.record[address], rtol=1e-11, atol=1e-11)
    assert batch.valid.all()


@pytest.mark.parametrize("name", SCENARIOS)
def test_equals_rollouts_in_drake(name: str) -> None:
    scenario = SCENARIOS[name]
    batch = compiled(scenario, parameters=[MASS])({"u.plan": plans(3), MASS: [0.8, 1.0, 1.3]})
    points = [{"u.plan": plan, MASS: mass} for plan, mass in zip(plans(3), (0.8, 1.0, 1.3), strict=True)]
    task = RolloutTask(scenario, HORIZON, sample_period=SAMPLE_PERIOD, record=OUTPUTS)
    assert_equals_drake(batch, task, points)


@pytest.mark.slow
def test_another_compiler_computes_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ziglang", reason="the extra 'compiler' is not installed")
    plan = {"u.plan": plans(3)}
    expected = compiled(SCENARIOS["errors"])(plan)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))  # no cc
    monkeypatch.delenv("CC", raising=False)
    by_zig = compiled(SCENARIOS["errors"], compile=True)(plan)
    assert list((tmp_path / "cache" / "vtbdrake" / "casadi").glob("*.so"))
    for address in OUTPUTS:
        np.testing.assert_allclose(
            by_zig.outputs[address], expected.outputs[address], rtol=1e-12, atol=1e-12, err_msg=address
        )


def test_noise_is_that_of_the_time_at_which_a_rollout_begins() -> None:
    testbed, sensor = built(SCENARIOS["errors"]), "sim.sense.joint_position.joint_encoders"
    options = {"horizon": 0.1, "sample_period": 0.02, "outputs": (sensor,), "compile": False}
    rollouts = testbed.compiled(**options)
    # Rollouts from 2.5 ms and from 0 s have the same second instant, 5 ms.
    for t0 in (0.0025, 0.0, 0.005):
        context = testbed.default_context()
        context.SetTime(t0)
        measured, fresh = (each(context=context).outputs[sensor] for each in (rollouts, testbed.compiled(**options)))
        assert measured.any()
        np.testing.assert_array_equal(measured, fresh)


def test_begins_in_any_context() -> None:
    scenario = SCENARIOS["errors"]
    testbed = built(scenario)
    rollouts = testbed.compiled(horizon=0.4, sample_period=0.02, outputs=OUTPUTS, compile=False)
    context = testbed.default_context()
    testbed.write(context, {"u.plan": plans(1)[0]})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(0.3)
    batch = rollouts(context=context)
    states = [testbed.read(context, "plant.state")]
    for k in range(1, 21):
        simulator.AdvanceTo((15 + k) * 0.02)
        states.append(testbed.read(context, "plant.state"))
    np.testing.assert_allclose(batch.outputs["plant.state"][0], states, rtol=1e-11, atol=1e-11)


def test_threads_and_batches_change_nothing() -> None:
    values = {"u.plan": plans(150)}
    alone = compiled(SCENARIOS["mental"], workers=1)
    threads = compiled(SCENARIOS["mental"], workers=3)
    state = threads(values).outputs["plant.state"]
    np.testing.assert_array_equal(state, alone(values).outputs["plant.state"])
    single = alone({"u.plan": values["u.plan"][149]})
    np.testing.assert_array_equal(state[149], single.outputs["plant.state"][0])


def test_long_rollouts_are_made_in_smaller_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each group has the noise of its own seeds."""
    seed, measured = "sim.sense.joint_position.seed", "sim.sense.joint_position.joint_encoders"
    options = {"parameters": [seed], "outputs": [measured], "check": False}
    values = {seed: np.array([7.0, 8.0, 7.0, 9.0, 10.0])}
    sizes = []
    buffers = program.Buffers
    monkeypatch.setattr(program, "Buffers", lambda f, **options: sizes.append(f.nnz_out()) or buffers(f, **options))
    together = compiled(SCENARIOS["errors"], **options)(values).outputs[measured]
    monkeypatch.setattr(program, "MOST_BYTES", 1)
    apart = compiled(SCENARIOS["errors"], **options)(values).outputs[measured]
    np.testing.assert_array_equal(apart, together)
    assert len(np.unique(together[:, -1, 0])) == 4
    assert sizes == [5 * sizes[1], sizes[1]]


def test_machine_code_gives_the_same_numbers() -> None:
    values = {"u.plan": plans(4)}
    by_machine = compiled(SCENARIOS["exact"], compile=True)(values).outputs["plant.state"]
    np.testing.assert_array_equal(by_machine, compiled(SCENARIOS["exact"])(values).outputs["plant.state"])


def test_slope_is_that_of_differences() -> None:
    rollouts = compiled(SCENARIOS["mental"], outputs=["time", "plant.state"])
    plan = casadi.MX.sym("plan", 11)
    state = rollouts.expressions({"u.plan": plan})["plant.state"]
    assert state.shape == (4, len(rollouts.times))
    slope = casadi.Function("slope", [plan], [casadi.jacobian(state[1, -1], plan)])
    exact = slope(plans(1)[0]).full().ravel()

    def angle(k: int, step: float) -> float:
        plan = plans(1)[0]
        plan[k] += step
        return rollouts({"u.plan": plan}).outputs["plant.state"][0, -1, 1]

    differences = [(angle(k, 1e-4) - angle(k, -1e-4)) / 2e-4 for k in range(1, 11)]
    np.testing.assert_allclose(exact[1:], differences, rtol=1e-5, atol=1e-8)


INERTIA = "sim.sys.cart_pole.pole.inertia"


def with_inertia() -> tuple[VirtualTestbed, Context]:
    """Return a testbed, and a context in which the pole is a body that swings, not a point."""
    testbed = built(SCENARIOS["exact"])
    context = testbed.default_context()
    testbed.write(context, {INERTIA: [0.02, 0.05, 0.04, 0.001, 0.002, 0.003], ANGLE: 1.0})
    return testbed, context


@pytest.mark.slow_cases
@pytest.mark.parametrize("values", [{MASS: 2.0}, {MASS: 2.0, f"{INERTIA}[1]": 0.03}, {f"{INERTIA}[1]": 0.03}])
def test_mass_scales_the_inertia(values: dict[str, float]) -> None:
    testbed, context = with_inertia()
    rollouts = testbed.compiled(
        horizon=0.3, parameters=[MASS, INERTIA], outputs=["plant.state"], context=context, compile=False
    )
    computed = rollouts(values).outputs["plant.state"][0, -1]
    testbed.write(context, values)
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(0.3)
    np.testing.assert_allclose(computed, testbed.read(context, "plant.state"), rtol=1e-11, atol=1e-11)


def test_writes_mass_and_inertia() -> None:
    testbed, context = with_inertia()
    rollouts = testbed.compiled(horizon=0.1, parameters=[MASS, INERTIA], context=context, compile=False, check=False)
    (z,) = rollouts.filled(rollouts.z_of(context), {MASS: 2.0})
    rollouts.walker.write(z, context)
    np.testing.assert_allclose(rollouts.walker.read(context), z, rtol=1e-14)
    assert testbed.read(context, INERTIA)[0] == pytest.approx(0.04)


def test_inertia_is_that_of_a_rigid_body() -> None:
    testbed, context = with_inertia()
    rollouts = testbed.compiled(horizon=0.1, parameters=[INERTIA], context=context, compile=False, check=False)
    with pytest.raises(ValueError, match="belongs to no rigid body"):
        rollouts({f"{INERTIA}[0]": [0.02, 0.2]})


def test_context_of_another_testbed_is_refused() -> None:
    rollouts, other = compiled(SCENARIOS["exact"], check=False), SCENARIOS["exact"].build().default_context()
    with pytest.raises(ValueError, match="no context of this testbed"):
        rollouts(context=other)
    with pytest.raises(ValueError, match="no context of this testbed"):
        compiled(SCENARIOS["exact"], context=other)


@pytest.mark.parametrize(
    "wrong", [casadi.MX.sym("plan", 4), casadi.SX.sym("plan", 11), np.zeros(4), None, "plan"], ids=repr
)
def test_expressions_have_the_shape_of_their_variable(wrong: object) -> None:
    rollouts = compiled(SCENARIOS["exact"], check=False)
    with pytest.raises(ValueError, match=r"u.plan takes a casadi.MX of the shape \(11, 1\), or numbers, not \w+ of"):
        rollouts.expressions({"u.plan": wrong})


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        (MASS, "compiled in: name it in parameters="),
        ("sim.sys.cart_pole.pole_pin.locked", "no input of a compiled plant"),
        ("T_sense.joint_position", "positions of the switches"),
        ("sim.sys.cart_pole.pole.roll", "it is computed from others"),
    ],
)
def test_refuses_to_vary_what_is_compiled_in(address: str, reason: str) -> None:
    rollouts = compiled(SCENARIOS["exact"])
    with pytest.raises(ValueError, match=reason):
        rollouts({address: 1.0})


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"horizon": 0.0}, "the horizon is a positive time in seconds, not 0.0"),
        ({"sample_period": np.inf}, "the sample period is a positive time in seconds, not inf"),
        ({"sample_period": 1e-9}, r"1e\+09 samples and updates, but at most 1e\+07 fit into memory"),
        ({"sample_period": 1e-320}, "has inf samples and updates"),
        ({"horizon": 1e5}, r"e\+07 samples and updates"),
        ({"outputs": "plant.velocity"}, "no variable and no port 'plant.velocity'"),
        ({"parameters": "u.goal"}, "there is no variable 'u.goal'"),
        ({"parameters": ["sim.sense.joint_position.latency"]}, "a latency is compiled in"),
        ({"workers": 0}, "at least one worker, not 0"),
        ({"workers": 1.5}, "a whole number, not 1.5"),
        ({"compile": "yes"}, "compile must be True or False, not 'yes'"),
        ({"check": "no"}, "check must be True or False, not 'no'"),
        (
            {"outputs": ["plant.generalized_acceleration"]},
            "generalized_acceleration, which is not compiled: use its state",
        ),
    ],
)
def test_refuses_arguments_that_make_no_sense(options: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        compiled(SCENARIOS["errors"], **options)


@pytest.mark.parametrize("send", [pickle.dumps, copy.deepcopy])
def test_is_not_sent_but_its_scenario(send: Callable[[object], object]) -> None:
    rollouts = compiled(SCENARIOS["errors"], check=False)
    with pytest.raises(TypeError, match="send the scenario, build it and compile it there"):
        send(rollouts)
    with pytest.raises(TypeError, match="a VirtualTestbed cannot be pickled or copied: send its scenario"):
        send(SCENARIOS["errors"].build())


def test_refuses_values_that_do_not_fit() -> None:
    rollouts = compiled(SCENARIOS["exact"])
    with pytest.raises(ValueError, match=r"shape \(11,\)"):
        rollouts({"u.plan": np.zeros(10)})
    with pytest.raises(ValueError, match=r"lie in \[-1e\+09"):
        rollouts({"u.plan": np.full(11, 100.0)})
    with pytest.raises(ValueError, match="2 of .*bias.*, 3 of u.plan"):
        rollouts({BIAS: np.zeros((2, 2)), "u.plan": plans(3)})


def test_errors_that_are_zero_are_named_to_be_varied() -> None:
    noise = "sim.sense.joint_position.noise"
    with pytest.raises(ValueError, match="name it in parameters="):
        compiled(SCENARIOS["exact"])({noise: 0.1})
    batch = compiled(SCENARIOS["exact"], parameters=[noise])({noise: [0.0, 0.1], "u.plan": plans(1)[0]})
    perceived = batch.outputs["dps.env.discrete_state_0"]
    assert np.std(perceived[1, :, 0] - perceived[0, :, 0]) == pytest.approx(0.1, rel=0.4)


def test_refuses_a_context_with_other_masses() -> None:
    testbed = built(SCENARIOS["exact"])
    rollouts = testbed.compiled(horizon=0.1, sample_period=0.05, compile=False)
    context = testbed.default_context()
    testbed.write(context, {DAMPING: 0.3})
    with pytest.raises(UnsupportedTestbedError, match="plant differs from what was compiled"):
        rollouts(context=context)


def test_refuses_the_real_side() -> None:
    testbed = built(SCENARIOS["exact"])
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.joint_position").FixValue(context, np.zeros(2))
    testbed.switch(context, sense={"joint_position": "real"})
    rollouts = testbed.compiled(horizon=0.1, sample_period=0.05, compile=False)
    with pytest.raises(UnsupportedTestbedError, match="switches differs from what was compiled"):
        rollouts(context=context)


@pytest.mark.parametrize("decides_at", [None, 0.0, 0.12])
def test_a_reasoner_on_board_shows_its_candidate(decides_at: float | None) -> None:
    scenario = CartPoleScenario(onboard=True).mental()
    candidate, candidate_at = "dps.planner.candidate", "dps.planner.candidate_at"
    outputs = ("plant.state", "dps.planner.decision", "dps.planner.valid", "dps.planner.sampled_at")
    point = {} if decides_at is None else {candidate_at: decides_at}
    batch = compiled(scenario, outputs=outputs)({candidate: plans(2), **point})
    points = [{candidate: plan, **point} for plan in plans(2)]
    task = RolloutTask(scenario, HORIZON, sample_period=SAMPLE_PERIOD, record=outputs)
    assert_equals_drake(batch, task, points)
    assert batch.outputs["dps.planner.valid"].any() == (decides_at is not None)


def test_a_part_that_reasons_is_not_compiled() -> None:
    with pytest.raises(UnsupportedTestbedError, match="dps.planner: OnboardReasoner reasons itself"):
        compiled(CartPoleScenario(onboard=True))
