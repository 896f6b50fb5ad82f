r"""The carrier: a small forest machine with four wheels on uneven ground.

Frames: B is the body of the carrier, with x forward and z up; Bo is in the middle between the four wheels at the level
of the ground on which the carrier stands. L is the scanner. W is the world.

Each wheel i touches the ground at the point Ci that is below (or above) a point of B at the height of Bo. With the unit
normal n of the ground there, its height h and the velocity v of Ci as a point of B, the ground presses by

    N = max(0, k (s + (h - z_Ci) n_z) - c v·n),

a spring (suspension and tyre in series) and a damper. The static sag s carries a quarter of the weight, so that the
machine stands with Bo on level ground. Across and along the wheel the tyre is deflected by u: the single contact point
model of transient slip (Pacejka, Tire and Vehicle Dynamics, 2012, chapter 7),

    du/dt = w - |V| u / sigma,    F = -C u - d w,

where w is the velocity at which the contact slides over the ground, V the speed of the tread and sigma the relaxation
length. In a steady curve, u = sigma w / |V|: F is proportional to the slip angle, with the cornering stiffness
C sigma; at rest, the tyre is a spring, and holds the machine on a slope. F is at most mu N (Coulomb).

Drive and steering are ideal but not instantaneous: treads run at the speeds that the machine's geometry prescribes
(Ackermann: the front wheels steer, and their axes meet the rear axis), while speed and curvature follow the
driver's commands at limited rates. So wheels slip as forces demand, and the wheel odometry is wrong by this slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.geometry import Box, Cylinder
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RigidBody, SpatialInertia
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
)

from vtbdrake.common.arrays import Array
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.forest.world.ground import Ground

INSTANCE = "carrier"

# The scanner's mast ends at this distance below the scanner's origin, in m.
_BELOW_SCANNER = 0.12

_GREEN = np.array([0.2, 0.45, 0.25, 1.0])
_BLACK = np.array([0.1, 0.1, 0.1, 1.0])


@dataclass(frozen=True)
class Carrier:
    """Dimensions, masses and wheels of the carrier; all of them are assumed.

    Attributes:
        length: Length of the body in m.
        width: Width over the wheels in m.
        height: Height of the body's upper side over the ground in m.
        clearance: Height of the body's lower side over the ground in m.
        wheel_base: Distance of the axles in m.
        track: Distance of the wheels of an axle in m.
        wheel_radius: Radius of the wheels in m, for the illustration only.
        mass: Mass in kg, without the scanner.
        centre_height: Height of the centre of mass over the ground in m.
        sag: Static deflection of springs and tyres under the weight in m.
        damping_ratio: Damping ratio of the vertical oscillation of the body on its wheels.
        cornering: Cornering stiffness per rad of slip angle and N of load.
        relaxation_length: Relaxation length sigma of the tyres in m.
        friction: Coulomb's coefficient mu of tyres and ground.
        largest_curvature: Largest curvature of the path of the middle of the rear axle in 1/m.
        curvature_rate: Largest rate of the curvature in 1/(m s).
        acceleration: Largest acceleration of the treads in m/s^2.
    """

    length: float = 2.5
    width: float = 1.5
    height: float = 1.2
    clearance: float = 0.35
    wheel_base: float = 1.6
    track: float = 1.2
    wheel_radius: float = 0.4
    mass: float = 1200.0
    centre_height: float = 0.7
    sag: float = 0.05
    damping_ratio: float = 0.4
    cornering: float = 5.0
    relaxation_length: float = 0.3
    friction: float = 0.7
    largest_curvature: float = 0.35
    curvature_rate: float = 0.5
    acceleration: float = 0.5

    def __post_init__(self) -> None:
        if not min(getattr(self, name) for name in self.__dataclass_fields__) > 0.0:
            raise ValueError(f"all dimensions and properties of a carrier are positive: {self}")

    @property
    def p_BoC_B(self) -> Array:
        """The positions of the wheels in B in m, (4, 3): front left, front right, rear left, rear right."""
        x, y = self.wheel_base / 2.0, self.track / 2.0
        return np.array([(x, y, 0.0), (x, -y, 0.0), (-x, y, 0.0), (-x, -y, 0.0)])

    @property
    def inertia(self) -> SpatialInertia:
        """The spatial inertia of B about Bo: a box with its centre of mass at `centre_height`."""
        box = SpatialInertia.SolidBoxWithMass(self.mass, self.length, self.width, self.height - self.clearance)
        return box.Shift([0.0, 0.0, -self.centre_height])


def add_carrier(plant: MultibodyPlant, carrier: Carrier, X_BL: RigidTransform) -> RigidBody:
    """Add the carrier to a plant, floating freely, as the model instance ``carrier`` with the body ``base``.

    The frame ``scanner`` of the body is L. The body collides with nothing: wheels carry it (`Wheels`), and a driver
    keeps it away from trees.

    Args:
        plant: A plant that is registered with a SceneGraph, and not finalized.
        carrier: The carrier.
        X_BL: The pose of the scanner, which is on top of a mast.
    """
    instance = plant.AddModelInstance(INSTANCE)
    base = plant.AddRigidBody("base", instance, carrier.inertia)
    plant.AddFrame(FixedOffsetFrame("scanner", base.body_frame(), X_BL, instance))
    body = carrier.height - carrier.clearance
    middle = RigidTransform([0.0, 0.0, carrier.clearance + body / 2.0])
    narrow = carrier.track - carrier.wheel_radius
    plant.RegisterVisualGeometry(base, middle, Box(carrier.length, narrow, body), "body", _GREEN)
    raised = np.array([0.0, 0.0, carrier.wheel_radius])
    thickness = carrier.width - carrier.track
    for k, p_BoC_B in enumerate(carrier.p_BoC_B):
        X_BWheel = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2.0), p_BoC_B + raised)
        plant.RegisterVisualGeometry(base, X_BWheel, Cylinder(carrier.wheel_radius, thickness), f"wheel_{k}", _BLACK)
    x, y, z = X_BL.translation()
    mast = z - _BELOW_SCANNER - carrier.height
    if mast > 0.0:
        X_BM = RigidTransform([x, y, carrier.height + mast / 2.0])
        plant.RegisterVisualGeometry(base, X_BM, Cylinder(0.03, mast), "mast", _BLACK)
    return base


def standing_pose(
    carrier: Carrier, ground: Ground, *, position: Sequence[float] | Array, heading: float
) -> RigidTransform:
    """Return the pose X_WB in which the carrier stands: with its wheels, on average, on the ground.

    Args:
        carrier: The carrier.
        ground: The ground.
        position: Position (x, y) of Bo in W in m, shape (2,).
        heading: The direction of B's x axis in the plane, in rad.
    """
    across = RotationMatrix.MakeZRotation(heading) @ carrier.p_BoC_B.T
    x, y = across[0] + position[0], across[1] + position[1]
    heights = ground.height(x, y)
    front_left, front_right, rear_left, rear_right = heights.tolist()
    pitch = atan2(rear_left + rear_right - front_left - front_right, 2.0 * carrier.wheel_base)
    roll = atan2(front_left + rear_left - front_right - rear_right, 2.0 * carrier.track)
    return RigidTransform(RollPitchYaw(roll, pitch, heading), [position[0], position[1], float(heights.mean())])


class _Contact(NamedTuple):
    """The forces of the ground on the four wheels."""

    # The tyres' deflections at the end of the step, (4, 2) in m.
    deflections: Array
    # Force in N and moment about Bo in N m on the carrier, in W, (3,) each.
    force: Array
    moment: Array
    # The forces by which the ground presses on the wheels, (4,) in N.
    loads: Array


class Wheels(AddressedSystem):
    """The forces of the ground on the wheels of a `Carrier` (equations in the module), and its drive and steering.

    .. pydrake_system::

        name: Wheels
        input_ports:
        - state
        - controls
        output_ports:
        - spatial_force
        - speed

    ``state`` is the plant's [q; v], ``controls`` the speed of the middle of the rear axle (m/s) and the curvature of
    its path (1/m, to the left) as the driver wants them. ``spatial_force`` is the force of the ground on the carrier,
    as one spatial force at Bo. ``speed`` is the present mean speed of the treads of the rear wheels (m/s).

    The system is stepped with the plant's period. A force is computed from the deflection at the end of the step, which
    makes the spring of a tyre as stable as the plant's own semi-implicit step.
    """

    def __init__(self, plant: MultibodyPlant, body: RigidBody, carrier: Carrier, ground: Ground) -> None:
        """Declare the system.

        Args:
            plant: The finalized plant: discrete, as the wheels are stepped with it.
            body: The carrier's body B, see `add_carrier`.
            carrier: The carrier, for its dimensions and tyres.
            ground: The ground.
        """
        super().__init__()
        self._ground, self._step = ground, float(plant.time_step())
        self._body = body.index()
        self._q, self._v = (
            body.floating_positions_start(),
            plant.num_positions() + body.floating_velocities_start_in_v(),
        )
        self._p_BoC_B = carrier.p_BoC_B
        gravity = float(np.linalg.norm(plant.gravity_field().gravity_vector()))
        load = carrier.mass * gravity / 4.0
        self._load, self._stiffness = load, load / carrier.sag
        self._damping = 2.0 * carrier.damping_ratio * (self._stiffness * carrier.mass / 4.0) ** 0.5
        self._wheel_base, self._sigma = carrier.wheel_base, carrier.relaxation_length
        tyre = carrier.cornering * load / carrier.relaxation_length
        # A quarter of critical damping of the tyres' own oscillation.
        self._tyre = (tyre, 0.5 * (tyre * carrier.mass / 4.0) ** 0.5)
        # In one step.
        self._speed_change = carrier.acceleration * self._step
        self._curvature_change = carrier.curvature_rate * self._step
        self._largest_curvature = carrier.largest_curvature

        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._controls = self.DeclareVectorInputPort("controls", 2)
        self._drive = self.declare_discrete_state(speed=Quantity(0.0, "m/s"), curvature=Quantity(0.0, "1/m"))
        self._tyres = self.declare_discrete_state(deflection=Quantity(np.zeros((4, 2)), "m"))
        self._settings = self.declare_parameters(friction=Quantity(carrier.friction, bounds=(0.0, np.inf)))
        sources = {
            self._state.ticket(),
            self.discrete_state_ticket(self._drive.index),
            self.discrete_state_ticket(self._tyres.index),
            self.all_parameters_ticket(),
        }
        self._contact = self.declare_cache("contact", self._calc_contact, sources)
        self.DeclareAbstractOutputPort(
            "spatial_force",
            lambda: Value([ExternallyAppliedSpatialForce()]),
            self._calc_force,
            prerequisites_of_calc=sources,
        )
        self.DeclareVectorOutputPort(
            "speed",
            1,
            self._calc_speed,
            prerequisites_of_calc={self.discrete_state_ticket(self._drive.index)},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(self._step, 0.0, self._update)

    def _calc_contact(self, context: Context) -> _Contact:
        x, drive = self._state.Eval(context), self._drive.view(context)
        friction, deflections = self._settings.view(context).friction, self._tyres.view(context).deflection

        R_WB = quaternion_matrix(x[self._q : self._q + 4])
        p_WBo, w_WB, v_WBo = x[self._q + 4 : self._q + 7], x[self._v : self._v + 3], x[self._v + 3 : self._v + 6]
        arms = self._p_BoC_B @ R_WB.T
        places = p_WBo + arms
        heights, slopes = self._ground.height_and_slope(places[:, 0], places[:, 1])
        normals = np.column_stack([-slopes, np.ones(4)]) / np.sqrt(1.0 + (slopes**2).sum(axis=1))[:, np.newaxis]
        # The contact point lies on the ground.
        arms[:, 2] += heights - places[:, 2]
        velocities = v_WBo + _cross(w_WB, arms)
        approach = (heights - places[:, 2]) * normals[:, 2]
        pressed = self._load + self._stiffness * approach - self._damping * (velocities * normals).sum(axis=1)
        N = np.maximum(pressed, 0.0)

        forward, treads = self._rolling(R_WB, drive.speed, drive.curvature)
        along = forward - (forward * normals).sum(axis=1)[:, np.newaxis] * normals
        along /= np.sqrt((along**2).sum(axis=1))[:, np.newaxis]
        left = _cross(normals, along)
        slip = np.column_stack([(velocities * along).sum(axis=1) - treads, (velocities * left).sum(axis=1)])
        tyre, damping = self._tyre
        fade = 1.0 + (self._step / self._sigma) * np.abs(treads)
        u = (deflections + self._step * slip) / fade[:, np.newaxis]
        F = -tyre * u - damping * slip
        size = np.sqrt((F**2).sum(axis=1))
        share = np.minimum(1.0, friction * N / np.maximum(size, 1e-9))[:, np.newaxis]
        F *= share
        # A sliding tyre is deflected as far as its force, which is limited by friction, deflects it.
        u = np.where(share < 1.0, -F / tyre, u)
        forces = N[:, np.newaxis] * normals + F[:, :1] * along + F[:, 1:] * left
        return _Contact(u, forces.sum(axis=0), _cross(arms, forces).sum(axis=0), N)

    def _rolling(self, R_WB: Array, speed: float, curvature: float) -> tuple[Array, Array]:
        """Return the directions in which the wheels roll, in W, (4, 3), and the speeds of their treads (m/s), (4,)."""
        # Positions relative to the middle of the rear axle, which moves at the given speed along the curve.
        x, y = self._p_BoC_B[:, 0] + self._wheel_base / 2.0, self._p_BoC_B[:, 1]
        ways = np.column_stack([1.0 - curvature * y, curvature * x])
        lengths = np.sqrt((ways**2).sum(axis=1))
        return (ways / lengths[:, np.newaxis]) @ R_WB[:, :2].T, speed * lengths

    def _calc_force(self, context: Context, output: Value) -> None:  # type: ignore[valid-type]
        contact: _Contact = self._contact(context)
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self._body
        applied.F_Bq_W = SpatialForce(tau=contact.moment, f=contact.force)
        output.set_value([applied])  # type: ignore[attr-defined]

    def _calc_speed(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._drive.view(context).speed)

    def wheel_loads(self, context: Context) -> Array:
        """Return the forces in N by which the ground presses on the wheels, (4,), in the order of `Carrier.p_BoC_B`."""
        contact: _Contact = self._contact(context)
        return contact.loads

    def _update(self, context: Context, state: DiscreteValues) -> None:
        contact: _Contact = self._contact(context)
        speed, curvature = self._controls.Eval(context).tolist()
        largest = self._largest_curvature
        curvature = min(max(curvature, -largest), largest)
        drive = self._drive.mutable(state)
        drive.speed += min(max(speed - drive.speed, -self._speed_change), self._speed_change)
        drive.curvature += min(max(curvature - drive.curvature, -self._curvature_change), self._curvature_change)
        self._tyres.mutable(state).deflection = contact.deflections


def quaternion_matrix(q: Array) -> Array:
    """Return R_WB, shape (3, 3), of a quaternion (w, x, y, z) that may not have unit length."""
    R_WB: Array = RotationMatrix(Quaternion(q / np.sqrt(q @ q))).matrix()
    return R_WB


def _cross(a: Array, b: Array) -> Array:
    """Return a x b for vectors in the last axis; much faster than numpy's for a few vectors."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


class WheelOdometer(SampledSensor):
    """Measures the speed at which the wheels roll.

    .. pydrake_system::

        name: WheelOdometer
        input_ports:
        - speed (of `Wheels`)
        output_ports:
        - odometry

    ``odometry`` is the mean speed of the rear treads (m/s) times the parameter ``scale``: the radius of the wheels by
    which the sensor computes it, over the true one. The carrier is faster or slower by the slip.
    """

    def __init__(self, *, period: float, scale: float = 1.0, errors: ErrorModel | None = None) -> None:
        """Declare the sensor.

        Args:
            period: Sample period in s.
            scale: The initial value of the parameter ``scale``: measured over true speed of the treads.
            errors: The errors of the sensor in m/s; none by default.
        """
        noise = {"noise": (1, "m/s")}
        super().__init__("odometry", default=[0.0], period=period, unit="m/s", noise=noise, errors=errors)
        self._speed = self.DeclareVectorInputPort("speed", 1)
        self._settings = self.declare_parameters(scale=Quantity(scale, bounds=(0.0, np.inf)))

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        measured: Array = self._speed.Eval(context) * self._settings.view(context).scale
        return measured
