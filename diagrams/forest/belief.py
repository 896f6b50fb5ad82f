"""The belief of the localization unit about the simulated world: pose, motion and route of its carrier."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.math import RollPitchYaw

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.planar import chord, compose, inverse
from vtbdrake.testbed import VirtualTestbedBuilder
from vtbdrake_diagrams.forest.world.carrier import Carrier, standing_pose
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.routes import Route
from vtbdrake_diagrams.forest.world.worker import Worker

_PLACE = ("dps.env.pose.position", "dps.env.pose.heading")
_MOTION = ("dps.env.dead_reckoning.speed", "dps.env.dead_reckoning.turn_rate")
# The route that the DPS advises.
_ADVICE = "dps.impl.route.discrete_state_0[0]"

# A carrier that is farther from the advised route than this is on another one, in m.
_OFF = 1.5
# Below this speed in m/s, the turn rate does not show the steering.
_SLOW = 0.05


def declare_belief(
    builder: VirtualTestbedBuilder, carrier: Carrier, ground: Ground, routes: Sequence[Route], *, age: float
) -> None:
    """Declare how the estimates of the DPS set the state of the carrier and of its driver.

    The carrier has the position and heading by the DPS, the height at which it stands there, and the measured roll and
    pitch; it rolls without slip. The driver is on the advised route, or else on the nearest one.

    The belief holds for the time of the measured motion. The pose of the DPS, which is the present one, is moved
    back by this motion.

    A carrier that is not localized has no belief: asking for it raises a ValueError.

    Args:
        builder: The builder of the testbed.
        carrier: The carrier.
        ground: The elevation map of the DPS: the simulated ground's.
        routes: The routes by number.
        age: The age of the measured motion in s.
    """
    rear = carrier.wheel_base / 2.0

    def axle(position: Array, heading: float, speed: float, turn_rate: float) -> Array:
        """Return the past pose [x, y, heading] of the middle of the rear axle, which moves along x_B, (3,)."""
        return _past(position, heading, speed, turn_rate, rear=rear, age=age)

    def pose(position: Array, heading: float, speed: float, turn_rate: float, roll: float, pitch: float) -> list[float]:
        x, y, yaw = compose(axle(position, heading, speed, turn_rate), [rear, 0.0, 0.0]).tolist()
        height = standing_pose(carrier, ground, position=[x, y], heading=yaw).translation()[2]
        return [x, y, height, float(roll), float(pitch), yaw]

    def velocity(heading: float, speed: float, turn_rate: float, roll: float, pitch: float) -> Array:
        yaw = float(heading) - age * float(turn_rate)
        R_WB = RollPitchYaw(float(roll), float(pitch), yaw).ToRotationMatrix().matrix()
        # The estimated speed is measured at the middle of the rear axle, which does not move sideways.
        return np.concatenate([[0.0, 0.0, float(turn_rate)], R_WB @ [float(speed), float(turn_rate) * rear, 0.0]])

    def curvature(speed: float, turn_rate: float) -> float:
        return float(turn_rate) / float(speed) if abs(float(speed)) > _SLOW else 0.0

    tilt = ("dps.env.dead_reckoning.roll", "dps.env.dead_reckoning.pitch")
    base = "sim.sys.carrier.base"
    builder.believe(f"{base}.pose", of=[*_PLACE, *_MOTION, *tilt], by=pose, age=age)
    builder.believe(f"{base}.velocity", of=[_PLACE[1], *_MOTION, *tilt], by=velocity, age=age)
    builder.believe("sim.act.wheels.speed", of=_MOTION[:1], age=age)
    builder.believe("sim.act.wheels.curvature", of=_MOTION, by=curvature, age=age)
    _declare_driver(builder, routes, rear=rear, age=age)


def declare_belief_on_foot(
    builder: VirtualTestbedBuilder, worker: Worker, ground: Ground, routes: Sequence[Route], *, age: float
) -> None:
    """Declare how the estimates of the DPS set the state of the unit, of the worker who carries it, and of the way.

    As `declare_belief`; the unit has its height over the ground, and the worker is behind it by the heading of the
    unit. Nothing is believed of the phase of the gait: a mental copy begins its stride anew.

    Args:
        builder: The builder of the testbed.
        worker: The worker.
        ground: The elevation map of the DPS: the simulated ground's.
        routes: The routes by number.
        age: The age of the measured motion in s.
    """

    def pose(position: Array, heading: float, speed: float, turn_rate: float, roll: float, pitch: float) -> list[float]:
        x, y, yaw = _past(position, heading, speed, turn_rate, rear=0.0, age=age).tolist()
        height = ground.height(np.array([x]), np.array([y])).item() + worker.height
        return [x, y, height, float(roll), float(pitch), yaw]

    def velocity(heading: float, speed: float, turn_rate: float) -> Array:
        yaw = float(heading) - age * float(turn_rate)
        return np.array([0.0, 0.0, float(turn_rate), float(speed) * np.cos(yaw), float(speed) * np.sin(yaw), 0.0])

    def walker(position: Array, heading: float, speed: float, turn_rate: float) -> Array:
        return _past(position, heading, speed, turn_rate, rear=worker.forward, age=age)

    tilt = ("dps.env.dead_reckoning.roll", "dps.env.dead_reckoning.pitch")
    builder.believe("sim.sys.carrier.base.pose", of=[*_PLACE, *_MOTION, *tilt], by=pose, age=age)
    builder.believe("sim.sys.carrier.base.velocity", of=[_PLACE[1], *_MOTION], by=velocity, age=age)
    builder.believe("sim.act.legs.speed", of=_MOTION[:1], age=age)
    builder.believe(
        "sim.act.legs.position", of=[*_PLACE, *_MOTION], by=lambda *estimates: walker(*estimates)[:2], age=age
    )
    builder.believe(
        "sim.act.legs.heading", of=[*_PLACE, *_MOTION], by=lambda *estimates: float(walker(*estimates)[2]), age=age
    )
    _declare_driver(builder, routes, rear=worker.forward, age=age)


def _past(position: Array, heading: float, speed: float, turn_rate: float, *, rear: float, age: float) -> Array:
    """Return the pose [x, y, heading] of the point behind Bo by ``rear`` (m) some time (s) ago, (3,)."""
    if not np.isfinite(position).all():
        raise ValueError(
            "the carrier is not localized, so that there is no belief of where it is: ask when dps.env.pose.status "
            "says that it tracks"
        )
    X_WA = compose([*position, float(heading)], [-rear, 0.0, 0.0])
    return compose(X_WA, inverse(chord(age * float(speed), age * float(turn_rate))))


def _declare_driver(builder: VirtualTestbedBuilder, routes: Sequence[Route], *, rear: float, age: float) -> None:
    """Declare the belief about the driver: on the advised route, or else on the nearest one."""

    def route(position: Array, heading: float, speed: float, turn_rate: float, advised: float) -> float:
        place = _past(position, heading, speed, turn_rate, rear=rear, age=age)[:2]
        off = [route.distances(place).item() for route in routes]
        number = min(max(round(float(advised)), 0), len(routes) - 1)
        return float(number if off[number] < _OFF else np.argmin(off))

    def along(position: Array, heading: float, speed: float, turn_rate: float, advised: float) -> float:
        number = int(route(position, heading, speed, turn_rate, advised))
        return routes[number].nearest(_past(position, heading, speed, turn_rate, rear=rear, age=age)[:2])

    builder.believe("sim.act.driver.route", of=[*_PLACE, *_MOTION, _ADVICE], by=route, age=age)
    builder.believe("sim.act.driver.along", of=[*_PLACE, *_MOTION, _ADVICE], by=along, age=age)
