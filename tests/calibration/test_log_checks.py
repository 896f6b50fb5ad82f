"""Recordings with defects: each is refused with its reason, mentioned, or keeps the result from being accepted."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from tests.calibration.pendulum import DRIVES, PERIOD, PendulumScenario, recorded
from tests.calibration.test_calibration import COULOMB, PARAMETERS, TRUTH, VALUES, calibrated
from vtbdrake.calibration import Calibration, CalibrationError, JointModel, JointRecording, calibrate, information
from vtbdrake.calibration.calibration_result import Verdict
from vtbdrake.calibration.inverse_dynamics import InverseDynamics
from vtbdrake.calibration.log_checks import check_log, check_torques, currents
from vtbdrake.optimization import Parameter
from vtbdrake.recording import DrivenScenario, Log, Series, read_table
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario

pytestmark = pytest.mark.one_python

LINKS = "sim.sys.pendulum"
# An angle at which the elbow is in the middle of its motion, so that it is wrapped there.
ZERO = np.array([0.0, 2.9])
SIGNALS = {"position": "joint_position", "torque": "torque"}
DOUBLE = [
    Parameter(f"{LINKS}.lower.mass", 0.3, 1.5),
    Parameter(f"{LINKS}.upper.center_of_mass[2]", -0.3, -0.05),
    Parameter("sim.act.drives.coulomb[0]", 0.0, 0.5),
]


@cache
def pendulum_log() -> Log:
    return recorded(TRUTH, 11, seconds=6.0)


@cache
def double_pendulum_log() -> Log:
    times = 0.004 * np.arange(1500)
    waves = [0.9 * np.sin(3.0 * times) * np.sin(0.7 * times), 0.5 * np.sin(5.0 * times + 0.3)]
    commands = read_table({"time": times, "u": np.stack(waves, axis=1)}, sense={}, act={"torque": "u"})
    machine = DrivenScenario(scenario=DoublePendulumScenario(), log=commands).build()
    context = machine.default_context()
    machine.write(context, {f"{LINKS}.lower.mass": 0.8})
    simulator, q = machine.simulator(context), []
    for time in times:
        simulator.AdvanceTo(time)
        q.append([float(machine.read(context, f"{LINKS}.{joint}.position")) for joint in ("shoulder", "elbow")])
    noisy = np.array(q) + 1e-4 * np.random.default_rng(0).normal(size=(times.size, 2))
    return Log("run.csv", {"joint_position": Series(times, noisy)}, commands.act)


def with_columns(log: Log, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Log:
    (name_q, q), (name_u, u) = next(iter(log.sense.items())), next(iter(log.act.items()))
    values = change(q.values, u.values)
    return Log(log.source, {name_q: Series(q.times, values[0])}, {name_u: Series(u.times, values[1])})


def of_double_pendulum(log: Log) -> Calibration:
    return calibrate(DoublePendulumScenario(), log, DOUBLE, **SIGNALS, segment=0.25)


@cache
def double_pendulum_model() -> JointModel:
    return JointModel(DoublePendulumScenario().build(), DOUBLE)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q, u: (q[:, ::-1], u[:, ::-1]), "with joints 0 and 1 exchanged"),
        (lambda q, u: (q[:, ::-1], u), "with positions 0 and 1 exchanged"),
        (lambda q, u: (np.rad2deg(q), u), "with positions that are degrees"),
        pytest.param(lambda q, u: (q * [1, -1], u * [1, -1]), "", marks=pytest.mark.slow),
        (lambda q, u: (q, u * [-1, 1]), "with the other sign of torque 0"),
        (lambda q, u: (q, 1000.0 * u), "with torques that are 1000 times too large"),
    ],
)
def test_columns_in_another_order_unit_or_sign_are_refused(
    change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], message: str
) -> None:
    log = double_pendulum_log()
    if not message:  # The elbow turns the other way in both: the model cannot be told from its mirror image alone.
        result = of_double_pendulum(with_columns(log, change))
        assert not result.accepted and result.reasons
        return
    with pytest.raises(CalibrationError, match=message):
        of_double_pendulum(with_columns(log, change))


def moved(values: np.ndarray, column: int, rows: int) -> np.ndarray:
    """Return the values with one column recorded some rows late."""
    late = values.copy()
    late[:, column] = values[np.maximum(np.arange(len(values)) - rows, 0), column]
    return late


def wrapped(q: np.ndarray) -> np.ndarray:
    return (q + np.pi) % (2.0 * np.pi) - np.pi


def checks_of(change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> tuple[str, ...]:
    """Return what the checks of the double pendulum's log say, with a defect; all of it, as one tuple."""
    log, model, signals = with_columns(double_pendulum_log(), change), double_pendulum_model(), SIGNALS
    outcome = check_log(log, DoublePendulumScenario().interface(), **signals)
    recording, dynamics = JointRecording.of(log, model, **signals), InverseDynamics(model)
    fit = dynamics.fit([recording], start=model.start)
    torques = check_torques(model, dynamics, [recording], fit)
    likely = currents(model, dynamics, [recording])
    return (*outcome.remarks, *outcome.doubts, *torques.remarks, *torques.doubts, *likely)


