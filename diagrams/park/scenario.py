"""The testbed of a car that localizes itself in a park: its DPS, and a simulated park around it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ZeroOrderHold

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import setting
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.dead_reckoning import SteeringDriftModel
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.range_bearing import RangeBearingConfig, range_bearing_landmarks
from vtbdrake.components.localization.steering import SteeringConfig, SteeringReckoning
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.unit import LocalizationUnit
from vtbdrake.components.world_model import WorldModel, load_geojson
from vtbdrake.state import AddressedSystem
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.forest.perception import LandmarkSensor, Localizer, PresentPose, add_localizer
from vtbdrake_diagrams.park.world import SteeredCar, TreeDetector, random_trees, surveyed_trees, tree_model

PERIOD = 0.025
"""The period of the DPS and of the odometry, in s."""
ROWS = 32
"""The number of rows of the signal ``trees``."""
CLAIM = ("x", "y", "heading", "deviation", "status")
"""The entries of the actuator signal ``claim``."""

# The number of periods from scan to scan of the simulated scanner.
_SCAN_EVERY = 9
# The smallest number of landmarks with which a pose can be sure.
_FEWEST = 8
# The distance in m over which landmarks are gathered: a scan shows few, and the car does not slip.
_GATHERED = 100.0
# Standard deviation in m that is added to the detections', per axis: the axes of large or leaning trunks.
_LEAST_DEVIATION = 0.03
# Standard deviation of the displacement of a scan in m: its time is known to a period of the DPS, 7 ms at 3 m/s.
_SCAN_DEVIATION = 0.02
# The share of the variance of detections that lasts: the correlation of their errors from scan to scan, along the ray,
# beside it, in the first half of the drive in Victoria Park.
_LASTING_SHARE = 0.5
# The distance in m over which that correlation falls to a third.
_LASTING_LENGTH = 8.0
# The density in 1/m² of detections of something else beside a tree, for each detection of the tree: 0.0085 from 0.4 to
# 1 m beside it, in the first half of the drive in Victoria Park (`stray_density` in `park/few_landmarks.py`).
_STRAY_DENSITY = 0.01
# The share of the variance of the map that neighbours share: the variance of the map's place, not of the trees on it.
_SHARED = 0.9


def car() -> SteeringConfig:
    """Return the car of the Victoria Park recording, with its published geometry."""
    return SteeringConfig(wheel_base=2.83, wheel_offset=0.76)


def detector() -> RangeBearingConfig:
    """Return the scanner of the Victoria Park recording, at its published place ahead of the rear axle."""
    return RangeBearingConfig(x=3.78, y=0.5)


@dataclass
class ParkScenario(Scenario):
    """A car without gyros, with wheel speed, steering angle and a detector of trees, localizes itself on a map.

    The sensor signal ``odometry`` is [speed of the left rear wheel (m/s), steering angle (rad)], the signal ``trees``
    rows of [range (m), bearing (rad), diameter (m)], filled up with zeros. The actuator signal ``claim`` is what the
    car says of its pose: the entries of `CLAIM`, with the larger standard deviation of the position in m, and zeros
    but for the status where it has no pose.
    """

    seed: int = setting(0, "Determines trees, map and errors of the simulated park.", ge=0)
    trees: int = setting(400, "The number of trees of the simulated park.", ge=3)
    size: float = setting(160.0, "The edge of the simulated park.", unit="m", gt=0.0)
    speed: float = setting(3.0, "The speed of the simulated car.", unit="m/s", ge=0.0, le=10.0)
    misalignment: float = setting(0.005, "True less measured steering angle of the simulated car.", unit="rad")
    map_file: str = setting("", "A GeoJSON file to take the map from; empty for a survey of the simulated park.")
    map_deviation: float = setting(0.05, "Standard deviation of that survey.", unit="m", gt=0.0)
    correlation: float = setting(
        0.0, "Length over which errors of the map are shared; 0 if they are independent.", unit="m", ge=0.0
    )
    car: SteeringConfig = field(default_factory=car)
    detector: RangeBearingConfig = field(default_factory=detector)
    curvature_deviation: float = setting(
        0.004, "Standard deviation of the lasting error of the curvature.", unit="rad/m", ge=0.0
    )
    curvature_walk: float = setting(0.001, "Random walk of that error.", unit="rad/m^1.5", ge=0.0)
    steering_deviation: float = setting(
        0.1,
        "Standard deviation of the error of the steering's scale, which changes from curve to curve. The default fits "
        "a steering that nobody has calibrated: 0.09 in the first half of the drive in Victoria Park.",
        ge=0.0,
    )
    localizer_latency: float = setting(
        0.1, "Time from the arrival of a scan in the DPS to its pose.", unit="s", ge=PERIOD
    )

    def interface(self) -> Interface:
        farthest = np.tile([1e3, np.pi, 10.0], ROWS)
        return Interface(
            sense=[
                Signal("trees", size=3 * ROWS, unit="m, rad, m", lower=-farthest, upper=farthest, max_age=1.5),
                Signal("odometry", size=2, unit="m/s, rad", lower=[-10.0, -1.2], upper=[20.0, 1.2], max_age=0.5),
            ],
            act=[Signal("claim", size=len(CLAIM), unit="m, m, rad, m, 1", idle=np.zeros(len(CLAIM)))],
        )

    def world_map(self) -> WorldModel:
        """Return the map that the DPS has."""
        if self.map_file:
            return load_geojson(self.map_file)
        survey = surveyed_trees(self.true_trees(), self.seed, deviation=self.map_deviation)
        return tree_model(survey, source="survey")

    def true_trees(self) -> Landmarks:
        """Return the trees of the simulated park."""
        return random_trees(self.seed, count=self.trees, size=self.size)

    def unit(self, world_map: WorldModel) -> LocalizationUnit:
        """Return the localization unit for a map."""
        landmarks = map_landmarks(world_map)
        tracker = Tracker(
            landmarks,
            sensor=(self.detector.x, self.detector.y),
            field_of_view=np.pi,
            rate_deviation=self.curvature_deviation,
            rate_walk=self.curvature_walk,
            turn_deviation=self.steering_deviation,
            least_deviation=_LEAST_DEVIATION,
            scan_deviation=_SCAN_DEVIATION,
            lasting_share=_LASTING_SHARE,
            lasting_length=_LASTING_LENGTH,
            stray_density=_STRAY_DENSITY,
            correlation=self.correlation,
            correlated_share=_SHARED,
        )
        locator = ConstellationMap(
            landmarks, fewest=_FEWEST, least_deviation=_LEAST_DEVIATION, correlation=self.correlation
        )
        return LocalizationUnit(
            locator, tracker, drift=SteeringDriftModel(), submap_length=_GATHERED, begins_with_submap=True
        )

    def make_dps(self) -> Diagram:
        world_map = self.world_map()
        builder, env = DiagramBuilder(), DiagramBuilder()
        env.AddNamedSystem("map", ConstantValueSource(Value(world_map)))
        reckoning = env.AddNamedSystem("dead_reckoning", SteeringReckoning(period=PERIOD, config=self.car))
        sensor = LandmarkSensor(DetectedTrees(self.detector), ("trees",))
        localizer = Localizer((sensor,), self.unit(world_map))
        part = add_localizer(
            env,
            reckoning,
            localizer,
            {"trees": np.zeros(3 * ROWS)},
            period=PERIOD,
            latency=self.localizer_latency,
        )
        pose = env.AddNamedSystem("pose", PresentPose(period=PERIOD, drift=SteeringDriftModel(), axle=0.0))
        env.Connect(reckoning.GetOutputPort("motion"), pose.GetInputPort("motion"))
        for port in ("pose", "covariance", "status", "odometry", "time"):
            env.Connect(part.GetOutputPort(port), pose.GetInputPort(port))
        env.ExportInput(reckoning.GetInputPort("odometry"), "odometry")
        env.ExportOutput(pose.GetOutputPort("pose_estimate"), "pose_estimate")
        perceived = builder.AddNamedSystem("env", env.Build())
        claim = builder.AddNamedSystem("act", Claim())
        builder.Connect(perceived.GetOutputPort("pose_estimate"), claim.GetInputPort("pose_estimate"))
        for signal in ("trees", "odometry"):
            builder.ExportInput(perceived.GetInputPort(signal), signal)
        builder.ExportOutput(claim.GetOutputPort("claim"), "claim")
        dps = builder.Build()
        dps.set_name("dps")
        return dps

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        car = SteeredCar(period=PERIOD, speed=self.speed, config=self.car, misalignment=self.misalignment)
        builder.add("sys", "car", car)
        scanner = TreeDetector(
            self.true_trees(), period=PERIOD, every=_SCAN_EVERY, rows=ROWS, config=self.detector, seed=self.seed
        )
        builder.add("sense", "trees", scanner)
        builder.connect(car.GetOutputPort("pose"), scanner.GetInputPort("pose"))
        builder.sim_sensor("trees", scanner.GetOutputPort("trees"))
        odometer = builder.add("sense", "odometry", ZeroOrderHold(PERIOD, 2))
        builder.connect(car.GetOutputPort("odometry"), odometer.get_input_port())
        builder.sim_sensor("odometry", odometer.get_output_port())
        display = builder.add("act", "display", ZeroOrderHold(PERIOD, len(CLAIM)))
        builder.sim_actuator("claim", display.get_input_port())


@dataclass(frozen=True, eq=False)
class DetectedTrees:
    """Landmarks from the detections of another detector, for a `Localizer`.

    Attributes:
        config: Where the sensor is, and how accurate.
    """

    config: RangeBearingConfig

    def __call__(self, trees: Array, history: Array, time: float) -> Landmarks:
        """Return the landmarks in H; the car is level, and a scan is of one time."""
        return range_bearing_landmarks(trees, self.config)


class Claim(AddressedSystem):
    """What the car says of its pose, in finite numbers.

    .. pydrake_system::

        name: Claim
        input_ports:
        - pose_estimate
        output_ports:
        - claim

    ``pose_estimate`` comes from a `PresentPose`; ``claim`` has the entries of `CLAIM`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._estimate = self.DeclareVectorInputPort("pose_estimate", 14)
        self.DeclareVectorOutputPort("claim", len(CLAIM), self._calc, {self._estimate.ticket()})

    def _calc(self, context: Context, output: BasicVector) -> None:
        estimate = self._estimate.Eval(context)
        covariance, status = estimate[4:13].reshape(3, 3), estimate[13]
        if not np.isfinite(estimate).all():
            output.SetFromVector([0.0, 0.0, 0.0, 0.0, status])
            return
        deviation = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        output.SetFromVector([*estimate[1:4].tolist(), deviation, status])
