"""Problem (18) on pendulums whose answer is known from their energy."""

from functools import cache
from math import inf

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig

import vtbdrake as vtb
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.optimization import Sweep
from vtbdrake.state import ArchiveError, SnapshotError
from vtbdrake.state.archive import write_archive
from vtbdrake.testbed import DpsAlone

THETA = "sim.sys.Pendulum.theta.position"
OMEGA = "sim.sys.Pendulum.theta.velocity"
DAMPING = "sim.sys.Pendulum.theta.damping"


def _angle(theta):
    return abs(theta)


def _problem(**changes):
    arguments = dict(
        scenario=PendulumScenario(simulator_config=SimulatorConfig(accuracy=1e-6, max_step_size=0.05)),
        parameters=[vtb.Parameter(OMEGA, 0.0, 8.0)],
        quality=vtb.Quality(_angle, THETA),
        horizon=1.0,  # more than half a swing
        threshold=1.0,
        sample_period=0.005,
        conditions=[{DAMPING: 0.0}],
    )
    return vtb.Problem(**{**arguments, **changes})


@cache
def _pendulum():
    testbed = PendulumScenario().build()
    return testbed, testbed.default_context()


def _speed_to_reach(angle):
    """From conservation of energy, with inertia and gravity torque read from the plant."""
    testbed, context = _pendulum()
    plant_context = testbed.plant.GetMyContextFromRoot(context)
    inertia = testbed.plant.CalcMassMatrix(plant_context)[0, 0]
    testbed.write(context, {THETA: 0.0})
    rest = testbed.plant.CalcPotentialEnergy(plant_context)
    testbed.write(context, {THETA: angle})
    return np.sqrt(2.0 * (testbed.plant.CalcPotentialEnergy(plant_context) - rest) / inertia)


def test_boundary_encloses_the_speed_that_the_energy_says():
    boundary = _problem().boundary(resolution=0.5, coarse=2.0, executor="serial", progress=False)
    assert boundary.lower <= _speed_to_reach(1.0) <= boundary.upper == boundary.lower + 0.5


@pytest.mark.slow
def test_boundary_of_a_swing_is_that_of_its_energy():
    problem = _problem(conditions=[{DAMPING: 0.0}, {DAMPING: 0.0, THETA: 0.2}])
    boundary = problem.boundary(resolution=0.1, coarse=1.0, executor="threads", progress=False)
    assert boundary.by_condition[0, 0] <= _speed_to_reach(1.0) <= boundary.by_condition[0, 1]
    # Starting at 0.2 rad, the energy to get there need not be given.
    less = np.sqrt(_speed_to_reach(1.0) ** 2 - _speed_to_reach(0.2) ** 2)
    assert boundary.by_condition[1, 0] <= less <= boundary.by_condition[1, 1]
    assert (boundary.lower, boundary.upper) == tuple(boundary.by_condition[1])
    # Few rollouts: the coarse grid and two refined cells for each condition.
    assert len(boundary.sweep) <= 2 * (9 + 2 * 9)


def test_a_threshold_of_the_first_of_two_qualities_ends_the_rollout():
    last = vtb.Quality(_angle, THETA, reading="end")
    problem = _problem(quality=[vtb.Quality(_angle, THETA), last], threshold=1.0)
    rollout = problem.rollout([8.0])
    assert rollout.end == "threshold"
    assert rollout.times[-1] == rollout.t_star < problem.task.horizon
    # The other one is read up to this end, not to the horizon.
    assert rollout.measures == (rollout.value,)
    whole = _problem(quality=last, threshold=None).rollout([8.0])
    assert whole.value != rollout.value


def test_a_sweep_finds_the_best_and_stops_at_the_threshold():
    sweep = _problem().sweep(points=9, executor="serial", progress=False)
    speeds = sweep.points[:, 0]
    np.testing.assert_array_equal(speeds, np.arange(9.0))
    reached = speeds > _speed_to_reach(1.0)
    np.testing.assert_array_equal(sweep.exceeded, reached)
    assert (sweep.t_star[reached] < 1.0).all()
    # Below the threshold, h is the amplitude.
    for speed, h in zip(speeds[~reached], sweep.h[~reached], strict=True):
        assert _speed_to_reach(h) == pytest.approx(speed, rel=2e-4, abs=1e-6)
    assert sweep.best.value == sweep.h.max()
    assert sweep.best.parameters == {OMEGA: speeds[int(np.argmax(sweep.h))]}


def _two():
    return _problem(parameters=[vtb.Parameter(OMEGA, 0.0, 2.0), vtb.Parameter(THETA, 0.0, 0.5)], threshold=inf)