def test_clean_log_has_no_defect() -> None:
    assert checks_of(lambda q, u: (q, u)) == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q, u: (moved(q, 1, 8), u), "position 1 seems to be recorded 32 ms too late"),
        (lambda q, u: (moved(q, 0, 2), u), "position 0 seems to be recorded 8 ms too late"),
        (lambda q, u: (q, moved(u, 0, 10)), "torque 0 seems to be recorded [34]. ms too late"),
    ],
)
def test_one_column_that_comes_late_is_named(
    change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], message: str
) -> None:
    (doubt,) = checks_of(change)
    assert re.match(message, doubt), doubt


def test_currents_in_place_of_torques_are_named_with_their_factors() -> None:
    constants = np.array([0.4, 0.15])
    (*_, likely) = checks_of(lambda q, u: (q, u / constants))
    match = re.match(r"the torques seem to be currents, or of another unit: ([\d.]+), ([\d.]+) times as large", likely)
    assert match, likely
    # Both may be too small by one factor, as the mass of the lower link is free.
    factors = np.array([float(match[1]), float(match[2])])
    assert factors[0] / factors[1] == pytest.approx(constants[0] / constants[1], rel=0.05)
    assert factors == pytest.approx(constants, rel=0.25)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q, u: (q * [np.rad2deg(1.0), 1.0], u), "with position 0 in degrees, alone"),
        (lambda q, u: (q * [1.0, np.rad2deg(1.0)], u), "with position 1 in degrees, alone"),
        (lambda q, u: (wrapped(q + ZERO) - ZERO, u), r"\[1\] jumps by 2 pi rad 10 times, first at 0.22 s"),
        (lambda q, u: (np.rad2deg(wrapped(q + ZERO)), u), r"\[1\] jumps by 360, which are degrees 10 times"),
    ],
)
def test_degrees_of_one_joint_and_angles_that_are_wrapped_are_refused(
    change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        checks_of(change)


@pytest.mark.slow
def test_currents_are_the_likely_cause_of_a_bad_calibration() -> None:
    result = of_double_pendulum(with_columns(double_pendulum_log(), lambda q, u: (q, u / [0.4, 0.15])))
    assert not result.accepted and any("seem to be currents" in reason for reason in result.reasons), result


def test_signal_that_the_scenario_does_not_have_is_refused_with_near_names() -> None:
    log = pendulum_log()
    renamed = Log(log.source, {"positon": log.sense["position"]}, log.act)
    with pytest.raises(CalibrationError, match="has no sensor signal positon; did you mean position?"):
        calibrate(PendulumScenario(), renamed, PARAMETERS, position="positon", torque="torque")


def test_factors_of_torques_are_those_by_which_they_were_divided() -> None:
    model = JointModel(PendulumScenario().build(), PARAMETERS)
    dynamics, z = InverseDynamics(model), np.array([VALUES[each.address] for each in PARAMETERS])
    recordings = [
        JointRecording.of(with_columns(pendulum_log(), change), model, position="position", torque="torque")
        for change in (lambda q, u: (q, u), lambda q, u: (q, u / 3.0))
    ]
    assert dynamics.torque_factors(recordings[:1], z) == pytest.approx([1.0], abs=0.02)
    assert dynamics.torque_factors(recordings[1:], z) == pytest.approx([3.0], rel=0.1)
    times, torque, needed = dynamics.torques(recordings[0], z)
    assert times.shape == (len(torque),) and torque.shape == needed.shape
    assert np.std(needed - torque) < 0.1 * np.std(torque)


def test_fit_of_the_torques_finds_the_delay_of_the_drives() -> None:
    log, delay = pendulum_log(), Parameter(f"{DRIVES}.delay", 0.0, 8.0)
    model = JointModel(PendulumScenario().build(), [*PARAMETERS, delay])
    u, delays = log.act["torque"], []
    for periods in (1.0, 3.0):
        late = Log("late.csv", log.sense, {"torque": Series(u.times - periods * PERIOD, u.values)})
        recording = JointRecording.of(late, model, position="position", torque="torque")
        fit = InverseDynamics(model).fit([recording], start=model.start)
        delays.append(fit.z[model.names.index(delay.address)])
    assert delays[1] - delays[0] == pytest.approx(2.0, abs=0.2)


def test_positions_and_torques_that_are_exchanged_are_refused() -> None:
    with pytest.raises(CalibrationError, match="with positions and torques exchanged"):
        calibrated(with_columns(pendulum_log(), lambda q, u: (u, q)))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e9, "ns")])
