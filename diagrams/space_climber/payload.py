"""How heavy may a component attached to the robot's front be before it is no longer stable?

What could bend the answer was fixed before the first payload was simulated:

* the lever, 0.51 m ahead of the torso's centre: a cube bolted flat onto the front plate (see `Morphology`);
* friction, 0.8, and 0.5 and 1.1 as the two others: the ends of what the friction angles of lunar soil give;
* the start phases, 0 to 3/8 of a cycle in steps of 1/8: half a cycle on, a tripod gait is its own mirror image;
* the slope, 10 deg downhill: the direction that is worst for a mass at the front.

Torso and attachment have no collision geometry: a robot that falls goes on falling past 45 deg, instead of coming to
rest on its attachment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import vtbdrake as vtb
from diagrams.space_climber.morphology import FOOT_LINKS, JOINT_NAMES
from diagrams.space_climber.scenario import SpaceClimberScenario

MASS = "sim.sys.payload.mass"
PITCH = "sim.sys.climber.base.pitch"
PHASE = "dps.impl.gait.phase"

PHASES = (0.0, 1 / 8, 2 / 8, 3 / 8)
HORIZON = 15.0
# A multiple of the DPS's period, so that the simulation does not pause more often than it has to.
SAMPLE_PERIOD = 0.1
PAPER = "about 45 kg"

# Name -> fields of the scenario.
MOON = "moon"
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    MOON: {},
    "Mars": {"gravity": 3.71},
    "earth": {"gravity": 9.81},
    "moon, 10 deg downhill": {"slope_deg": 10.0},
    "moon, friction 0.5": {"friction": 0.5},
    "moon, friction 1.1": {"friction": 1.1},
}


def tipped_over(pitch: float) -> float:
    """f of the paper: 0 while the pitch (rad) is within 45 deg, else 1."""
    return 0.0 if abs(pitch) < np.pi / 4 else 1.0


def payload_problem(*, phases: Sequence[float] = PHASES, **environment: Any) -> vtb.Problem:
    """The paper's five steps, in an environment given by fields of the scenario."""
    return vtb.Problem(
        scenario=SpaceClimberScenario(**environment),
        parameters=[vtb.Parameter(MASS, 0.0, 60.0)],
        quality=vtb.Quality(tipped_over, of=PITCH),
        horizon=HORIZON,
        threshold=0.9,
        sample_period=SAMPLE_PERIOD,
        conditions=[{PHASE: phase} for phase in phases],
    )


def static_limit(testbed: vtb.VirtualTestbed, *, stroke: float = 0.0) -> float:
    """The attached mass in kg at which the centre of mass lies over the front feet, on level ground.

    ``stroke`` is the gait's, in m: at the end of a stance the front feet are half of it behind their nominal place.
    The robot is in its default posture; the rest is the balance of moments m (x_a - x_f) = M (x_f - x_c).
    """
    plant = testbed.plant
    assert plant is not None
    context = plant.CreateDefaultContext()
    climber = plant.GetModelInstanceByName("climber")
    M = plant.CalcTotalMass(context, [climber])
    x_c = plant.CalcCenterOfMassPositionInWorld(context, [climber])[0]
    foot = plant.GetBodyByName(FOOT_LINKS[0])
    sphere = plant.GetCollisionGeometriesForBody(foot)[0]
    assert testbed.scene_graph is not None
    p_BS = testbed.scene_graph.model_inspector().GetPoseInFrame(sphere).translation()
    x_f = (foot.EvalPoseInWorld(context) @ p_BS)[0] - stroke / 2.0
    x_a = plant.GetBodyByName("payload").EvalPoseInWorld(context).translation()[0]
    return float(M * (x_f - x_c) / (x_a - x_f))


def locked_problem(*, lower: float = 70.0, upper: float = 120.0) -> vtb.Problem:
    """The same question for a robot that stands on six legs with all joints locked, where statics knows the answer."""
    scenario = SpaceClimberScenario(
        plant=vtb.PlantFields(time_step=0.002, contact_model="point", discrete_contact_approximation="sap"),
        simulator=vtb.SimulatorFields(),
    )
    locks = {f"sim.sys.climber.{name}.locked": 1.0 for name in JOINT_NAMES}
    return vtb.Problem(
        scenario=scenario,
        parameters=[vtb.Parameter(MASS, lower, upper)],
        quality=vtb.Quality(tipped_over, of=PITCH),
        horizon=HORIZON,
        threshold=0.9,
        sample_period=SAMPLE_PERIOD,
        conditions=[{"u.walk": 0.0, **locks}],
    )