def test_two_parameters_make_a_grid():
    problem = _two()
    sweep = problem.sweep(points=(3, 2), executor="serial", progress=False)
    np.testing.assert_array_equal(sweep.points, [[0, 0], [0, 0.5], [1, 0], [1, 0.5], [2, 0], [2, 0.5]])
    # h is the amplitude: energies add up.
    for (omega, theta), h in zip(sweep.points, sweep.h, strict=True):
        expected = np.sqrt(omega**2 + _speed_to_reach(theta) ** 2)
        assert _speed_to_reach(h) == pytest.approx(expected, rel=2e-3, abs=1e-6)
    assert sweep.best.parameters == {OMEGA: 2.0, THETA: 0.5}
    squares = problem.sweep(np.int64(2), executor="serial", progress=False)
    np.testing.assert_array_equal(squares.points, [[0, 0], [0, 0.5], [2, 0], [2, 0.5]])


def test_the_worst_condition_counts_for_the_best_point():
    problem = _problem(conditions=[{DAMPING: 0.0}, {DAMPING: 1.0}], threshold=inf)
    sweep = problem.sweep(values=[1.0, 2.0], executor="serial", progress=False)
    assert sweep.condition.tolist() == [0, 1, 0, 1]
    assert sweep.best.value == sweep.h[3] < sweep.h[2]


def test_a_sweep_survives_its_file(tmp_path):
    sweep = _problem().sweep(points=3, executor="serial", record=[THETA, "plant.state"], progress=False)
    sweep.save(tmp_path / "sweep.vtb")
    loaded = Sweep.load(tmp_path / "sweep.vtb")
    assert all(a.identical(b) for a, b in zip(sweep.rollouts, loaded.rollouts, strict=True))
    assert loaded.boundary() == sweep.boundary()
    assert loaded.parameters == sweep.parameters
    assert loaded.scenario == sweep.scenario
    (tmp_path / "half.vtb").write_bytes((tmp_path / "sweep.vtb").read_bytes()[:1000])
    with pytest.raises(ArchiveError, match="damaged"):
        Sweep.load(tmp_path / "half.vtb")
    write_archive(tmp_path / "other.vtb", kind="vtbdrake sweep", version=3, header={"parameters": []}, arrays={})
    with pytest.raises(ArchiveError, match="it has no 'conditions'"):
        Sweep.load(tmp_path / "other.vtb")


def test_a_sweep_is_a_table():
    sweep = _problem(conditions=[{}, {THETA: 0.1}]).sweep(points=2, executor="serial", progress=False)
    frame = sweep.to_dataframe()
    assert list(frame.columns) == [OMEGA, "condition", "h", "t_star", "end", "message", "wall_time"]
    np.testing.assert_array_equal(frame["h"], sweep.h)
    assert frame[OMEGA].tolist() == [0.0, 0.0, 8.0, 8.0]


def test_a_single_rollout_has_its_state_at_t_star():
    rollout = _problem().rollout([5.0])
    assert rollout.end == "threshold"
    assert rollout.state.time == rollout.t_star
    assert abs(rollout.state[THETA]) == rollout.h > 1.0
    by_address = _problem().rollout({OMEGA: 5.0})
    assert by_address.identical(rollout)
    assert _problem().rollout([5.0], run_on=True).exceedances[0] == rollout.t_star


