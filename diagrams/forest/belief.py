"""What the localization unit believes of the simulated world: where its carrier is and moves, and on which route."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RollPitchYaw

from vtbdrake.testbed import VirtualTestbedBuilder
from vtbdrake_diagrams.forest.carrier import Carrier, standing_pose
from vtbdrake_diagrams.forest.ground import Ground
from vtbdrake_diagrams.forest.routes import Route

Array = NDArray[np.float64]

_PLACE = ("dps.env.pose.position", "dps.env.pose.heading")
_MOTION = ("dps.env.dead_reckoning.speed", "dps.env.dead_reckoning.turn_rate")
# The route that the DPS advises.
_ADVICE = "dps.impl.route.discrete_state_0[0]"

# A carrier that is farther from the advised route than this is on another one, in m.
_OFF = 1.5
# Below this speed in m/s, the turning tells nothing of the steering.
_SLOW = 0.05


def declare_belief(
    builder: VirtualTestbedBuilder, carrier: Carrier, ground: Ground, routes: Sequence[Route], *, age: float
) -> None:
    """Declare how the estimates of the DPS set the state of the carrier and of its driver.

    The carrier is where the DPS has localized it, at the height at which it stands there, tilted as it measures it; it
    rolls without slip. The driver is on the advised route, or else on the nearest one.

    Args:
        builder: Of the testbed.
        carrier: The carrier.
        ground: The elevation map of the DPS: that of the simulated ground.
        routes: The routes by number.
        age: Of the estimates, in s.

    A carrier that is not localized has no belief: whoever asks for it gets a ValueError.
    """
    rear = carrier.wheel_base / 2.0

    def pose(position: Array, heading: float, roll: float, pitch: float) -> list[float]:
        _check(position)
        height = standing_pose(carrier, ground, position=position, heading=float(heading)).translation()[2]
        return [*position, height, float(roll), float(pitch), float(heading)]

    def velocity(heading: float, roll: float, pitch: float, speed: float, turn_rate: float) -> Array:
        R_WB = RollPitchYaw(float(roll), float(pitch), float(heading)).ToRotationMatrix().matrix()
        # The estimated speed is that of the middle of the rear axle, which does not move sideways.
        return np.concatenate([[0.0, 0.0, float(turn_rate)], R_WB @ [float(speed), float(turn_rate) * rear, 0.0]])

    def curvature(speed: float, turn_rate: float) -> float:
        return float(turn_rate) / float(speed) if abs(float(speed)) > _SLOW else 0.0

    def axle(position: Array, heading: float) -> Array:
        """Return the middle of the rear axle, which the driver leads along the route."""
        return np.asarray(position) - rear * np.array([np.cos(heading), np.sin(heading)]).ravel()

    def route(position: Array, heading: float, advised: float) -> float:
        _check(position)
        place = axle(position, heading)
        off = [route.distances(place).item() for route in routes]
        number = min(max(round(float(advised)), 0), len(routes) - 1)
        return float(number if off[number] < _OFF else np.argmin(off))

    def along(position: Array, heading: float, advised: float) -> float:
        return routes[int(route(position, heading, advised))].nearest(axle(position, heading))

    tilt = ("dps.env.dead_reckoning.roll", "dps.env.dead_reckoning.pitch")
    base = "sim.sys.carrier.base"
    builder.believe(f"{base}.pose", of=[*_PLACE, *tilt], by=pose, age=age)
    builder.believe(f"{base}.velocity", of=[_PLACE[1], *tilt, *_MOTION], by=velocity, age=age)
    builder.believe("sim.act.wheels.speed", of=_MOTION[:1], age=age)
    builder.believe("sim.act.wheels.curvature", of=_MOTION, by=curvature, age=age)
    builder.believe("sim.act.driver.route", of=[*_PLACE, _ADVICE], by=route, age=age)
    builder.believe("sim.act.driver.along", of=[*_PLACE, _ADVICE], by=along, age=age)


def _check(position: Array) -> None:
    if not np.isfinite(position).all():
        raise ValueError(
            "the carrier is not localized, so that there is no belief of where it is: ask when dps.env.pose.status "
            "says that it tracks"
        )
