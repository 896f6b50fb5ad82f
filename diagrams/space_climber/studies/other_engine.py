"""The climber in MuJoCo: question O4 asked of a second engine, with a contact model of its own.

The model is written from the same SDF as Drake's. The same DPS walks it, which gets the values of the same sensors
through its ports. Dynamics, servos, contact and integration are MuJoCo's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, isfinite
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Diagram

from vtbdrake.common.extras import extra_module
from vtbdrake.components.sensors.imu_kernel import sample
from vtbdrake.state import collect
from vtbdrake_diagrams.space_climber.dps import make_dps
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.model import climber_sdf, payload_sdf
from vtbdrake_diagrams.space_climber.morphology import FOOT_LINKS, JOINT_NAMES, Morphology
from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import HORIZON, PHASE, PHASES, SAMPLE_PERIOD, tipped_over

# The force in N above which the switch of a foot closes, see `ContactSensor`.
SWITCH_FORCE = 1.0


@dataclass(frozen=True)
class Contact:
    """How MuJoCo integrates and solves contact.

    Attributes:
        time_step: MuJoCo's step in s.
        time_constant: How fast a penetration decays, in s; MuJoCo's default is 0.02.
        friction_over_normal: Stiffness of friction over the stiffness of the normal force, MuJoCo's ``impratio``. With
            its default of 1 a loaded foot creeps.
    """

    time_step: float = 0.001
    time_constant: float = 0.02
    friction_over_normal: float = 100.0


# What an engineer may choose: MuJoCo's default contact, and one that is twice as fast.
CONTACTS = (Contact(), Contact(time_constant=0.01))


def climber_mjcf(
    mass: float,
    *,
    morphology: Morphology | None = None,
    lever: float | None = None,
    gravity: float = SpaceClimberScenario.gravity,
    slope_deg: float = 0.0,
    friction: float = SpaceClimberScenario.friction,
    contact: Contact | None = None,
) -> str:
    """Return the robot with its attachment for MuJoCo, on a plane, in its nominal stance.

    Links, inertias, joints and torque limits are read from `climber_sdf` and `payload_sdf`. As in Drake's model only
    the feet touch the ground, and the joints have no stops.

    Args:
        mass: Mass of the attachment in kg.
        morphology: Dimensions and masses of the robot.
        lever: How far the attachment's centre lies ahead of the torso's, in m; None as in the morphology.
        gravity: Acceleration of free fall in m/s^2.
        slope_deg: The ground falls by this angle in the direction of x.
        friction: Coulomb friction of feet and ground.
        contact: MuJoCo's settings.
    """
    m, c = morphology or Morphology(), contact or Contact()
    model = _model_of(climber_sdf(m))
    (front,) = (_pose(frame.find("pose")) for frame in model.findall("frame") if frame.get("name") == "attachment")
    attachment = front if lever is None else RigidTransform(front.rotation(), [lever, 0.0, 0.0])
    payload = _model_of(payload_sdf(m)).find("link")
    assert payload is not None
    X_WG = RigidTransform(RotationMatrix.MakeYRotation(np.radians(slope_deg)))
    below: dict[str, list[ET.Element]] = {}
    for joint in model.findall("joint"):
        below.setdefault(_text(joint, "parent"), []).append(joint)
    links = {link.get("name", ""): link for link in model.findall("link")}

    def body(name: str, X_PB: RigidTransform, freedom: str) -> str:
        children = "".join(
            body(_text(joint, "child"), _pose(links[_text(joint, "child")].find("pose")), _hinge(joint))
            for joint in below.get(name, [])
        )
        link = links[name]
        feet = "".join(_foot(geometry) for geometry in link.findall("collision"))
        if name == "base":
            children += f'<body name="payload" {_place(attachment)}>{_inertial(payload, mass)}</body>'
        return f'<body name="{name}" {_place(X_PB)}>{freedom}{_inertial(link)}{feet}{children}</body>'

    robot = body("base", X_WG @ RigidTransform([0.0, 0.0, m.torso_clearance]), "<freejoint/>")
    servos = "".join(
        f'<position joint="{name}" kp="{m.joint_stiffness}" kv="{m.joint_damping}" '
        f'forcerange="-{m.joint_torque} {m.joint_torque}"/>'
        for name in JOINT_NAMES
    )
    return f"""
    <mujoco>
      <compiler autolimits="true"/>
      <option gravity="0 0 {-gravity}" timestep="{c.time_step}" integrator="implicitfast" cone="elliptic"
        impratio="{c.friction_over_normal}"/>
      <default><geom friction="{friction} 0 0" condim="3" solref="{c.time_constant} 1"/></default>
      <worldbody>
        <geom name="ground" type="plane" size="0 0 1" {_place(X_WG)} contype="2" conaffinity="1"/>
        {robot}
      </worldbody>
      <actuator>{servos}</actuator>
    </mujoco>"""


def _model_of(sdf: str) -> ET.Element:
    model = ET.fromstring(sdf).find("model")
    assert model is not None
    return model


def _text(element: ET.Element, path: str) -> str:
    text = element.findtext(path)
    assert text is not None, path
    return text


def _pose(pose: ET.Element | None) -> RigidTransform:
    assert pose is not None
    x, y, z, *rpy = (float(value) for value in (pose.text or "").split())
    return RigidTransform(RollPitchYaw(rpy), [x, y, z])


def _place(X: RigidTransform) -> str:
    return f'pos="{_numbers(X.translation())}" quat="{_numbers(X.rotation().ToQuaternion().wxyz())}"'


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def _hinge(joint: ET.Element) -> str:
    return f'<joint name="{joint.get("name")}" type="hinge" axis="{_text(joint, "axis/xyz")}"/>'


def _inertial(link: ET.Element, mass: float | None = None) -> str:
    """Return the inertia of a link; another mass scales it."""
    nominal = float(_text(link, "inertial/mass"))
    scale = 1.0 if mass is None else mass / nominal
    tensor = [scale * float(_text(link, f"inertial/inertia/{name}")) for name in _TENSOR]
    place = _pose(link.find("inertial/pose")).translation()
    return f'<inertial pos="{_numbers(place)}" mass="{scale * nominal:.12g}" fullinertia="{_numbers(tensor)}"/>'


# MuJoCo's order.
_TENSOR = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def _foot(collision: ET.Element) -> str:
    centre = _pose(collision.find("pose")).translation()
    radius = _text(collision, "geometry/sphere/radius")
    return f'<geom type="sphere" size="{radius}" pos="{_numbers(centre)}" contype="1" conaffinity="2"/>'


@dataclass(frozen=True)
class Walk:
    """A walk in MuJoCo.

    Attributes:
        fallen_at: When the robot had tipped over, in s; infinite if it had not.
        times: Times of the samples in s, shape (n,).
        poses: Position in m, then roll, pitch and yaw in rad of the torso, shape (n, 6).
    """

    fallen_at: float
    times: NDArray[np.float64]
    poses: NDArray[np.float64]


@dataclass(frozen=True)
class MujocoClimber:
    """The robot in MuJoCo, walked by its DPS.

    Attributes:
        scenario: Gravity, slope, friction, gait and period.
        morphology: Dimensions and masses; the DPS knows them.
        lever: How far the attachment's centre lies ahead of the torso's, in m; None as in the morphology.
        contact: MuJoCo's settings.
    """

    scenario: SpaceClimberScenario = field(default_factory=SpaceClimberScenario)
    morphology: Morphology = field(default_factory=Morphology)
    lever: float | None = None
    contact: Contact = field(default_factory=Contact)

    @cached_property
    def dps(self) -> Diagram:
        """Return the DPS of the scenario, which walks this robot."""
        return make_dps(self.scenario.gait, period=self.scenario.period, morphology=self.morphology)

    def mjcf(self, mass: float) -> str:
        """Return MuJoCo's model of the robot with an attachment, see `climber_mjcf`.

        Args:
            mass: Mass of the attachment in kg.
        """
        world = self.scenario
        return climber_mjcf(
            mass,
            morphology=self.morphology,
            lever=self.lever,
            gravity=world.gravity,
            slope_deg=world.slope_deg,
            friction=world.friction,
            contact=self.contact,
        )

    def walk(self, mass: float, *, phase: float = 0.0, stroke: bool = True, horizon: float = HORIZON) -> Walk:
        """Walk with an attachment until the robot tips over, or the horizon.

        As in the testbed, sensors and DPS are sampled at the same instants: the DPS sees the sensors' last values.

        Args:
            mass: Mass of the attachment in kg.
            phase: Start phase of the gait in cycles.
            stroke: False stands.
            horizon: Longest duration in s.
        """
        engine = extra_module("mujoco", purpose="the climber in a second engine", extra="dev")
        period = self.scenario.period
        world = _World(engine, self.mjcf(mass), self.morphology, period=period)
        dps, context = self.dps, self.dps.CreateDefaultContext()
        collect(dps).write(context, {PHASE.removeprefix("dps."): phase})
        dps.GetInputPort("heading").FixValue(context, [0.0])
        dps.GetInputPort("walk").FixValue(context, [float(stroke)])
        command = dps.GetOutputPort("joint_position")
        times, poses, fallen_at = [], [], inf
        for tick in range(round(horizon / period) + 1):
            if tick % round(SAMPLE_PERIOD / period) == 0:
                times.append(tick * period)
                poses.append(world.pose())
                if tipped_over(poses[-1][4]):
                    fallen_at = times[-1]
                    break
            for name, value in world.measurements.items():
                dps.GetInputPort(name).FixValue(context, value)
            update = dps.EvalUniquePeriodicDiscreteUpdate(context)
            world.measure()
            context.SetDiscreteState(update)
            world.advance(command.Eval(context))
        return Walk(fallen_at, np.array(times), np.array(poses))

    def boundary(
        self, lower: float, upper: float, *, resolution: float, coarse: float, phases: Sequence[float] = PHASES
    ) -> tuple[float, float]:
        """Return the largest mass up to which no walk tips over, and the smallest at which one does.

        Coarse steps go up to the first mass with which the robot tips over from some start phase. Fine ones begin two
        coarse ones below it: near the limit the outcome is not monotonic.

        Args:
            lower: Smallest mass in kg.
            upper: Largest mass in kg.
            resolution: Fine step in kg.
            coarse: Coarse step in kg.
            phases: Start phases of the gait in cycles.

        Returns:
            (lower, upper) in kg; an end is infinite where there is no such mass.
        """
        first = self._first_fall(np.arange(lower, upper + 0.5 * coarse, coarse), phases)
        if not isfinite(first):
            return upper, inf
        if first <= lower:
            return -inf, first
        begin = max(lower, first - 2.0 * coarse)
        fine = self._first_fall(np.arange(begin, first - 0.5 * resolution, resolution), phases)
        limit = min(fine, first)
        return (limit - resolution if limit > lower else -inf), limit

    def _first_fall(self, masses: NDArray[np.float64], phases: Sequence[float]) -> float:
        """Return the first mass with which the robot tips over from some start phase; infinite if there is none."""
        falls = (float(mass) for mass in masses for phase in phases if isfinite(self.walk(mass, phase=phase).fallen_at))
        return next(falls, inf)


def base_motion(qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the orientation (wxyz) and the velocities [angular; linear] of the base in the world, shape (10,).

    Args:
        qpos: MuJoCo's positions, which begin with the base's position and orientation.
        qvel: MuJoCo's velocities, which begin with the linear one in the world and the angular one in the base's frame.
    """
    q = qpos[3:7] / np.linalg.norm(qpos[3:7])
    R_WB = RotationMatrix(Quaternion(*q)).matrix()
    return np.concatenate([q, R_WB @ qvel[3:6], qvel[:3]])