@pytest.mark.parametrize(("lower", "upper"), [(1.0, 1.0), (2.0, 1.0), (0.0, inf), (float("nan"), 1.0)])
def test_a_range_that_is_empty_or_reversed_is_refused(lower, upper):
    with pytest.raises(ValueError, match="must be finite and not empty"):
        vtb.Parameter(OMEGA, lower, upper)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"parameters": [vtb.Parameter("sim.sys.Pendulum.arm.mas", 0.0, 1.0)]},
            "did you mean sim.sys.Pendulum.arm.mass",
        ),
        ({"parameters": [vtb.Parameter(DAMPING, -1.0, 1.0)]}, r"exceeds its bounds \[0, inf\] N m s/rad"),
        ({"parameters": [vtb.Parameter("time", 0.0, 1.0)]}, "is derived"),
        ({"parameters": [vtb.Parameter("sim.sys.Pendulum.arm.inertia", 0.0, 1.0)]}, "such as .*inertia.0."),
        ({"parameters": [vtb.Parameter(OMEGA, 0.0, 1.0)] * 2}, "given twice"),
        ({"conditions": []}, "at least one condition"),
        ({"conditions": [{OMEGA: 1.0}]}, "no condition can set it"),
        ({"conditions": [{DAMPING: -1.0}]}, "must lie in"),
        ({"quality": vtb.Quality(_angle, "sim.sys.Pendulum.thta.position")}, "did you mean"),
        ({"horizon": -1.0}, "horizon t_m must be positive"),
        ({"quality": _angle}, r"give quality as Quality\(f, of=.* not as <function _angle"),
        ({"quality": None}, "give quality as .* not as None"),
        ({"quality": [vtb.Constraint(_angle, THETA, at_most=1.0)]}, "give quality as .* Constraint.* does not fit"),
        ({"constraints": vtb.Constraint(_angle, THETA, at_most=1.0)}, "give constraints as .* not as Constraint"),
        ({"constraints": [vtb.Quality(_angle, THETA)]}, "give constraints as .* Quality.* does not fit"),
        ({"parameters": OMEGA}, r"give parameters as \[Parameter\(address, lower, upper\), ...\], not as 'sim"),
        ({"parameters": [OMEGA]}, "give parameters as .* 'sim.*' does not fit"),
        ({"conditions": {DAMPING: 0.1}}, r"give conditions as \[{address: value, ...}, ...\], not as {"),
        ({"conditions": [DAMPING]}, "give conditions as .* does not fit"),
        ({"risk": ["worst"]}, r"not by \['worst'\]"),
        ({"scenario": PendulumScenario}, "a scenario is an instance.*, not <class"),
        ({"start": "file.vtb"}, "Snapshot.load.* not 'file.vtb'"),
        ({"horizon": "3"}, "the horizon t_m must be a number, not '3'"),
        ({"threshold": True}, "the threshold f_m must be a number, not True"),
    ],
)
def test_a_problem_that_makes_no_sense_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        _problem(**changes)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda p: p.rollout([9.0]), r"lies outside its range \[0, 8\]"),
        (lambda p: p.rollout([1.0, 2.0]), r"has 1 entries, but the one given has shape \(2,\)"),
        (lambda p: p.rollout({THETA: 1.0}), "wrong about"),
        (lambda p: p.sweep(), "either the number of points"),
        (lambda p: p.sweep(points=1), "at least two points"),
        (
            lambda p: p.sweep(points=10**13),
            "10,000,000,000,000 points is larger than the largest, 10,000,000: take fewer",
        ),
        (lambda p: p.state([5.0], t="late"), "the time t must be a number, not 'late'"),
        (lambda p: p.sweep(points=3, executor="gpu"), "not 'gpu'"),
        (lambda p: p.sweep(values=np.zeros((3, 4))), r"have shape \(n, 1\), not \(3, 4\)"),
        (lambda p: _two().sweep(values=np.zeros((3, 4))), r"have shape \(n, 2\), not \(3, 4\)"),
        (lambda p: _two().sweep(values=[0.0, 0.1, 0.2]), r"have shape \(n, 2\), not \(3,\)"),
        (lambda p: p.boundary(resolution=2.0, coarse=1.0), "0 < resolution <= coarse"),
        (lambda p: _problem(threshold=inf).boundary(resolution=1.0, coarse=1.0), "finite threshold"),
        (lambda p: _problem(parameters=[]).sweep(points=3), "one or two parameters, not 0"),
        (lambda p: p.sweep(points=3.5), "a number of points must be a whole number, not 3.5"),
        (lambda p: p.sweep(points="3"), "give points as one whole number, .* not as '3'"),
        (lambda p: p.sweep(values="fast"), r"numbers of shape \(n, p\), not 'fast'"),
        (lambda p: p.sweep(values=["1.5"]), r"numbers of shape \(n, p\), not \['1.5'\]"),
        (lambda p: p.sweep(points=3, executor="threads", workers=1.5), "workers must be a whole number, not 1.5"),
        (lambda p: p.rollout([1.0], condition=1), "no condition 1: it has 1"),
        (lambda p: p.rollout([1.0], condition=-1), "no condition -1"),
        (lambda p: p.rollout([1.0], condition=None), "the number of a condition must be a number, not None"),
        (lambda p: p.rollout(["1.0"]), r"takes a number in \[0, 8\], not '1.0'"),
        (lambda p: p.state([5.0], t=np.nan), "nan s is not a sample time"),
        (lambda p: p.boundary(resolution="1", coarse=1.0), "the resolution must be a number, not '1'"),
    ],
)
def test_a_question_that_makes_no_sense_is_refused(ask, message):
    with pytest.raises(ValueError, match=message):
        ask(_problem())


def test_what_to_record_may_be_one_address():
    assert list(_problem().rollout([1.0], record=THETA).record) == [THETA]


