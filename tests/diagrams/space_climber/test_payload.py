"""The testbed and its question: how heavy may the attachment be?"""

from functools import cache

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from scipy.optimize import linprog

from vtbdrake.testbed import ScenarioError, VirtualTestbed, load_scenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.morphology import JOINT_NAMES, LEGS, Morphology
from vtbdrake_diagrams.space_climber.studies.payload import (
    MASS,
    locked_problem,
    payload_problem,
    static_limit,
    statics,
    tipped_over,
)


@cache
def built() -> VirtualTestbed:
    return SpaceClimberScenario().build()


def test_f_is_that_of_the_paper() -> None:
    angles = np.radians([0.0, 44.9, -44.9, 45.1, -45.1, 120.0])
    assert [tipped_over(angle) for angle in angles] == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    "legs",
    [LEGS, ("front_left", "middle_right", "rear_left"), ("front_right", "middle_left", "rear_left", "rear_right")],
)
@pytest.mark.parametrize("ahead", [-0.1, 0.0, 0.1])
def test_static_limit_lies_on_support_edge(legs, ahead) -> None:
    testbed = built()
    context = testbed.default_context()
    limit = static_limit(testbed, legs=legs, ahead=ahead)
    testbed.write(context, {MASS: limit})
    plant = testbed.plant
    x_cm, y_cm, _ = plant.CalcCenterOfMassPositionInWorld(plant.GetMyContextFromRoot(context))
    # The point furthest ahead that is a convex combination of the feet and lies straight ahead of the centre of mass.
    feet = Morphology().stance[[LEGS.index(leg) for leg in legs], :2] + [ahead, 0.0]
    edge = linprog(-feet[:, 0], A_eq=[feet[:, 1], np.ones(len(legs))], b_eq=[y_cm, 1.0])
    assert x_cm == pytest.approx(-edge.fun, abs=1e-6)


def test_statics_names_every_way_to_stand() -> None:
    limits = statics(built())
    begin, middle, end, rest = limits.values()
    assert end < middle < begin < rest


def test_a_slower_robot_walks_as_many_strides() -> None:
    problem = payload_problem(phases=[0.25], stride=8.0, gravity=9.81)
    assert problem.task.horizon / 8.0 == payload_problem().task.horizon / 2.0
    assert problem.conditions == ({"dps.impl.gait.phase": 0.25, "dps.impl.gait.period": 8.0},)
    assert problem.scenario.gravity == 9.81


@pytest.mark.slow
@pytest.mark.one_python
def test_with_locked_legs_it_tips_where_statics_says() -> None:
    problem = locked_problem()
    limit = static_limit(problem.testbed)
    below, above = problem.rollout([0.98 * limit]), problem.rollout([1.02 * limit])
    assert below.end == "horizon"
    assert above.end == "threshold"


def test_a_heavy_attachment_tips_the_robot_a_light_does_not() -> None:
    sweep = payload_problem(phases=[0.0]).sweep(values=[20.0, 55.0], executor="serial", progress=False)
    assert sweep.exceeded.tolist() == [False, True]
    assert sweep.t_star[1] < 6.0


def test_a_robot_that_falls_keeps_its_energy_until_it_lands() -> None:
    # CENIC is of first order: a body in free fall is g t h / 2 too low, h half a step.
    step = 0.002
    testbed = SpaceClimberScenario(
        simulator_config=SimulatorConfig(integration_scheme="cenic", max_step_size=step, accuracy=1e-3)
    ).build()
    context = testbed.default_context()
    testbed.write(context, {"u.walk": 0.0, "sim.sys.climber.base.pose": [0.0, 0.0, 3.0, 0.0, 0.0, 0.0]})
    plant, own = testbed.plant, testbed.plant.GetMyContextFromRoot(context)
    before = plant.CalcPotentialEnergy(own) + plant.CalcKineticEnergy(own)
    testbed.simulator(context).AdvanceTo(1.5)
    after = plant.CalcPotentialEnergy(own) + plant.CalcKineticEnergy(own)
    fall = 1.62 * 1.5**2 / 2
    assert testbed.read(context, "sim.sys.climber.base.height") == pytest.approx(3.0 - fall, abs=1.62 * 1.5 * step / 2)
    # Joints that give way have taken next to nothing of the energy that has moved.
    moved = plant.CalcTotalMass(own) * 1.62 * fall
    assert abs(after - before) < 0.01 * moved


def test_the_simulated_world_starts_from_what_the_robot_believes() -> None:
    testbed = built()
    context = testbed.default_context()
    testbed.write(context, {"u.heading": 0.3})
    testbed.simulator(context).AdvanceTo(3.51)
    names = ["sim.sys.climber.base.pose", *(f"sim.sys.climber.{name}.position" for name in JOINT_NAMES)]
    true = testbed.variables().read(context, names)
    estimates = [testbed.read(context, f"dps.{name}") for name in ("env.position", "sense.calibration.joint_encoders")]
    testbed.start_from_belief(context)
    believed = testbed.variables().read(context, names)
    np.testing.assert_allclose(believed[names[0]], true[names[0]], atol=0.08)
    # It walks at 0.2 m/s, and its estimates are 0.03 s old: a period, and half of one since the last sample.
    walked = believed[names[0]][:3] - estimates[0]
    assert walked @ [np.cos(0.15), np.sin(0.15), 0.0] == pytest.approx(0.2 * 0.03, rel=0.1)
    before, now = (
        np.linalg.norm(np.subtract(joints, [true[name] for name in names[1:]]))
        for joints in (estimates[1], [believed[name] for name in names[1:]])
    )
    assert 0.0 < now < 0.4 * before


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"gravity": -1.62}, "gravity must be a finite number above 0 m/s"),
        ({"gait": "gallop"}, "gait must be one of tripod, ripple, wave, not 'gallop'"),
        ({"slope_deg": 60.0}, "slope_deg must be a number from -45 to 45 deg"),
        ({"friction": -0.1}, "friction must be a finite number of at least 0"),
        ({"period": 0.0}, "period must be a finite number above 0 s"),
    ],
)
def test_a_world_that_makes_no_sense_is_refused(fields, message) -> None:
    with pytest.raises(ScenarioError, match=message):
        SpaceClimberScenario(**fields).build()


def test_the_scenario_loads_from_a_file(tmp_path) -> None:
    file = tmp_path / "mars.yaml"
    file.write_text("vtbdrake_diagrams.space_climber:SpaceClimberScenario:\n  gravity: 3.71\n  gait: ripple\n")
    assert load_scenario(file) == SpaceClimberScenario(gravity=3.71, gait="ripple")
