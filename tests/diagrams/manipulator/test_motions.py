"""The predefined motions: smooth, where they should go, and continuous whatever is commanded when."""

from __future__ import annotations

import casadi
import numpy as np
import pytest

from vtbdrake_diagrams.manipulator.arm import JOINTS, Arm
from vtbdrake_diagrams.manipulator.dynamics import function
from vtbdrake_diagrams.manipulator.motions import Motion, parameters, reference

T = 0.005
HOME_POSE = np.array(Arm().home)
VALUES = {name: np.array(value, dtype=float) for name, (value, _, _) in parameters(Arm()).items()}


def _generator() -> casadi.Function:
    p = {name: casadi.SX.sym(name, value.size) for name, value in VALUES.items()}
    sizes = {"motion": 1, "clock": 1, "start": JOINTS, "reference": JOINTS}
    x = {name: casadi.SX.sym(name, size) for name, size in sizes.items()}
    wanted, q = casadi.SX.sym("wanted"), casadi.SX.sym("q", JOINTS)
    r = reference(wanted, q, x, p, period=T)
    given = {"q_r": r.q, "v_r": r.v, "a_r": r.a, "dp": r.dp, "dv": r.dv, "da": r.da}
    return function(
        "motions", {"wanted": wanted, "q": q, **x, **p}, {**given, **{f"{n}_next": v for n, v in r.state.items()}}
    )


GENERATOR = _generator()


def play(commands: list[float], *, at: np.ndarray = HOME_POSE, state: dict | None = None) -> dict[str, np.ndarray]:
    """Return the reference in each period; the arm stays ``at``."""
    x = {"motion": 1.0, "clock": 0.0, "start": HOME_POSE, "reference": HOME_POSE} | (state or {})
    shown: dict[str, list[np.ndarray]] = {}
    for wanted in commands:
        result = GENERATOR(wanted=wanted, q=at, **x, **VALUES)
        for name in ("q_r", "v_r", "a_r", "dp", "dv", "da", "motion_next"):
            shown.setdefault(name, []).append(result[name].full().ravel())
        x = {name: result[f"{name}_next"] for name in ("motion", "clock", "start")} | {"reference": result["q_r"]}
    return {name: np.array(values) for name, values in shown.items()}


def steps(seconds: float) -> int:
    return round(seconds / T)


@pytest.mark.slow_cases
@pytest.mark.parametrize(("position", "speed", "acceleration"), [("q_r", "v_r", "a_r"), ("dp", "dv", "da")])
@pytest.mark.parametrize("motion", [Motion.SWING, Motion.PRESS, Motion.CIRCLE])
def test_derivatives_are_those_of_the_motion(motion: int, position: str, speed: str, acceleration: str) -> None:
    r = play([motion] * steps(6.1))
    for value, rate in ((position, speed), (speed, acceleration)):
        middle = (r[value][2:] - r[value][:-2]) / (2 * T)
        np.testing.assert_allclose(middle, r[rate][1:-1], atol=8e-3)


def test_swing_goes_to_its_pose_and_back() -> None:
    r = play([Motion.SWING] * steps(5.0))
    half = steps(2.5)
    np.testing.assert_allclose(r["q_r"][half], HOME_POSE + VALUES["swing"], atol=1e-6)
    np.testing.assert_allclose(r["v_r"][half], 0.0, atol=1e-6)
    np.testing.assert_allclose(r["q_r"][-1], HOME_POSE, atol=1e-6)
    np.testing.assert_array_equal(r["dp"], 0.0)


def test_swing_is_a_minimum_jerk_motion() -> None:
    r = play([Motion.SWING] * steps(1.3))
    quarter = steps(1.25)
    np.testing.assert_allclose(r["q_r"][quarter], HOME_POSE + VALUES["swing"] / 2, atol=1e-9)
    np.testing.assert_allclose(r["v_r"][quarter], 15 / 8 * VALUES["swing"] / 2.5, atol=1e-9)


def test_press_goes_straight_ahead_and_waits() -> None:
    r = play([Motion.PRESS] * steps(6.0))
    np.testing.assert_allclose(r["dp"][steps(2.0) : steps(4.0)], [[0.1, 0, 0]] * steps(2.0), atol=1e-6)
    np.testing.assert_array_equal(r["dp"][:, 1:], 0.0)
    np.testing.assert_array_equal(r["q_r"], np.tile(HOME_POSE, (steps(6.0), 1)))


def test_circle_is_one() -> None:
    r = play([Motion.CIRCLE] * steps(4.0))
    radius = VALUES["circle_radius"]
    np.testing.assert_allclose(np.linalg.norm(r["dp"] - [0, 0, radius], axis=1), radius, atol=1e-12)
    np.testing.assert_allclose(r["dp"][steps(2.0)], [0, 0, 2 * radius], atol=1e-9)


def test_a_command_waits_for_the_motion_under_way() -> None:
    r = play([Motion.SWING] * steps(1.0) + [Motion.CIRCLE] * steps(5.0))
    motion = r["motion_next"].ravel()
    assert set(motion[1 : steps(5.0) + 1]) == {Motion.SWING}
    assert set(motion[steps(5.0) + 1 :]) == {Motion.CIRCLE}


def test_motions_repeat() -> None:
    r = play([Motion.CIRCLE] * steps(8.0))
    np.testing.assert_allclose(r["dp"][steps(4.0) :], r["dp"][: steps(4.0)], atol=1e-12)


def test_follow_is_obeyed_at_once_and_stays_with_the_arm() -> None:
    at = HOME_POSE + 0.1
    r = play([Motion.SWING] * 100 + [Motion.FOLLOW] * 3, at=at)
    np.testing.assert_array_equal(r["q_r"][100:], [at] * 3)
    np.testing.assert_array_equal(r["v_r"][100:], 0.0)


def test_after_follow_the_arm_first_goes_home_from_where_it_is() -> None:
    at = HOME_POSE + 0.3
    r = play([Motion.CIRCLE] * steps(3.1), at=at, state={"motion": float(Motion.FOLLOW), "reference": HOME_POSE})
    np.testing.assert_allclose(r["q_r"][0], at)
    np.testing.assert_array_equal(r["v_r"][0], 0.0)
    motion = r["motion_next"].ravel()
    assert motion[0] == Motion.HOME
    np.testing.assert_allclose(r["q_r"][steps(3.0)], HOME_POSE, atol=1e-9)
    assert motion[-1] == Motion.CIRCLE
    assert np.abs(np.diff(r["q_r"], axis=0)).max() < 1.01 * 15 / 8 * 0.3 / 3.0 * T


def test_at_home_a_command_is_obeyed_at_once() -> None:
    assert (
        play([Motion.HOME] * 10 + [Motion.PRESS] * 3)["motion_next"].ravel().tolist()
        == [Motion.HOME] * 10 + [Motion.PRESS] * 3
    )