def test_a_sweep_of_failures_has_no_best_point():
    scenario = AcrobotScenario(
        simulator_config=SimulatorConfig(
            integration_scheme="explicit_euler", max_step_size=0.05, use_error_control=False
        )
    )
    problem = vtb.Problem(
        scenario=scenario,
        parameters=[vtb.Parameter("dps.gain[2]", 100.0, 1000.0)],
        quality=vtb.Quality(_angle, "sim.sys.Acrobot.elbow.position"),
        horizon=20.0,
        conditions=[{"sim.sys.Acrobot.shoulder.position": 1.0}],
    )
    sweep = problem.sweep(points=2, executor="serial", progress=False)
    assert sweep.failed.all()
    with pytest.raises(ValueError, match="no point .* the first failure: "):
        _ = sweep.best


def test_a_start_that_does_not_fit_is_refused_at_once():
    scenario = _problem().scenario
    alone = DpsAlone(scenario)
    with pytest.raises(SnapshotError, match="the snapshot is of a DPS alone, without a world"):
        _problem(start=alone.snapshot(alone.default_context()))
    other = AcrobotScenario().build()
    with pytest.raises(SnapshotError, match="the snapshot is of another scenario"):
        _problem(start=other.snapshot(other.default_context()))


@pytest.mark.slow
def test_problem_sweep_boundary_and_rollout_show_themselves():
    problem = _problem(conditions=[{DAMPING: 0.0}, {DAMPING: 0.1}])
    assert repr(problem) == f"Problem(PendulumScenario: _angle over {OMEGA} in [0, 8], horizon 1 s)"
    parts = problem._repr_html_()
    for shown in (OMEGA, "[0, 8] rad/s", "_angle of " + THETA, "threshold", "2 (Worst())"):
        assert shown in parts
    sweep = problem.sweep(points=3, executor="serial", progress=False)
    assert repr(sweep) == f"Sweep(6 rollouts over {OMEGA} in [0, 8])"
    assert f"{sweep.best.value:g} at {OMEGA} = {sweep.best.parameters[OMEGA]:g}" in sweep._repr_html_()
    boundary = sweep.boundary()
    assert repr(boundary) == f"Boundary({boundary})" and str(boundary) in boundary._repr_html_()
    rollout = problem.rollout([8.0])
    assert repr(rollout).startswith(f"ProblemRollout({{{DAMPING}=0.0, {OMEGA}=8.0}}: threshold after")
    for shown in (sweep, boundary, rollout):
        assert shown._repr_html_().count('<img src="data:image/png;base64,') == 1
        assert len(repr(shown)) < 300


GAIN, ELBOW = "dps.gain", "sim.sys.Acrobot.elbow.velocity"


@pytest.mark.parametrize(
    ("parameters", "condition", "told"),
    [
        (
            [f"{GAIN}[0]"],
            {GAIN: [1.0, 0.0, 0.0, 0.0]},
            rf"{GAIN}\[0\] is a parameter, so that no condition can set {GAIN}",
        ),
        ([f"{GAIN}[0]"], {f"{GAIN}[0]": 1.0}, rf"{GAIN}\[0\] is a parameter, so that no condition can set it"),
        ([f"{GAIN}[1]"], {GAIN: [0.0] * 4, f"{GAIN}[0]": 1.0}, rf"{GAIN}\[1\] is a parameter"),
        (
            [ELBOW],
            {GAIN: [0.0] * 4, f"{GAIN}[0]": 1.0},
            "one is an entry of",
        ),
        ([f"{GAIN}[00]"], {}, r"there is no variable 'dps\.gain\[00\]'"),
        ([ELBOW], {f"{GAIN}[00]": 1.0}, r"there is no variable 'dps\.gain\[00\]'"),
        ([f"{GAIN}[٠]"], {}, "there is no variable"),
    ],
)
def test_an_entry_and_its_array_are_not_set_twice(parameters, condition, told):
    with pytest.raises(ValueError, match=told):
        vtb.Problem(
            scenario=AcrobotScenario(),
            parameters=[vtb.Parameter(address, -1.0, 1.0) for address in parameters],
            quality=vtb.Quality(abs, ELBOW),
            horizon=1.0,
            conditions=[condition],
        )


def test_entries_of_one_array_are_varied_beside_conditions_on_others():
    problem = vtb.Problem(
        scenario=AcrobotScenario(),
        parameters=[vtb.Parameter(f"{GAIN}[0]", -1.0, 1.0)],
        quality=vtb.Quality(lambda gain: abs(gain[0]) + 10.0 * abs(gain[1]), GAIN),
        horizon=0.1,
        conditions=[{f"{GAIN}[1]": 0.5}],
    )
    assert problem.rollout([0.25]).value == 5.25
