r"""A worker on foot who carries the localization unit, in the hand or on the back, and moves it by the gait.

B is the unit: Bo is where its IMU and its scanner are, x forward, z up. The worker walks on the ground at the speed v
along a path; the unit is moved with the gait about this path. With the phase phi of the stride (two steps), the step
frequency f, and the height h of the unit,

    z = ground + h - b/2 cos(2 phi),    b = `bob` up and down,
    left = s/2 sin(phi),    s = `sway` from side to side,
    roll = r/2 sin(phi),    pitch = p/2 sin(2 phi),    yaw = path + y/2 sin(phi),    d phi/dt = pi f,

all of them in proportion to the speed below 1.2 m/s, and so 0 for a worker who stands. The numbers are published for
1.2 m/s: the trunk tilts by 4.0 deg, bends sideways by 3.3 deg and turns by 6.9 deg (ranges), with 108 to 115 steps per
minute (Chung and others, "Kinematic aspects of trunk motion and gender effect in normal adults", Journal of
NeuroEngineering and Rehabilitation 7:9, 2010); the centre of mass moves up and down by some 4 cm, and from side to side
by some 5 cm (Orendurff and others, "The effect of walking speed on center of mass displacement", Journal of
Rehabilitation Research and Development 41:829, 2004). Steps are sqrt(v / 1.2 m/s) as frequent. [assumed]

Nobody holds a unit still: roll, pitch and yaw wander, also of a worker who stands, each as a sum of three sines with
periods of 4 to 15 s and the standard deviations of the `Worker` [assumed]. Impacts of heels are not simulated.

The motion is prescribed: the applied force is what takes the unit to its next pose in one step of the discrete plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, pi, sin, sqrt

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Box, Cylinder
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RigidBody, SpatialInertia
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from vtbdrake.common.arrays import Array
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.forest.world.carrier import INSTANCE, quaternion_matrix
from vtbdrake_diagrams.forest.world.ground import Ground

PLACES = {"hand": 0.45, "back": -0.25}
"""The places at which a worker carries the unit, each with its distance in front of the middle of the body in m."""

WALKER = 7
"""The size of the port ``walker`` of `Legs`: quaternion and position."""

# The speed in m/s for which the gait is published.
_PUBLISHED_SPEED = 1.2
# The number of sines of the wander, and the range of their periods in s.
_SINES = 3
_PERIODS = (4.0, 15.0)
# A stream of random numbers; the forest has others.
_WANDER = 21

_SKIN = np.array([0.85, 0.45, 0.1, 1.0])
_BLACK = np.array([0.1, 0.1, 0.1, 1.0])


@dataclass(frozen=True)
class Worker:
    """Dimensions and gait of a worker who carries the unit; ranges are from peak to peak, at 1.2 m/s.

    Attributes:
        forward: Distance of the unit in front of the middle of the body in m.
        height: Height of the unit over the ground in m.
        mass: Mass of the unit in kg.
        stature: Height of the worker in m, without the unit.
        radius: Radius of the body in m, which hides a part of the view.
        step_frequency: Number of steps per second.
        bob: Range of the height in m, once per step.
        sway: Range to the sides in m, once per stride.
        surge: Range along the path in m, once per step; assumed.
        roll: Range of the roll in rad, once per stride.
        pitch: Range of the pitch in rad, once per step.
        yaw: Range of the yaw in rad, once per stride.
        tilt_wander: Standard deviation of the slow wander of roll and of pitch in rad; assumed.
        yaw_wander: Standard deviation of the slow wander of the direction in which the unit points in rad; assumed.
        acceleration: Largest acceleration of the walk in m/s^2.
    """

    forward: float = PLACES["back"]
    height: float = 2.0
    mass: float = 5.0
    stature: float = 1.75
    radius: float = 0.2
    step_frequency: float = 1.85
    bob: float = 0.04
    sway: float = 0.05
    surge: float = 0.015
    roll: float = float(np.radians(3.3))
    pitch: float = float(np.radians(4.0))
    yaw: float = float(np.radians(6.9))
    tilt_wander: float = float(np.radians(1.0))
    yaw_wander: float = float(np.radians(1.0))
    acceleration: float = 1.0

    @classmethod
    def carrying(cls, place: str, *, height: float, step_frequency: float) -> Worker:
        """Return a worker who carries the unit in the hand or on the back.

        Args:
            place: One of `PLACES`. In the hand, the unit wanders by 3 deg in roll and pitch and by 5 deg in yaw, on the
                back by 1 deg.
            height: Height of the unit over the ground in m.
            step_frequency: Number of steps per second at 1.2 m/s.
        """
        worker = cls(PLACES[place], height, step_frequency=step_frequency)
        if place == "back":
            return worker
        return replace(worker, tilt_wander=float(np.radians(3.0)), yaw_wander=float(np.radians(5.0)))


def add_worker(plant: MultibodyPlant, worker: Worker, X_BL: RigidTransform) -> RigidBody:
    """Add the unit to a plant, floating freely, as the model instance ``carrier`` with the body ``base``.

    The frame ``scanner`` of the body is L. The worker's body, a cylinder, is fixed to the unit. Nothing collides.

    Args:
        plant: A plant that is registered with a SceneGraph, and not finalized.
        worker: The worker.
        X_BL: The pose of the scanner.
    """
    instance = plant.AddModelInstance(INSTANCE)
    base = plant.AddRigidBody("base", instance, SpatialInertia.SolidSphereWithMass(worker.mass, 0.1))
    plant.AddFrame(FixedOffsetFrame("scanner", base.body_frame(), X_BL, instance))
    middle = RigidTransform([-worker.forward, 0.0, 0.5 * worker.stature - worker.height])
    plant.RegisterVisualGeometry(base, middle, Cylinder(worker.radius, worker.stature), "body", _SKIN)
    below = RigidTransform([0.0, 0.0, -0.17])
    plant.RegisterVisualGeometry(base, below, Box(0.1, 0.1, 0.1), "unit", _BLACK)
    return base


class Legs(AddressedSystem):
    """The walk of a `Worker` (equations in the module), as the force that moves the unit.

    .. pydrake_system::

        name: Legs
        input_ports:
        - state
        - controls
        output_ports:
        - spatial_force
        - walker

    ``state`` is the plant's [q; v], ``controls`` the speed (m/s) and the curvature of the path (1/m, to the left) as
    the driver wants them. ``spatial_force`` is the force on the unit, as one spatial force at Bo. ``walker`` is the
    pose of the worker on the path, without the gait: quaternion and position (m), (7,).

    State: position (m) and ``heading`` (rad) on the path, ``speed`` (m/s), and the ``phase`` of the stride (rad).
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        body: RigidBody,
        worker: Worker,
        ground: Ground,
        *,
        position: Sequence[float] | Array,
        heading: float,
        seed: int = 0,
    ) -> None:
        """Declare the system.

        Args:
            plant: The finalized plant: discrete, as the walk is stepped with it.
            body: The unit, see `add_worker`.
            worker: The worker.
            ground: The ground.
            position: Where the worker stands at first, (2,) in m.
            heading: The direction of the path there in rad.
            seed: Determines how the unit wanders.
        """
        super().__init__()
        self._worker, self._ground, self._step = worker, ground, float(plant.time_step())
        self._body, self._q = body.index(), body.floating_positions_start()
        self._v = plant.num_positions() + body.floating_velocities_start_in_v()
        self._inertia = 0.4 * worker.mass * 0.1**2
        self._weight = worker.mass * np.array(plant.gravity_field().gravity_vector())
        rng = np.random.default_rng([seed, _WANDER])
        # Frequencies in rad/s and phases in rad of the sines of roll, pitch and yaw, (3, 3) each.
        self._rates = 2.0 * pi / rng.uniform(*_PERIODS, (3, _SINES))
        self._phases = rng.uniform(-pi, pi, (3, _SINES))
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._controls = self.DeclareVectorInputPort("controls", 2)
        self._walk = self.declare_discrete_state(
            position=Quantity([float(p) for p in position], "m"),
            heading=Quantity(float(heading), "rad"),
            speed=Quantity(0.0, "m/s"),
            phase=Quantity(0.0, "rad"),
        )
        self.DeclareAbstractOutputPort(
            "spatial_force", lambda: Value([ExternallyAppliedSpatialForce()]), self._calc_force
        )
        self.DeclareVectorOutputPort(
            "walker", WALKER, self._calc_walker, prerequisites_of_calc={self.discrete_state_ticket(self._walk.index)}
        )
        self.DeclarePeriodicDiscreteUpdateEvent(self._step, 0.0, self._update)

    def unit_pose(self, position: Array, heading: float, speed: float, phase: float, *, time: float) -> RigidTransform:
        """Return the pose X_WB of the unit at a point of the walk.

        Args:
            position: The position on the path, (2,) in m.
            heading: The direction of the path in rad.
            speed: The speed in m/s.
            phase: The phase of the stride in rad.
            time: The time in s, for the wander.
        """
        worker, ease = self._worker, 0.5 * min(speed / _PUBLISHED_SPEED, 1.0)
        once, twice = ease * sin(phase), ease * sin(2.0 * phase)
        ahead = worker.forward + worker.surge * twice
        x = position[0] + ahead * cos(heading) - worker.sway * once * sin(heading)
        y = position[1] + ahead * sin(heading) + worker.sway * once * cos(heading)
        height = self._ground.height(np.array([position[0]]), np.array([position[1]])).item()
        z = height + worker.height - worker.bob * ease * cos(2.0 * phase)
        wander = sqrt(2.0 / _SINES) * np.sin(self._rates * time + self._phases).sum(axis=1)
        roll = worker.roll * once + worker.tilt_wander * wander[0]
        pitch = worker.pitch * twice + worker.tilt_wander * wander[1]
        yaw = heading + worker.yaw * once + worker.yaw_wander * wander[2]
        return RigidTransform(RollPitchYaw(roll, pitch, yaw), [x, y, z])

    def _next(self, context: Context) -> tuple[Array, float, float, float]:
        """Return position, heading, speed and phase one step later."""
        walk, (target_speed, curvature) = self._walk.view(context), self._controls.Eval(context).tolist()
        T, most = self._step, self._worker.acceleration * self._step
        speed = walk.speed + min(max(target_speed - walk.speed, -most), most)
        heading = walk.heading + T * speed * curvature
        middle = 0.5 * (walk.heading + heading)
        position = walk.position + T * speed * np.array([cos(middle), sin(middle)])
        frequency = self._worker.step_frequency * sqrt(max(speed, 0.0) / _PUBLISHED_SPEED)
        return position, heading, speed, walk.phase + T * pi * frequency

    def _calc_force(self, context: Context, output: Value) -> None:  # type: ignore[valid-type]
        T, x = self._step, self._state.Eval(context)
        X_WB = self.unit_pose(*self._next(context), time=context.get_time() + T)
        R_now = RotationMatrix(quaternion_matrix(x[self._q : self._q + 4]))
        turn = (X_WB.rotation() @ R_now.inverse()).ToAngleAxis()
        w = turn.angle() / T * turn.axis()
        v = (X_WB.translation() - x[self._q + 4 : self._q + 7]) / T
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self._body
        applied.F_Bq_W = SpatialForce(
            tau=self._inertia * (w - x[self._v : self._v + 3]) / T,
            f=self._worker.mass * (v - x[self._v + 3 : self._v + 6]) / T - self._weight,
        )
        output.set_value([applied])  # type: ignore[attr-defined]

    def _calc_walker(self, context: Context, output: BasicVector) -> None:
        walk = self._walk.view(context)
        half = 0.5 * walk.heading
        output.SetFromVector([cos(half), 0.0, 0.0, sin(half), *walk.position.tolist(), 0.0])

    def _update(self, context: Context, state: DiscreteValues) -> None:
        walk = self._walk.mutable(state)
        walk.position, walk.heading, walk.speed, walk.phase = self._next(context)
