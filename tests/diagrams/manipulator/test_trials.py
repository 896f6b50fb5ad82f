"""Tests of the record of a trial, against the plant's own poses and the definition of the motions."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.studies.trials import DURATIONS, LawAlongX, Track, run_trial, trial_scenario

SCENARIO = trial_scenario("admittance")


@pytest.fixture(scope="module")
def circle() -> Track:
    testbed = SCENARIO.build()
    context = testbed.default_context()
    testbed.write(context, DURATIONS)
    bridge = protocol_of(SCENARIO).bridge(SCENARIO.interface(), "memq://")
    bridge.open()
    loop = Runtime(testbed, bridge, context=context, clock=SimulatedClock())
    track = run_trial(loop, (Motion.CIRCLE,))
    bridge.close()
    return track


@pytest.mark.slow
def test_reference_of_the_circle_is_the_circle(circle: Track) -> None:
    during = circle.motion == Motion.CIRCLE
    x = circle.clock[during] / DURATIONS["dps.impl.circle_duration"]
    angle = 2 * np.pi * x**3 * (10 - 15 * x + 6 * x**2)
    radius = 0.1
    start = circle.reference[0]
    expected = start + radius * np.column_stack([0 * angle, np.sin(angle), 1 - np.cos(angle)])
    np.testing.assert_allclose(circle.reference[during], expected, atol=1e-6)
    assert during.sum() > 400


@pytest.mark.slow
def test_errors_are_the_distances_from_it(circle: Track) -> None:
    errors = circle.errors((Motion.CIRCLE,))
    assert 1e-5 < errors.max() < 0.002
    nearest = np.linalg.norm(circle.tip - circle.reference, axis=1)[circle.motion == Motion.CIRCLE]
    np.testing.assert_array_equal(errors, nearest)


def test_statics_against_the_wall_are_those_of_two_springs() -> None:
    clock = np.linspace(0.0, 4.0, 401)
    wall = SCENARIO.wall_distance - Arm().ball_radius
    wanted = wall + 0.05 * np.clip(clock - 1.0, 0.0, 1.0)
    K, k = 500.0, SCENARIO.wall_stiffness
    expected = 0.05 * K * k / (K + k)
    for inertia in (0.0, 8.0):
        force = LawAlongX(inertia, 160.0, K).force(clock, wanted, SCENARIO)
        assert (force[:100] == 0.0).all()
        assert force[-1] == pytest.approx(expected, rel=1e-3)


def test_the_resting_force_is_felt_at_the_end_of_the_wait() -> None:
    clock = np.arange(0.0, 3.0, 0.005)
    face = SCENARIO.wall_distance - Arm().ball_radius
    along_x = face + 0.04 * np.clip(np.minimum(clock, 3.0 - clock), 0.0, 1.0)
    felt = np.where(clock < 1.75, 0.0, np.where(clock < 2.0, 21.0, 99.0))
    reference, force = np.zeros((len(clock), 3)), np.zeros((len(clock), 3))
    reference[:, 0], force[:, 0] = along_x, -felt
    motion = np.full(len(clock), float(Motion.PRESS))
    track = Track(motion, clock, reference, reference, force, np.zeros((len(clock), 7)))
    K, k = 500.0, SCENARIO.wall_stiffness
    pressing = track.pressing(LawAlongX(8.0, 160.0, K), SCENARIO)
    assert pressing.predicted == pytest.approx(0.04 * K * k / (K + k))
    assert pressing.felt == pytest.approx(21.0, abs=2.0)
    assert pressing.error == pytest.approx(21.0 / pressing.predicted - 1.0, abs=0.1)


def test_the_effort_is_of_the_motions_that_are_asked_for() -> None:
    motion = np.array([Motion.SWING, Motion.PRESS, Motion.CIRCLE], dtype=float)
    torque = np.zeros((3, 7))
    torque[:, :2] = [[3.0, 4.0], [60.0, 80.0], [0.0, 1.0]]
    rest = np.zeros((3, 3))
    track = Track(motion, np.zeros(3), rest, rest, rest, torque)
    assert track.effort() == pytest.approx(np.sqrt((5.0**2 + 1.0) / 2.0))


def test_trial_that_does_not_end_is_told() -> None:
    testbed = SCENARIO.build()
    bridge = protocol_of(SCENARIO).bridge(SCENARIO.interface(), "memq://")
    bridge.open()
    loop = Runtime(testbed, bridge, clock=SimulatedClock())
    with pytest.raises(TimeoutError, match="circle"):
        run_trial(loop, (Motion.CIRCLE,), limit=0.1)
    bridge.close()
