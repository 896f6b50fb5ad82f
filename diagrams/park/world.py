"""The simulated park: a car on a bent circle among random trees, and the detector of trees on it."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, inf, pi, tan

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import chord, compose, inverse, transform
from vtbdrake.components.localization.range_bearing import RangeBearingConfig
from vtbdrake.components.localization.steering import SteeringConfig, bicycle_motion
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.sensors.noise import noise_generator, random_stream
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject
from vtbdrake.state import AddressedSystem, Quantity

# Mean steering angle, in rad.
_ANGLE = 0.08
# Amplitude with which it swings, in rad.
_SWING = 0.05
# Period of the swing, in s.
_SWINGS_EVERY = 29.0
# Which share of the trees in view a scan shows.
_DETECTED = 0.7


def random_trees(seed: int, *, count: int, size: float) -> Landmarks:
    """Return trees at random places of a square about the origin, exactly."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.5 * size, 0.5 * size, (count, 2))
    return Landmarks(places, np.zeros((count, 2, 2)), rng.uniform(0.2, 0.8, count), np.zeros(count))


def surveyed_trees(trees: Landmarks, seed: int, *, deviation: float) -> Landmarks:
    """Return a map of trees with independent errors of this standard deviation in m, also of the diameters."""
    rng, n = np.random.default_rng([seed, 1]), len(trees)
    return Landmarks(
        trees.positions + deviation * rng.normal(size=(n, 2)),
        np.tile(deviation**2 * np.eye(2), (n, 1, 1)),
        np.maximum(trees.diameters + deviation * rng.normal(size=n), 0.05),
        np.full(n, deviation),
    )


def tree_model(trees: Landmarks, *, source: str) -> WorldModel:
    """Return a world model of trees, for a GeoJSON file or for the DPS."""
    objects = []
    for k, (place, C, diameter, deviation) in enumerate(
        zip(trees.positions, trees.covariances, trees.diameters, trees.diameter_deviations, strict=True)
    ):
        covariance = np.diag([inf, inf, inf, 0.0, 0.0, 0.0])
        covariance[3:5, 3:5] = C
        pose = PoseEstimate.of(RigidTransform([*place.tolist(), 0.0]), covariance, time=0.0)
        attributes = {"trunk_diameter": AttributeValue(float(diameter), "m", float(deviation))}
        objects.append(WorldObject(f"tree-{k}", "tree", pose, attributes=attributes, source=source))
    return WorldModel(objects)


class SteeredCar(AddressedSystem):
    """A car that drives with constant speed on a bent circle, without slip.

    .. pydrake_system::

        name: SteeredCar
        output_ports:
        - pose
        - odometry

    ``pose`` is X_WB (3,) of the middle of the rear axle; ``odometry`` is what is measured: [speed of the wheel (m/s),
    steering angle (rad)], the angle without the parameter ``misalignment``, which nobody knows.
    """

    def __init__(self, *, period: float, speed: float, config: SteeringConfig, misalignment: float) -> None:
        """Declare the system.

        Args:
            period: The period of the updates in s.
            speed: The speed of the middle of the rear axle in m/s.
            config: The geometry of the car.
            misalignment: True less measured steering angle in rad.
        """
        super().__init__()
        self._period, self._config = period, config
        radius = config.wheel_base / tan(_ANGLE)
        self._pose = self.declare_discrete_state(
            position=Quantity([0.0, -radius], "m"), heading=Quantity(0.0, "rad"), steering=Quantity(_ANGLE, "rad")
        )
        self._settings = self.declare_parameters(
            speed=Quantity(speed, "m/s", (0.0, 20.0)), misalignment=Quantity(misalignment, "rad", (-0.2, 0.2))
        )
        self.DeclareVectorOutputPort("pose", 3, self._show_pose, {self.all_state_ticket()})
        self.DeclareVectorOutputPort(
            "odometry", 2, self._measure, {self.all_state_ticket(), self.all_parameters_ticket()}
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _show_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._pose.array(context)[:3])

    def _measure(self, context: Context, output: BasicVector) -> None:
        settings, angle = self._settings.view(context), self._pose.view(context).steering
        curvature = tan(angle) / self._config.wheel_base
        wheel = settings.speed * (1.0 - self._config.wheel_offset * curvature)
        output.SetFromVector([wheel, angle - settings.misalignment])

    def _update(self, context: Context, state: DiscreteValues) -> None:
        pose, settings, T = self._pose.mutable(state), self._settings.view(context), self._period
        v, rate = bicycle_motion(settings.speed, pose.steering, wheel_base=self._config.wheel_base)
        *position, _ = compose([*pose.position.tolist(), pose.heading], chord(T * v, T * rate)).tolist()
        pose.position, pose.heading = position, pose.heading + T * rate
        pose.steering = _ANGLE + _SWING * cos(2.0 * pi * (context.get_time() + T) / _SWINGS_EVERY)