def test_times_in_another_unit_are_refused(factor: float, unit: str) -> None:
    log = pendulum_log()
    sides = (
        {name: Series(factor * each.times, each.values) for name, each in side.items()} for side in (log.sense, log.act)
    )
    with pytest.raises(CalibrationError, match=f"with times that are {unit}"):
        calibrated(Log(log.source, *sides))


@pytest.mark.slow
def test_double_pendulum_as_it_is_recorded_is_accepted() -> None:
    result = of_double_pendulum(double_pendulum_log())
    assert result.accepted and not result.remarks, result
    assert result.parameters[f"{LINKS}.lower.mass"].value == pytest.approx(0.8, rel=5e-3)


def test_gaps_cut_a_recording_and_it_stays_right() -> None:
    log = pendulum_log()
    q, u = log.sense["position"], log.act["torque"]
    kept = (q.times < 2.0) | ((q.times > 2.5) & (q.times < 4.0)) | (q.times > 4.2)
    result = calibrated(Log("gaps.csv", {"position": Series(q.times[kept], q.values[kept])}, {"torque": u}))
    assert result.accepted and result.parameters[COULOMB].value == pytest.approx(0.2, rel=0.02)
    assert any("position has 2 gaps, 0.7" in remark for remark in result.remarks), result.remarks
    # A discrete plant takes its own steps: there, a single missing position is a gap, too.
    model = JointModel(PendulumScenario(time_step=PERIOD).build(), PARAMETERS)
    holes = np.ones(len(q), bool)
    holes[[500, 900]] = False
    recording = JointRecording.of(
        Log("holes.csv", {"position": Series(q.times[holes], q.values[holes])}, log.act),
        model,
        position="position",
        torque="torque",
    )
    assert [len(piece.times) for piece in recording.pieces(longest=1.5)] == [500, 399, len(q) - 901]


@pytest.mark.slow
def test_positions_after_the_last_torque_are_left_out() -> None:
    log = pendulum_log()
    result = calibrated(Log("cut.csv", log.sense, {"torque": log.act["torque"].between(0.0, 4.0)}))
    assert result.accepted and any("of 1500 samples of position have no torque" in each for each in result.remarks)


