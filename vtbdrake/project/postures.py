"""Two postures of a robot for examples, which its drives carry: its home, and another one."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram
from scipy.optimize import least_squares

from vtbdrake.project.parser import ModelParser
from vtbdrake.project.robot import PRISMATIC, REVOLUTE, ProjectRobot, RobotJoint

# The share of the effort of a drive that the weight takes at home, where the file's posture takes more than all of it.
_CARRIED = 0.8
# On the way to the other posture of examples, the weight takes at most this share, or as much as at home.
_HEAVIEST = 0.9
# A joint that is this close to its home in the file stays there, in rad or m.
_UNMOVED = 0.005
# The other posture of examples lies at most this far from home, and this share of the way to the farther end.
_STEP = {REVOLUTE: 0.4, PRISMATIC: 0.1}
_SHARE = 0.15
# At its speed, a joint reaches the other posture of examples within this time, in s.
_LONGEST_WAY = 5.0
# The other posture is moved closer to home, and to its other sides, until nothing touches on the way and the drives
# carry it.
_SHARES_OF_THE_WAY = (1.0, 0.5, 0.2)
# The sides of the joints that are tried at random, beside all and none.
_RANDOM_SIDES = 4
# The postures that are looked at on the way.
_POSTURES = 12
# Bodies also touch at home if they do where joints are moved at random by up to this much, in rad or m: gains are soft.
_AROUND_HOME = 0.02
# The postures around home that are looked at.
_NEIGHBOURS = 8


def let_drives_carry(parser: ModelParser, plant: MultibodyPlant, robot: ProjectRobot) -> None:
    """Move the home of a robot whose drives cannot hold it there to the nearest posture in which they can.

    Args:
        parser: The model file; its notes are added to.
        plant: The plant of the project's world.
        robot: The robot with its drives and limits.
    """
    homes = np.array([joint.home for joint in robot.joints])
    B, context = robot.selection(), plant.CreateDefaultContext()
    weak = np.flatnonzero(_loads(plant, context, robot, homes) > 1.0)
    if not weak.size:
        return
    moved = np.array([k for k, joint in enumerate(robot.joints) if joint.name in robot.driven])
    lower, upper = np.transpose([(robot.joints[k].lower, robot.joints[k].upper) for k in moved])
    follow = B @ np.eye(len(robot.driven))[[robot.driven.index(robot.joints[k].name) for k in moved]].T

    def errors(x: NDArray[np.float64]) -> NDArray[np.float64]:
        excess = np.maximum(_loads(plant, context, robot, homes + follow @ (x - homes[moved])) - _CARRIED, 0.0)
        return np.concatenate([10.0 * excess, 0.1 * (x - homes[moved]) / (upper - lower)])

    start = np.clip(homes[moved], lower + 1e-6 * (upper - lower), upper - 1e-6 * (upper - lower))
    solution = least_squares(errors, start, bounds=(lower, upper), diff_step=1e-3, max_nfev=100)
    q = homes + follow @ (solution.x - homes[moved])
    name = robot.driven[weak[0]]
    cannot = (
        f"{parser.place(name)}: the drives of {', '.join(robot.driven[k] for k in weak)} cannot carry the robot in "
        "the file's posture"
    )
    if _loads(plant, context, robot, q).max() > 1.0:
        parser.notes.append(f"{cannot}, nor in one near it: they sink. Give them higher limits in the file")
        return
    q = np.where(np.abs(q - homes) < _UNMOVED, homes, np.round(q, 4))
    robot.joints = tuple(
        replace(joint, home=float(np.clip(value, joint.lower, joint.upper)))
        for joint, value in zip(robot.joints, q, strict=True)
    )
    parser.notes.append(f"{cannot}: its home is the nearest one in which they can")


def move_away(
    parser: ModelParser, plant: MultibodyPlant, scene_graph: SceneGraph, diagram: Diagram, robot: ProjectRobot
) -> None:
    """Set ``robot.away`` so that nothing touches on the way from home, and ``robot.touching`` where that fails.

    Bodies that touch each other at home are in ``robot.touching``, too.

    Args:
        parser: The model file; its notes are added to.
        plant: The plant of the project's world.
        scene_graph: Its geometry.
        diagram: The diagram of both.
        robot: The robot with its homes.
    """
    contacts = _Contacts(plant, scene_graph, diagram)
    home = np.array([joint.home for joint in robot.joints])
    random = np.random.default_rng(0)
    moves = random.uniform(-_AROUND_HOME, _AROUND_HOME, (_NEIGHBOURS, len(robot.driven))) @ robot.selection().T
    touching = set().union(*(contacts.touching(q) for q in (home, *(home + moves))))
    if touching:
        parser.notes.append(
            f"{parser.shown}: {', '.join(sorted(touching))} touch each other at home: their contact is left out "
            "(TOUCHING in robot.py)"
        )
    names = [joint.name for joint in robot.joints]
    speed = np.array([robot.joints[names.index(driven)].speed for driven in robot.driven])
    B = robot.selection()
    start = home[[names.index(driven) for driven in robot.driven]]
    away = np.array([_away(robot.joints[names.index(driven)]) for driven in robot.driven])
    met: set[str] = set()
    context = plant.CreateDefaultContext()
    carried = max(_HEAVIEST, _loads(plant, context, robot, home).max())
    for step in _steps(robot, start, away - start):
        seconds = np.linspace(0.0, (np.abs(step) / speed).max(), _POSTURES)[1:]
        postures = [home + B @ np.clip(step, -t * speed, t * speed) for t in seconds]
        met = set().union(*(contacts.touching(q, among=touching) for q in postures))
        robot.away = tuple(float(f"{value:.4g}") for value in start + step)
        if not met and max(_loads(plant, context, robot, q).max() for q in postures) <= carried:
            break
    if met:
        parser.notes.append(
            f"{parser.shown}: {', '.join(sorted(met))} touch something wherever the robot moves from home: their "
            "contact is left out (TOUCHING in robot.py)"
        )
    robot.touching = tuple(sorted(touching | met))


class _Contacts:
    """Which bodies touch each other in a posture."""

    def __init__(self, plant: MultibodyPlant, scene_graph: SceneGraph, diagram: Diagram) -> None:
        self._plant = plant
        context = diagram.CreateDefaultContext()
        self._context = plant.GetMyMutableContextFromRoot(context)
        self._query = scene_graph.get_query_output_port()
        self._query_context = scene_graph.GetMyContextFromRoot(context)

    def touching(self, positions: NDArray[np.float64], among: Collection[str] = ()) -> set[str]:
        """Return the names of bodies that touch each other, but for pairs of two that are in ``among``."""
        self._plant.SetPositions(self._context, positions)
        query = self._query.Eval(self._query_context)
        frame_of = query.inspector().GetFrameId
        bodies: set[str] = set()
        for pair in query.ComputePointPairPenetration():
            names = {self._plant.GetBodyFromFrameId(frame_of(geometry)).name() for geometry in (pair.id_A, pair.id_B)}
            if not names <= set(among):
                bodies |= names
        return bodies


def _steps(robot: ProjectRobot, start: NDArray[np.float64], step: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield ways of the driven joints from home, shorter ones and to other sides, within their ranges."""
    joints = {joint.name: joint for joint in robot.joints}
    lower, upper = np.transpose([(joints[name].lower, joints[name].upper) for name in robot.driven])
    random = np.random.default_rng(0)
    sides = [np.ones(len(step)), -np.ones(len(step)), *random.choice([-1.0, 1.0], (_RANDOM_SIDES, len(step)))]
    for share in _SHARES_OF_THE_WAY:
        for side in sides:
            end = start + share * side * step
            yield np.where((lower <= end) & (end <= upper), share * side, share) * step


def _loads(
    plant: MultibodyPlant, context: Context, robot: ProjectRobot, positions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares of the limits of the drives that the weight takes in a posture, shape (driven,)."""
    plant.SetPositions(context, positions)
    names = [joint.name for joint in robot.joints]
    limit = np.array([robot.joints[names.index(driven)].effort for driven in robot.driven])
    loads: NDArray[np.float64] = np.abs(robot.selection().T @ plant.CalcGravityGeneralizedForces(context)) / limit
    return loads


def _away(joint: RobotJoint) -> float:
    """Return another position of a joint, towards its farther end."""
    end = joint.upper if joint.upper - joint.home > joint.home - joint.lower else joint.lower
    step = min(_SHARE * abs(end - joint.home), _STEP[joint.kind], _LONGEST_WAY * joint.speed)
    return float(f"{joint.home + math.copysign(step, end - joint.home):.4g}")