class TreeDetector(AddressedSystem):
    """A scanner with a detector of trees, which looks ahead over 180 deg.

    .. pydrake_system::

        name: TreeDetector
        input_ports:
        - pose
        output_ports:
        - trees

    ``pose`` is X_WB (3,). ``trees`` holds the nearest detected trees, as rows of [range (m), bearing (rad), diameter
    (m)], and is filled up with zeros. Seven of ten trees in view are detected, with the errors of the
    `RangeBearingConfig`; the parameter ``noise`` is a factor of all of them.
    """

    def __init__(
        self, trees: Landmarks, *, period: float, every: int, rows: int, config: RangeBearingConfig, seed: int
    ) -> None:
        """Declare the system.

        Args:
            trees: The true trees.
            period: The period of the car in s.
            every: The number of periods from scan to scan. (An event with a period of its own may come the last bit of
                a number after one of the car, and see its next pose.)
            rows: The number of rows of the signal.
            config: Where the sensor is on the car, and its errors.
            seed: Determines the errors.
        """
        super().__init__()
        self._trees, self._period, self._every, self._config, self._seed = trees, period, every, config, seed
        self._stream: Callable[[], int] = random_stream(self, None)
        self._pose = self.DeclareVectorInputPort("pose", 3)
        self._settings = self.declare_parameters(noise=Quantity(1.0, bounds=(0.0, inf)))
        reading = self.declare_discrete_state(trees=Quantity(np.zeros(3 * rows), "m, rad, m"))
        self._rows = rows
        self.DeclareStateOutputPort("trees", reading.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        tick, rest = divmod(round(context.get_time() / self._period), self._every)
        if rest:
            return
        config, trees = self._config, self._trees
        noise = float(self._settings.view(context).noise)
        X_WS = compose(self._pose.Eval(context), [config.x, config.y, config.heading])
        x, y = transform(inverse(X_WS), trees.positions).T
        r, bearing = np.hypot(x, y), np.arctan2(y, x)
        rng = noise_generator(seed=self._seed, stream=self._stream(), tick=tick, channel=0)
        is_detected = rng.random(len(trees)) < _DETECTED
        errors = noise * rng.normal(size=(3, len(trees)))
        rows = np.column_stack(
            [
                r + np.hypot(config.range_noise, config.range_share * r) * errors[0],
                bearing + np.hypot(0.5 * config.range_noise / r, config.bearing_noise) * errors[1],
                np.maximum(
                    trees.diameters
                    + np.hypot(config.diameter_noise, config.diameter_share * trees.diameters) * errors[2],
                    0.01,
                ),
            ]
        )
        visible = np.flatnonzero(is_detected & (r > 1.0) & (r < config.largest_range) & (abs(bearing) < pi / 2.0))
        nearest = rows[visible[np.argsort(r[visible])][: self._rows]]
        reading: Array = np.zeros(3 * self._rows)
        reading[: nearest.size] = nearest.ravel()
        state.set_value(reading)
