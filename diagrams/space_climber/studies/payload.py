"""Application O4: how heavy may a component on the front of the robot be before it is no longer stable?

The choices that influence the answer were fixed before the first payload was simulated:

* the lever, 0.51 m ahead of the torso's centre: a cube bolted flat onto the front plate (see `Morphology`);
* friction, 0.8, and 0.5 and 1.1 as the two others: the ends of what the friction angles of lunar soil give;
* the start phases, 0 to 3/8 of a cycle in steps of 1/8: half a cycle on, a tripod gait is its own mirror image;
* the slope, 10 deg downhill: the direction that is worst for a mass at the front.

Torso and attachment have no collision geometry: a robot that falls goes on falling past 45 deg, instead of coming to
rest on its attachment.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig

import vtbdrake as vtb
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.space_climber.gait import TRIPOD
from vtbdrake_diagrams.space_climber.morphology import FOOT_LINKS, JOINT_NAMES, LEGS
from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario

MASS = "sim.sys.payload.mass"
PITCH = "sim.sys.climber.base.pitch"
PHASE = "dps.impl.gait.phase"
PERIOD = "dps.impl.gait.period"
STROKE = "dps.impl.gait.stroke"

PHASES = (0.0, 1 / 8, 2 / 8, 3 / 8)
HORIZON = 15.0
# Period of the gait in seconds.
STRIDE = 2.0
# A multiple of the DPS's period, so that the simulation does not pause more often than it has to.
SAMPLE_PERIOD = 0.1
PAPER = "about 45 kg"

# Name -> fields of the scenario, or the stride.
MOON = "moon"
EARTH = "earth"
SLOPE = "moon, 10 deg downhill"
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    MOON: {},
    "Mars": {"gravity": 3.71},
    EARTH: {"gravity": 9.81},
    SLOPE: {"slope_deg": 10.0},
    "moon, friction 0.5": {"friction": 0.5},
    "moon, friction 1.1": {"friction": 1.1},
    # How fast it walks for its gravity, by the Froude number v^2 / (g l), decides which of two worlds carries more.
    "moon, a stride in 8 s": {"stride": 8.0},
    "earth, a stride in 8 s": {"gravity": 9.81, "stride": 8.0},
}

# Name -> fields of the scenario: how else the same world may be integrated, at least as accurately.
SOLVERS: dict[str, dict[str, Any]] = {
    "steps of 10 ms": {
        "simulator_config": SimulatorConfig(integration_scheme="cenic", max_step_size=0.01, accuracy=1e-3)
    },
    "an accuracy of 5e-4": {
        "simulator_config": SimulatorConfig(integration_scheme="cenic", max_step_size=0.025, accuracy=5e-4)
    },
}


def discrete(time_step: float = 0.005) -> dict[str, Any]:
    """Return fields of the scenario for a plant with steps (s) that SAP solves, so that its testbed can be compiled."""
    plant_config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="point",
        discrete_contact_approximation="sap",
        use_sampled_output_ports=False,
    )
    return {"plant_config": plant_config, "simulator_config": SimulatorConfig()}


def tipped_over(pitch: float) -> float:
    """Return f of the paper: 0 while the pitch (rad) is within 45 deg, else 1."""
    return 0.0 if abs(pitch) < np.pi / 4 else 1.0


def payload_problem(*, phases: Sequence[float] = PHASES, stride: float = STRIDE, **environment: Any) -> vtb.Problem:
    """State the question in the paper's five steps.

    Args:
        phases: Start phases of the gait, in cycles.
        stride: Period of the gait in seconds; the number of strides does not depend on it.
        environment: Fields of the scenario.
    """
    return vtb.Problem(
        scenario=SpaceClimberScenario(**environment),
        parameters=[vtb.Parameter(MASS, 0.0, 60.0)],
        quality=vtb.Quality(tipped_over, of=PITCH),
        horizon=HORIZON * stride / STRIDE,
        threshold=0.9,
        sample_period=SAMPLE_PERIOD,
        conditions=[{PHASE: phase} if stride == STRIDE else {PHASE: phase, PERIOD: stride} for phase in phases],
    )


def static_limit(testbed: VirtualTestbed, *, legs: Sequence[str] = LEGS, ahead: float = 0.0) -> float:
    """Return the attached mass in kg at which the centre of mass lies over the front edge of the support polygon.

    The robot is in its default posture on level ground; the rest is the balance of moments
    m (x_a - x_e) = M (x_e - x_c) about the point x_e of the edge that lies straight ahead of the centre of mass.

    Args:
        testbed: Testbed of the space climber, with its attachment.
        legs: The legs whose feet stand on the ground.
        ahead: Distance of these feet ahead of their nominal positions, in m.
    """
    plant = testbed.plant
    assert plant is not None
    assert testbed.scene_graph is not None
    context = plant.CreateDefaultContext()
    climber = plant.GetModelInstanceByName("climber")
    M = plant.CalcTotalMass(context, [climber])
    x_c, y_c, _ = plant.CalcCenterOfMassPositionInWorld(context, [climber])
    feet = []
    for leg in legs:
        foot = plant.GetBodyByName(FOOT_LINKS[LEGS.index(leg)])
        sphere = plant.GetCollisionGeometriesForBody(foot)[0]
        p_BS = testbed.scene_graph.model_inspector().GetPoseInFrame(sphere).translation()
        feet.append((foot.EvalPoseInWorld(context) @ p_BS)[:2] + np.array([ahead, 0.0]))
    x_e = _front_edge(np.array(feet), y_c)
    x_a = plant.GetBodyByName("payload").EvalPoseInWorld(context).translation()[0]
    return float(M * (x_e - x_c) / (x_a - x_e))


def _front_edge(feet: np.ndarray, y: float) -> float:
    """Return the largest x at ``y`` in the convex hull of the feet, shape (n, 2)."""
    crossings = [
        a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
        for a, b in itertools.permutations(feet, 2)
        if a[1] <= y <= b[1] and a[1] < b[1]
    ]
    return float(max(crossings))


def statics(testbed: VirtualTestbed) -> dict[str, float]:
    """Return the static limit in kg for each phase of a tripod gait, and for six feet at rest."""
    half = testbed.read(testbed.default_context(), STROKE) / 2.0
    tripod = [leg for leg, delay in zip(LEGS, TRIPOD.delays, strict=True) if delay == 0.0]
    return {
        "three feet, begin of their stance": static_limit(testbed, legs=tripod, ahead=half),
        "three feet, middle of their stance": static_limit(testbed, legs=tripod),
        "three feet, end of their stance": static_limit(testbed, legs=tripod, ahead=-half),
        "both front feet down, at rest": static_limit(testbed),
    }


def locked_problem(*, lower: float = 70.0, upper: float = 120.0) -> vtb.Problem:
    """State the question for a robot on six legs with locked joints, for which statics gives the answer."""
    scenario = SpaceClimberScenario(
        plant_config=MultibodyPlantConfig(time_step=0.002, contact_model="point", discrete_contact_approximation="sap"),
        simulator_config=SimulatorConfig(),
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
