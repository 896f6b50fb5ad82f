"""A ride among trees whose sensors need no plant: every scan has one return from the axis of each tree around."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, State
from pydrake.systems.primitives import ZeroOrderHold

from vtbdrake.common.scan import Scan
from vtbdrake.components.localization.dead_reckoning import deskewed
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import inverse, transform
from vtbdrake.components.localization.unit import LocalizationUnit
from vtbdrake.components.world_model import WorldModel
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import VirtualTestbedBuilder
from vtbdrake_diagrams.forest.dps import AXLE, PERIOD
from vtbdrake_diagrams.forest.scenario import ForestScenario

SCAN_PERIOD = 0.2
X_BL = RigidTransform([0.5, 0.1, 2.0])
NOISE = 0.03
RANGE = 13.0

_FINE = 20  # Steps of the motion per period.


@cache
def motion() -> np.ndarray:
    """The pose [x, y, heading] of the carrier in steps of PERIOD / _FINE, its velocity along x_B, y_B, and turn rate.

    The middle of its rear axle moves along x_B.
    """
    times = np.arange(0.0, 60.0, PERIOD / _FINE)
    moving = np.maximum(times - 0.6, 0.0)
    speed = 1.2 * np.clip(moving, 0.0, 1.0)
    heading, rate = 0.8 + 0.5 * (1.0 - np.cos(0.4 * moving)), 0.2 * np.sin(0.4 * moving)
    step = PERIOD / _FINE
    x, y = (np.concatenate([[0.0], np.cumsum(f(heading[:-1]) * speed[:-1] * step)]) for f in (np.cos, np.sin))
    return np.column_stack([
        40.0 + x - AXLE * np.cos(heading), 35.0 + y - AXLE * np.sin(heading), heading, speed, -AXLE * rate, rate,
    ])  # fmt: skip


def pose(time: float) -> np.ndarray:
    """The true pose X_WH."""
    return motion()[round(time / PERIOD * _FINE), :3]


class Ride(AddressedSystem):
    """Sensors on a carrier that moves as `motion` says.

    .. pydrake_system::

        name: Ride
        input_ports: []
        output_ports:
        - imu
        - odometry
        - scan
    """

    def __init__(self, scenario: RidingScenario) -> None:
        super().__init__()
        self._scenario, self._trees = scenario, map_landmarks(scenario.truth()).positions
        self._imu = self.declare_discrete_state(imu=Quantity([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]))
        self._odometry = self.declare_discrete_state(odometry=Quantity())
        scan = self.DeclareAbstractState(Value(Scan.empty()))
        for name, index in {"imu": self._imu.index, "odometry": self._odometry.index, "scan": scan}.items():
            self.DeclareStateOutputPort(name, index)
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._sample)

    def _sample(self, context: Context, state: State) -> None:
        tick = round(context.get_time() / PERIOD)
        now, before = (motion()[max(k, 0) * _FINE] for k in (tick, tick - 1))
        rate = (now[2] - before[2]) / PERIOD
        change, (ahead, aside) = (now[3:5] - before[3:5]) / PERIOD, (now[3:5] + before[3:5]) / 2.0
        numbers = state.get_mutable_discrete_state()
        sample = [0.0, 0.0, rate, change[0] - rate * aside, change[1] + rate * ahead, 9.81, now[3]]
        if self._scenario.broken >= 0 and 100 <= tick < 105:
            sample[self._scenario.broken] = np.nan
        self._imu.mutable(numbers).imu = sample[:6]
        self._odometry.mutable(numbers).odometry = sample[6]
        if tick and tick % round(SCAN_PERIOD / PERIOD) == 0 and tick * PERIOD < self._scenario.dead_from:
            state.get_mutable_abstract_state(0).set_value(self._scan(tick))

    def _scan(self, tick: int) -> Scan:
        time, rng = tick * PERIOD, np.random.default_rng([7, tick])
        if self._scenario.blind_from <= time < self._scenario.blind_until:
            return Scan.empty(stamp=time)
        places = transform(inverse(pose(time)), self._trees)
        places = places[np.linalg.norm(places, axis=1) < RANGE]
        # The scanner turns once: each tree is seen at its own time, from where the carrier was then.
        times = SCAN_PERIOD * (np.arctan2(places[:, 1], places[:, 0]) / (2.0 * np.pi) - 0.5)
        trees = transform(pose(time), places)
        seen = np.array(
            [transform(inverse(pose(time + t)), tree[None])[0] for t, tree in zip(times, trees, strict=True)]
        )
        points = np.column_stack([seen, np.full(len(seen), 1.3)]) - X_BL.translation()
        points[:, :2] += NOISE * rng.normal(size=(len(points), 2))
        ranges = np.linalg.norm(points, axis=1)
        return Scan(points / ranges[:, None], ranges, times, time + (self._scenario.clock if tick >= 100 else 0.0))


@dataclass(frozen=True)
class SpotLandmarks:
    """Every return of a scan is a landmark of unknown diameter."""

    def __call__(self, scan: Scan, history: np.ndarray, time: float) -> Landmarks:
        places = deskewed(scan, history, X_BL, time=time)[:, :2]
        n = len(places)
        return Landmarks(places, np.tile(NOISE**2 * np.eye(2), (n, 1, 1)), np.full(n, 0.2), np.full(n, np.inf))


@dataclass
class RidingScenario(ForestScenario):
    """The localization unit on a ride.

    Its scans are empty from ``blind_from`` to ``blind_until`` (s). From 2 s on, five samples of the entry ``broken`` of
    IMU and odometry (0 to 6) are NaN, and the scanner's clock is ahead by ``clock`` (s). From ``dead_from`` (s) on, the
    scanner sends nothing. With another ``stand_seed``,
    the carrier is in another stand than the one on the map.
    """

    simulator_config: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(max_step_size=0.1))
    seed: int = 3
    density: float = 600.0
    blind_from: float = 0.0
    blind_until: float = 0.0
    broken: int = -1
    clock: float = 0.0
    dead_from: float = 1e3
    stand_seed: int = 3

    def truth(self) -> WorldModel:
        return replace(self.stand(), seed=self.stand_seed).trees()

    @property
    def X_BL(self) -> RigidTransform:
        return X_BL

    def detector(self) -> SpotLandmarks:
        return SpotLandmarks()

    def unit(self, world_map: WorldModel) -> LocalizationUnit:
        return replace(super().unit(world_map), submap_length=5.0, try_every=(0.5, 0.5))

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        ride = Ride(self)
        builder.add("sense", "ride", ride)
        for signal in ("imu", "odometry", "scan"):
            builder.sim_sensor(signal, ride.GetOutputPort(signal))
        driver = builder.add("act", "driver", ZeroOrderHold(PERIOD, 1))
        builder.sim_actuator("route", driver.get_input_port())
