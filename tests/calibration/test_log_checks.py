"""Recordings with defects: each is refused with its reason, mentioned, or keeps the result from being accepted."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from tests.calibration.pendulum import DRIVES, PERIOD, PendulumScenario, recorded
from tests.calibration.test_calibration import COULOMB, PARAMETERS, TRUTH, calibrated
from vtbdrake.calibration import CalibrationError, JointModel, JointRecording, calibrate, information
from vtbdrake.calibration.calibration import Verdict
from vtbdrake.optimization import Parameter
from vtbdrake.recording import DrivenScenario, Log, Series, read_table
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario

pytestmark = pytest.mark.one_python

LINKS = "sim.sys.pendulum"


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


def of_double_pendulum(log: Log) -> object:
    parameters = [
        Parameter(f"{LINKS}.lower.mass", 0.3, 1.5),
        Parameter(f"{LINKS}.upper.center_of_mass[2]", -0.3, -0.05),
        Parameter("sim.act.drives.coulomb[0]", 0.0, 0.5),
    ]
    return calibrate(
        DoublePendulumScenario(), log, parameters, position="joint_position", torque="torque", segment=0.25
    )


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
    with pytest.raises(CalibrationError, match="no entry of position ever changes"):
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
