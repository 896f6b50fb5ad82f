"""The planned approach of the arm: its posture, its plan, and a capture that follows it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.state import Snapshot
from vtbdrake.state.systems import pose_from_array
from vtbdrake.testbed import ScenarioError, VirtualTestbed
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.approach import ApproachPlanner, posture
from vtbdrake_diagrams.satellite.arm_move import move_space
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.clearance import CLEARANCE, DrakeClearance
from vtbdrake_diagrams.satellite.estimation import BASE
from vtbdrake_diagrams.satellite.plant import add_servicer
from vtbdrake_diagrams.satellite.supervisor import Arrival, Mode

DURATION = 15.0
X_IB = RigidTransform(RollPitchYaw(0.05, -0.1, 0.2), [0.3, -0.2, 0.1])
AHEAD = RotationMatrix(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))


def pose_before_the_bar(x: float = 1.65) -> RigidTransform:
    """Return a pose X_IG, seen from the base at ``x`` in m."""
    return X_IB @ RigidTransform(RotationMatrix(RollPitchYaw(0.2, 0.1, -0.1)) @ AHEAD, [x, 0.05, -0.1])


@pytest.mark.parametrize("wheels", [False, True])
def test_posture_brings_the_gripper_there_while_the_center_of_mass_stays(wheels: bool) -> None:
    plant = MultibodyPlant(0.0)
    instance = add_servicer(plant, wheels=wheels, servos=False)
    plant.Finalize()
    context, base = plant.CreateDefaultContext(), plant.GetBodyByName("base", instance)

    def center(q: np.ndarray) -> np.ndarray:
        for name, angle in zip(ARM_JOINT_NAMES, q, strict=True):
            plant.GetJointByName(name, instance).set_angle(context, angle)
        return np.array(plant.CalcCenterOfMassPositionInWorld(context))

    q = posture(move_space(DURATION, 9, wheels=wheels), X_IB, np.array(Servicer().stowed), pose_before_the_bar())
    assert q is not None
    plant.SetFreeBodyPose(context, base, X_IB)
    moved = center(q) - center(np.array(Servicer().stowed))
    plant.SetFreeBodyPose(context, base, RigidTransform(X_IB.rotation(), X_IB.translation() - moved))
    center(q)
    X_IG = plant.GetFrameByName("gripper", instance).CalcPoseInWorld(context)
    assert X_IG.IsNearlyEqualTo(pose_before_the_bar(), 2e-3)
    assert DrakeClearance().nearest(q)[0] > CLEARANCE


def belief(x: float) -> dict[str, np.ndarray]:
    """Return the inputs of the planner for a resting target whose centre is at ``x`` in m, and a base at the origin."""
    base, target = np.zeros(BASE), np.zeros(13)
    base[1] = target[0] = 1.0
    target[4] = x
    opening = Servicer().opening
    guidance = np.array([Mode.APPROACH, 0.0, 0.25, 0.0, opening, 0.0])
    return {
        "base": base,
        "target": target,
        "guidance": guidance,
        "joint_position": Servicer().home,
        "request": np.ones(1),
    }


@pytest.mark.parametrize("x", [1.2, 4.0])
def test_a_target_that_the_arm_does_not_reach_is_refused(x: float) -> None:
    planner = ApproachPlanner(duration=DURATION, period=0.02, latency=4.0)
    assert planner(**belief(x)) is None


@pytest.mark.parametrize(("field", "value"), [("approach", "by_hand"), ("approach_time", 1.0), ("planning_time", 0.0)])
def test_bad_fields_are_refused(field: str, value: object) -> None:
    with pytest.raises(ScenarioError, match=field):
        SatelliteScenario(**{field: value}).build()


@cache
def built(approach: str = "planned") -> VirtualTestbed:
    return SatelliteScenario(seed=1, tumble_deg=2.0, perception="pose_sensor", approach=approach).build()


def arrival(state: object) -> Arrival:
    return Arrival(int(built().read(state, "dps.impl.supervisor.arrival")))


def turned(testbed: VirtualTestbed, context: object) -> float:
    base = pose_from_array(testbed.read(context, "sim.sys.servicer.base.pose"))
    return float(np.degrees(base.rotation().ToAngleAxis().angle()))


@dataclass(frozen=True)
class Course:
    """A planned approach.

    Attributes:
        begin: When the plan begins, in s.
        knots: Its knots, (9, 7).
        halfway: The state in the middle of the plan.
        times: Times on the plan in s, (n,).
        positions: The joints then, (n, 7).
        end: The state at its end.
        turned: By how much the base has turned then, in deg.
    """

    begin: float
    knots: np.ndarray
    halfway: Snapshot
    times: np.ndarray
    positions: np.ndarray
    end: Snapshot
    turned: float


@pytest.fixture(scope="module")
def course() -> Course:
    testbed = built()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    while arrival(context) != Arrival.PLANNED:
        assert context.get_time() < 10.0
        simulator.AdvanceTo(context.get_time() + 0.1)
    begin, *knots = testbed.read(context, "dps.impl.planner.plan").tolist()
    simulator.AdvanceTo(begin + 0.5 * DURATION)
    halfway = testbed.fork(simulator)
    times, positions = [], []
    while arrival(context) == Arrival.PLANNED:
        simulator.AdvanceTo(context.get_time() + 0.1)
        times.append(context.get_time())
        positions.append([testbed.read(context, f"sim.sys.servicer.{name}.position") for name in ARM_JOINT_NAMES])
    return Course(
        begin=begin,
        knots=np.reshape(knots, (9, 7)),
        halfway=halfway,
        times=np.array(times),
        positions=np.array(positions),
        end=testbed.fork(simulator),
        turned=turned(testbed, context),
    )


@pytest.mark.slow
def test_arm_follows_the_plan(course: Course) -> None:
    np.testing.assert_allclose(course.knots[:2], [Servicer().stowed] * 2, atol=1e-9)  # The arm has waited.
    move = move_space(DURATION, 9)
    planned = move.spline.matrix(course.times - course.begin) @ course.knots
    # Commands and servos are late by a tenth of a second.
    late = 0.15 * np.abs(move.spline.extremes(course.knots, 1)).max()
    assert np.abs(course.positions - planned).max() < late
    assert np.abs(course.positions[-1] - course.knots[-1]).max() < 0.02


@pytest.mark.slow
def test_base_turns_as_momentum_demands_and_less_than_by_resolved_rate(course: Course) -> None:
    assert course.turned == pytest.approx(np.degrees(move_space(DURATION, 9).reaction(course.knots).angle[-1]), abs=0.3)
    rates = built("resolved_rate")
    context = rates.default_context()
    simulator = rates.simulator(context)
    while rates.read(context, "dps.impl.supervisor.mode") < Mode.TRACK:
        assert context.get_time() < 20.0
        simulator.AdvanceTo(context.get_time() + 0.5)
    assert course.turned < 0.2 * turned(rates, context)


@pytest.mark.slow
def test_fork_on_the_plan_goes_on_alike(course: Course) -> None:
    ends = []
    for _ in range(2):
        context = built().default_context()
        built().restore(context, course.halfway)
        assert arrival(context) == Arrival.PLANNED
        built().simulator(context, restored=True).AdvanceTo(course.times[-1])
        ends.append([turned(built(), context), *built().read(context, "dps.impl.controller.joint_position")])
    assert ends[0] == ends[1]
    assert ends[0][0] == course.turned


@pytest.mark.slow
def test_plan_is_dropped_when_the_target_moves_otherwise(course: Course) -> None:
    context = built().default_context()
    built().restore(context, course.halfway)
    velocity = built().read(context, "sim.sys.target.body.velocity")
    built().write(context, {"sim.sys.target.body.velocity": velocity + np.array([0.0, 0.0, 0.0, 0.0, 0.04, 0.0])})
    simulator = built().simulator(context, restored=True)
    while arrival(context) == Arrival.PLANNED and context.get_time() < course.times[-1] - 1.0:
        simulator.AdvanceTo(context.get_time() + 0.2)
    assert arrival(context) == Arrival.DROPPED
    # The arm stops, and with it the base; then resolved rate goes on.
    simulator.AdvanceTo(context.get_time() + 0.9)
    assert np.linalg.norm(built().read(context, "sim.sys.servicer.base.velocity")[:3]) < np.radians(0.3)
    simulator.AdvanceTo(context.get_time() + 0.5)
    assert built().read(context, "dps.impl.supervisor.mode") == Mode.APPROACH
    assert built().read(context, "dps.impl.supervisor.follows") == 1.0


@pytest.mark.slow
def test_arm_rests_while_the_target_is_watched() -> None:
    context = built().default_context()
    built().write(context, {"dps.impl.supervisor.watch_time": 60.0})
    simulator = built().simulator(context)
    simulator.AdvanceTo(5.0)
    assert arrival(context) == Arrival.PLANNING
    stowed = built().read(context, "dps.impl.controller.joint_position")
    np.testing.assert_array_equal(stowed, Servicer().home)