class _World:
    """The robot in MuJoCo, with the sensors of the testbed."""

    def __init__(self, engine: Any, mjcf: str, morphology: Morphology, *, period: float) -> None:
        self._engine, self._period = engine, period
        self._model = engine.MjModel.from_xml_string(mjcf)
        self._data = engine.MjData(self._model)
        self._steps = round(period / self._model.opt.timestep)
        name = engine.mjtObj.mjOBJ_JOINT
        addresses = [engine.mj_name2id(self._model, name, joint) for joint in JOINT_NAMES]
        self._joints = self._model.jnt_qposadr[addresses]
        feet = [self._model.body(link).id for link in FOOT_LINKS]
        self._foot_of = {int(self._model.body_geomadr[body]): k for k, body in enumerate(feet)}
        self._data.qpos[self._joints] = LegKinematics(morphology).inverse(morphology.stance).ravel()
        self._data.ctrl[:] = self._data.qpos[self._joints]
        engine.mj_forward(self._model, self._data)
        # As the testbed's sensors show before their first sample.
        self._imu_memory = np.zeros(8)
        self.measurements = {
            "imu": self._imu(np.zeros(8)),
            "joint_encoders": self._data.qpos[self._joints].copy(),
            "foot_contact": np.zeros(len(FOOT_LINKS)),
        }

    def measure(self) -> None:
        self.measurements = {
            "imu": self._imu(self._imu_memory),
            "joint_encoders": self._data.qpos[self._joints].copy(),
            "foot_contact": self._switches(),
        }

    def advance(self, targets: NDArray[np.float64]) -> None:
        self._data.ctrl[:] = targets
        self._engine.mj_step(self._model, self._data, nstep=self._steps)

    def pose(self) -> NDArray[np.float64]:
        w, x, y, z = self._data.qpos[3:7]
        return np.concatenate([self._data.qpos[:3], RollPitchYaw(Quaternion(w, x, y, z)).vector()])

    def _imu(self, memory: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(
            sample(
                base_motion(self._data.qpos, self._data.qvel),
                orientation=0,
                velocity=4,
                mount=np.zeros(6),
                g_W=np.array(self._model.opt.gravity),
                memory=memory,
                period=self._period,
            )
        )

    def _switches(self) -> NDArray[np.float64]:
        forces, force = np.zeros(len(FOOT_LINKS)), np.zeros(6)
        for k in range(self._data.ncon):
            self._engine.mj_contactForce(self._model, self._data, k, force)
            (foot,) = (self._foot_of[geom] for geom in self._data.contact[k].geom if geom in self._foot_of)
            forces[foot] += np.linalg.norm(force[:3])
        return (forces > SWITCH_FORCE).astype(float)
