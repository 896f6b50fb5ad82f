"""O1: the placements, and the capture along which they are judged."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

import vtbdrake as vtb
from tests.testbeds import PendulumScenario
from vtbdrake.components.rendering import RenderingError, check_rendering
from vtbdrake.rollout import MotionError, RolloutRunner
from vtbdrake.state.systems import pose_from_array
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.bodies import Servicer, Target
from vtbdrake_diagrams.satellite.studies.mount import (
    BY_HAND,
    COUNT,
    HORIZON,
    PARAMETERS,
    TELLING,
    MountAnswer,
    Placement,
    distance_from_foot,
    entries,
    mount_problem,
    pose,
    scenario,
)

# The bar in B when the target faces the servicer, as in the scenario.
BAR = RigidTransform([SatelliteScenario().distance, 0.0, 0.0]) @ Target().X_TH.translation()


@pytest.fixture(scope="module")
def problem():
    return mount_problem(seeds=(0,))


def test_tilt_and_pan_are_those_of_the_model():
    servicer = Servicer()
    _, y, z = servicer.camera_position
    X_BC = pose_from_array(pose(y, z, tilt=servicer.camera_tilt))
    assert X_BC.IsNearlyEqualTo(servicer.X_BC, 1e-12)
    left = pose_from_array(pose(0.0, 0.0, pan=0.2)).rotation() @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(left, [np.cos(0.2), np.sin(0.2), 0.0], atol=1e-12)


@pytest.mark.parametrize("name", list(BY_HAND)[1:])
def test_placements_by_hand_look_at_the_bar(name):
    p_CH = pose_from_array(BY_HAND[name]).inverse() @ BAR
    np.testing.assert_allclose(p_CH[:2], 0.0, atol=1e-9)
    assert p_CH[2] > 1.0


def test_placements_by_hand_keep_the_limits():
    for value in BY_HAND.values():
        assert all(p.lower <= x <= p.upper for p, x in zip(PARAMETERS, entries(value), strict=True))
        assert distance_from_foot(value) >= 0.18


def test_a_capture_led_by_the_camera_is_refused():
    with pytest.raises(MotionError, match=r"sim.sense.docking_camera -> .*markers.* -> .*T_act"):
        vtb.Problem(
            scenario=replace(scenario(), perception="camera", onlookers=""),
            parameters=[PARAMETERS[0]],
            quality=vtb.Quality(float, of=COUNT),
            horizon=1.0,
            motion=vtb.RecordedMotion(0.22),
        )


def test_the_supervisor_is_not_varied_along_a_recorded_motion():
    with pytest.raises(MotionError, match="the motion depends on dps.impl.supervisor.standoff"):
        mount_problem([vtb.Parameter("dps.impl.supervisor.standoff", 0.2, 0.3)], seeds=(0,))


@pytest.mark.slow
@pytest.mark.one_python
def test_along_the_recorded_capture_the_count_is_the_same(problem):
    try:
        check_rendering()
    except RenderingError as error:
        pytest.skip(str(error))
    point = problem.values(entries(BY_HAND["on the right"]), condition=0)
    task = replace(problem.task, horizon=3.0, sample_period=1.0)
    along = RolloutRunner(task, problem.testbed).run(point)
    whole = RolloutRunner(replace(task, motion=None), problem.testbed).run(point)
    assert along.identical(whole)
    assert whole.quality.max() >= 4.0


DAMPING = "sim.sys.Pendulum.theta.damping"


def counted(values, *, failing=()):
    """Return a sweep in which as many markers are counted as the value says, at all times; some of the values fail."""

    def markers(count):
        return np.nan if count in failing else count

    problem = vtb.Problem(
        scenario=PendulumScenario(),
        parameters=[vtb.Parameter(DAMPING, 0.0, 12.0)],
        quality=vtb.Quality(markers, of=DAMPING, reading="integral", upper=12.0),
        horizon=HORIZON,
        sample_period=2.0,
        constraints=[vtb.Constraint(float, of=DAMPING, at_most=6.0)],
    )
    return problem.sweep(values=list(values), executor="serial", progress=False)


def placement(*counts, failing=()):
    return Placement("", pose(0.0, 0.0), tuple(counted(counts, failing=failing).rollouts))


def test_answer_holds_where_nothing_by_hand_or_on_the_grid_sees_more():
    by_hand = (placement(2.0, 4.0), placement(1.0, 1.5))
    # 7 markers lie where the constraint is violated.
    answer = MountAnswer(placement(5.0, 5.5), by_hand, (), counted([1.0, 5.0, 5.5, 7.0]))
    assert (answer.best.mean, answer.best.most) == pytest.approx((5.25, 5.25))
    assert answer.gain == pytest.approx(2.25)
    assert answer.best_on_grid == pytest.approx(5.5)
    assert answer.holds
    assert not replace(answer, landscape=counted([5.25 + 1.01 * TELLING])).holds
    assert not replace(answer, by_hand=(*by_hand, placement(5.25 - 0.99 * TELLING))).holds


def test_nothing_is_claimed_where_a_rollout_failed(caplog):
    answer = MountAnswer(placement(5.0), (placement(2.0),), (), counted([1.0, 3.0]))
    assert answer.holds
    # Otherwise the best of the grid, or of what was placed by hand, would be the best of the rest.
    for failed in (
        replace(answer, landscape=counted([1.0, 3.0], failing=[3.0])),
        replace(answer, by_hand=(placement(2.0), placement(2.0, 1.0, failing=[1.0]))),
        replace(answer, best=placement(5.0, 5.5, failing=[5.5])),
    ):
        assert not failed.holds
        assert np.isnan([failed.best_on_grid, failed.gain]).any()