@pytest.mark.slow
def test_torques_of_another_clock_are_mentioned() -> None:
    log = pendulum_log()
    u = log.act["torque"]
    late = Log("late.csv", log.sense, {"torque": Series(u.times - 0.032, u.values)})
    assert not calibrated(log, segment=1.0).remarks
    result = calibrated(late, segment=1.0)
    (remark,) = (each for each in result.remarks if "vary the delay" in each)
    assert remark.startswith("with torques that act 32 ms later"), remark
    assert not result.accepted
    # With the delay among the parameters it is measured instead.
    delay = Parameter(f"{DRIVES}.delay", 0.0, 8.0)
    shifted = Log("late.csv", log.sense, {"torque": Series(u.times - 2.5 * PERIOD, u.values)})
    measured = calibrated(shifted, [*PARAMETERS, delay])
    assert measured.parameters[delay.address].value == pytest.approx(2.5, abs=0.1)
    assert not any("vary the delay" in each for each in measured.remarks)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("defect", "text"),
    [
        (lambda q, u: (q, np.clip(u, -0.8, 0.8)), "torque[0] stays at its extreme value"),
        (
            lambda q, u: (q, np.where(np.arange(len(u))[:, np.newaxis] == 700, 25.0, u)),
            "beyond its bounds [-20, 20]: other units, or another machine?",
        ),
    ],
)
def test_columns_with_a_defect_are_never_accepted(
    defect: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], text: str
) -> None:
    result = calibrated(with_columns(pendulum_log(), defect))
    assert not result.accepted
    assert any(text in each for each in (*result.remarks, *result.reasons)), (result.remarks, result.reasons)


@pytest.mark.slow
def test_sensor_that_freezes_is_not_accepted() -> None:
    def frozen(q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.where(np.arange(len(q))[:, np.newaxis] % 900 < 600, q, q[0]), u

    result = calibrated(with_columns(pendulum_log(), frozen))
    assert not any(each.verdict == Verdict.ACCEPTED for each in result.parameters.values()), result
    assert any("of the torques is not explained" in reason for reason in result.reasons), result


def test_recording_without_any_motion_is_refused() -> None:
    still = with_columns(pendulum_log(), lambda q, u: (0.0 * q, u))
    with pytest.raises(CalibrationError, match=r"no entry of position ever changes.* Either the robot stood still"):
        calibrated(still)


@pytest.mark.slow
def test_recording_of_another_machine_is_not_accepted() -> None:
    # Positions of a mass on a spring, whose motion has nothing to do with the torques.
    times = PERIOD * np.arange(1500)
    q = np.sin(7.0 * times)[:, np.newaxis] + 2e-4 * np.random.default_rng(0).normal(size=(1500, 1))
    other = Log("other.csv", {"position": Series(times, q)}, pendulum_log().act)
    result = calibrated(other)
    assert not result.accepted
    assert any("another machine" in reason for reason in result.reasons), result


@pytest.mark.slow
def test_parameter_that_changes_nothing_is_refused_by_its_name() -> None:
    # The link turns about y alone, so that its moment about x is felt by nothing.
    idle = Parameter(f"{LINKS}.link.inertia[0]", 1e-3, 0.03)
    with pytest.raises(CalibrationError, match=r"change nothing in the recordings: sim.sys.pendulum.link.inertia\[0\]"):
        calibrated(pendulum_log(), [*PARAMETERS, idle])
    told = information(PendulumScenario(), pendulum_log(), [*PARAMETERS, idle], position="position", torque="torque")
    assert told.nothing == (idle.address,) and set(told.identifiable) == {each.address for each in PARAMETERS}
    assert np.isinf(told.together[-1]) and "changes nothing: sim.sys" in str(told)


def test_optimum_beyond_a_bound_is_doubted_and_others_are_not_accepted() -> None:
    result = calibrated(pendulum_log(), [*PARAMETERS[:2], Parameter(COULOMB, 0.0, 0.15), PARAMETERS[3]])
    coulomb = result.parameters[COULOMB]
    assert coulomb.verdict == Verdict.AT_BOUND and coulomb.value == coulomb.upper == 0.15 > coulomb.lower
    assert any("deviations beyond its bound 0.15" in reason for reason in result.reasons)
    assert not any(each.verdict == Verdict.ACCEPTED for each in result.parameters.values())


@pytest.mark.slow
def test_start_on_a_bound_leaves_it() -> None:
    # The scenario begins at 0.1.
    result = calibrated(pendulum_log(), [*PARAMETERS[:2], Parameter(COULOMB, 0.1, 1.0), PARAMETERS[3]])
    assert result.accepted and result.parameters[COULOMB].value == pytest.approx(0.2, rel=0.02)


def test_start_that_is_as_good_is_said() -> None:
    # The machine is the scenario itself.
    result = calibrated(recorded({}, 12, seconds=6.0))
    assert {each.verdict for each in result.parameters.values()} == {Verdict.NO_EVIDENCE}
    assert any("the start explains" in reason for reason in result.reasons)
