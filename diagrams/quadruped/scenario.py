"""The quadruped testbed: a robot with four legs that trots on a plane, and is pushed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram

from vtbdrake.common.settings import setting
from vtbdrake.common.spline import Spline
from vtbdrake.components.sensors import (
    BasePoseSensor,
    BaseTwistSensor,
    ErrorModel,
    JointEncoders,
    JointTachometers,
)
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.quadruped.dps import PERCEIVED, SENSED, make_dps
from vtbdrake_diagrams.quadruped.gait import OFFSETS, Trot
from vtbdrake_diagrams.quadruped.model import JOINT_NAMES, LEGS, QUADRUPED_SDF, RANGES, Quadruped

if TYPE_CHECKING:
    from vtbdrake.reasoning import OnboardReasoner

_RANGES = np.tile([*RANGES.values()], (len(LEGS), 1)).T
_FLOOR = np.array([0.55, 0.60, 0.52, 1.0])
_POSITIONS = SENSED["base_pose"] + SENSED["joint_position"]


def _plant(time_step: float) -> MultibodyPlantConfig:
    return MultibodyPlantConfig(
        time_step=time_step,
        contact_model="point",
        discrete_contact_approximation="sap",
        # Else, a step of the plant comes before the sensors of the same instant.
        use_sampled_output_ports=False,
    )


@dataclass
class QuadrupedScenario(Scenario):
    """A quadruped that trots on a plane with the velocity ``u.velocity``, and is pushed (``sim.env.push``).

    Its drives hold the angles of a trot (see `Trot`), to which a plan of offsets is added: the command ``u.plan``; or,
    with ``onboard``, the decision of a reasoner that is a part of the DPS, ``dps.planner``, fifty times a second. A
    mental copy has longer periods, its sensors no random errors, and nobody pushes it.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: _plant(0.002))
    period: float = setting(0.002, "The sample period of sensors and DPS on the robot.", unit="s", gt=0.0)
    # The plan: its knots, and its duration in seconds.
    knots: int = 4
    duration: float = 0.45
    # Whether the DPS decides the plan itself; and in a mental copy of it, where it does not reason again.
    onboard: bool = False
    is_mental: bool = False
    thinking_period: float = setting(
        0.02, "The time from one decision to the next, and the time that one takes.", unit="s", gt=0.0
    )
    rollouts: int = setting(20, "The rollouts of a decision.", ge=1)
    mental_period: float = setting(
        0.02, "The time step of the plant, sensors and DPS in a mental copy.", unit="s", gt=0.0
    )
    # Errors of the sensors, exact by default.
    joint_errors: ErrorModel = field(default_factory=ErrorModel)
    base_errors: ErrorModel = field(default_factory=ErrorModel)

    def validate(self) -> None:
        super().validate()
        try:
            self.plan()
        except ValueError as error:
            raise ScenarioError(str(error)) from None

    def plan(self) -> Spline:
        """Return the curve of a plan."""
        return Spline("linear", self.knots, self.duration)

    def mental(self) -> QuadrupedScenario:
        """Return the scenario of the mental copy: longer periods, sensors without random errors."""
        errors = {name: getattr(self, name).without_chance() for name in ("joint_errors", "base_errors")}
        return replace(self, plant_config=_plant(self.mental_period), is_mental=True, **errors)

    @property
    def sample_period(self) -> float:
        """Return the period of sensors and DPS in s: the robot's, or a mental copy's."""
        return self.mental_period if self.is_mental else self.period

    def interface(self) -> Interface:
        sense = {
            "base_pose": ("1, 1, 1, 1, m, m, m", 100.0),
            "joint_position": ("rad", 10.0),
            "base_twist": ("rad/s, m/s", 100.0),
            "joint_velocity": ("rad/s", 1e3),
        }
        commands = [
            Signal("velocity", size=2, unit="m/s", lower=-1.0, upper=1.0, entry_names=["forwards", "to the left"])
        ]
        if not self.onboard:
            # A plan begins at a time of the DPS, which runs for thirty years at most.
            limit = np.append(1e9, np.ones(self.knots * len(OFFSETS)))
            commands.append(Signal("plan", size=limit.size, unit="s, m, rad, ...", lower=-limit, upper=limit))
        return Interface(
            sense=[
                Signal(name, size=SENSED[name], unit=unit, lower=-limit, upper=limit, max_age=5 * self.sample_period)
                for name, (unit, limit) in sense.items()
            ],
            act=[
                Signal(
                    "joint_desired",
                    size=2 * len(JOINT_NAMES),
                    unit="rad, rad/s",
                    lower=np.repeat([-10.0, -1e3], len(JOINT_NAMES)),
                    upper=np.repeat([10.0, 1e3], len(JOINT_NAMES)),
                    idle=np.append(np.tile(Quadruped().posture, len(LEGS)), np.zeros(len(JOINT_NAMES))),
                )
            ],
            commands=commands,
        )

    def make_dps(self) -> Diagram:
        planner = self._make_planner() if self.onboard else None
        return make_dps(Quadruped(), Trot(), self.plan(), period=self.sample_period, planner=planner)

    def _make_planner(self) -> OnboardReasoner:
        # Imported here: without it, the DPS needs no optimization.
        from vtbdrake.reasoning import Budget, OnboardReasoner
        from vtbdrake_diagrams.quadruped.decision import reasoning

        arguments = reasoning(self, "dps.planner.candidate", Budget(rollouts=self.rollouts))
        named = {name: arguments.pop(name) for name in ("decision", "quality", "horizon", "budget")}
        return OnboardReasoner(
            1 + self.knots * len(OFFSETS),
            scenario=self,
            period=self.thinking_period,
            latency=self.thinking_period,
            mental=self.is_mental,
            options=arguments,
            **named,
        )

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        # Imported here: the DPS on the machine runs without a plant.
        from pydrake.geometry import Box, CollisionFilterDeclaration, GeometrySet, HalfSpace
        from pydrake.math import RigidTransform
        from pydrake.multibody.parsing import Parser
        from pydrake.multibody.plant import CoulombFriction

        from vtbdrake_diagrams.quadruped.push import Push

        robot = Quadruped()
        plant, scene_graph = builder.add_plant(self.plant_config)
        (instance,) = Parser(plant).AddModels(str(QUADRUPED_SDF))
        ground = CoulombFriction(robot.friction, robot.friction)
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
        X_WG, floor = RigidTransform([0.0, 0.0, -0.02]), Box(8.0, 8.0, 0.04)
        plant.RegisterVisualGeometry(plant.world_body(), X_WG, floor, "floor", _FLOOR)
        bodies = GeometrySet([plant.GetBodyFrameIdOrThrow(i) for i in plant.GetBodyIndices(instance)])
        trunk = plant.GetBodyByName("trunk")
        plant.SetDefaultFloatingBaseBodyPose(trunk, RigidTransform([0.0, 0.0, robot.stance]))
        joints = [plant.GetJointByName(name, instance) for name in JOINT_NAMES]
        for joint, angle in zip(joints, np.tile(robot.posture, len(LEGS)), strict=True):
            joint.set_default_angle(angle)
        plant.Finalize()
        # Legs may pass through each other.
        scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(bodies))
        T = self.sample_period
        builder.add_sensor("base_pose", BasePoseSensor(plant, trunk, period=T, errors=self.base_errors))
        builder.add_sensor("base_twist", BaseTwistSensor(plant, trunk, period=T, errors=self.base_errors))
        builder.add_sensor("joint_position", JointEncoders(plant, joints, period=T, errors=self.joint_errors))
        builder.add_sensor("joint_velocity", JointTachometers(plant, joints, period=T, errors=self.joint_errors))
        builder.sim_actuator("joint_desired", plant.get_desired_state_input_port(instance))
        if not self.is_mental:
            push = builder.add("env", "push", Push(plant, "trunk"))
            builder.connect(push.get_output_port(), plant.get_applied_spatial_force_input_port())
        self._add_beliefs(builder)

    def _add_beliefs(self, builder: VirtualTestbedBuilder) -> None:
        """Declare that the perceived state sets the simulated robot.

        The robot has measured it one or two of its own periods before, also where this is a mental copy.
        """
        joints = [f"sim.sys.quadruped.{name}" for name in JOINT_NAMES]
        age = {
            name: (1 + errors.latency) * self.period
            for name, errors in {"base": self.base_errors, "joint": self.joint_errors}.items()
        }
        rules = (
            (["sim.sys.quadruped.trunk.position", "sim.sys.quadruped.trunk.velocity"], present_trunk, age["base"]),
            ([f"{joint}.position" for joint in joints], present_angles, age["joint"]),
            ([f"{joint}.velocity" for joint in joints], present_rates, age["joint"]),
        )
        for targets, by, of_age in rules:
            builder.believe(targets, of=[PERCEIVED], by=by, age=of_age, period=self.period)


def present_trunk(state: np.ndarray, *, late: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pose and twist of the trunk, which goes on with its twist.

    Args:
        state: A state of the plant, [q; v].
        late: The age of the state in s.
    """
    pose, twist = state[:7].copy(), state[_POSITIONS : _POSITIONS + 6]
    w, x, y, z = pose[:4]
    # q' = w q / 2, with the angular velocity in the world.
    rate = np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]]) @ twist[:3]
    pose[:4] += 0.5 * late * rate
    pose[:4] /= np.linalg.norm(pose[:4])
    pose[4:] += late * twist[3:]
    return pose, twist


def present_angles(state: np.ndarray, *, late: float) -> np.ndarray:
    """Return the angles of the joints, which go on with their rates up to their stops; see `present_trunk`."""
    angles = state[7:_POSITIONS] + late * present_rates(state, late=late)
    within: np.ndarray = np.clip(angles, *_RANGES)
    return within


def present_rates(state: np.ndarray, *, late: float) -> np.ndarray:
    """Return the rates of the joints, which stay; see `present_trunk`."""
    return state[_POSITIONS + 6 :]
