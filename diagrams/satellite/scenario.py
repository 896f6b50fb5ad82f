"""The satellite testbed: a servicer with an arm captures a tumbling target."""

from __future__ import annotations

from dataclasses import dataclass, field
from operator import itemgetter

import numpy as np
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram
from pydrake.systems.primitives import MatrixGain

from vtbdrake.components.sensors import ErrorModel, Imu, JointEncoders
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.satellite.bodies import JOINT_NAMES, WHEEL_JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.dps import PERIOD, POSE_PERIOD, make_dps
from vtbdrake_diagrams.satellite.plant import plant_config
from vtbdrake_diagrams.satellite.supervisor import GO, STOP

_LARGEST_TUMBLE_DEG = 30.0


@dataclass
class SatelliteScenario(Scenario):
    """A servicer captures a target that tumbles; ``u.capture`` (1: go, 0: wait, -1: abort) starts and ends it.

    The start is drawn at random from ``seed``, see `random_start`.
    """

    # Discrete, with the SAP solver: halving its step changes nothing that counts.
    plant_config: MultibodyPlantConfig = field(default_factory=plant_config)
    # Of the start: axis, attitude, place and drift of the target.
    seed: int = 0
    # The target's angular velocity, in deg/s.
    tumble_deg: float = 1.5
    # The distance of the target's centre from the servicer's when the target faces it, in m.
    distance: float = 2.5
    # How the target is perceived: pose_sensor.
    perception: str = "pose_sensor"
    # Whether the servicer holds its attitude by reaction wheels.
    wheels: bool = False
    # Errors of the sensors, latency in periods; the IMU's noise is in rad/s (gyros) and in m/s^2 (accelerometers).
    imu_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=1e-4))
    joint_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=1e-4))
    pose_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=0.005, latency=1))

    def validate(self) -> None:
        super().validate()
        checks = {
            "seed": (self.seed >= 0, "not negative"),
            "tumble_deg": (0.0 <= self.tumble_deg <= _LARGEST_TUMBLE_DEG, f"within [0, {_LARGEST_TUMBLE_DEG:g}] deg/s"),
            "distance": (self.distance >= 1.8, "at least 1.8 m: nearer, the satellites would touch"),
            "perception": (self.perception in ("pose_sensor",), "one of pose_sensor"),
            "plant_config": (self.plant_config.time_step > 0.0, "of a discrete plant: servos and gripper need it"),
        }
        for name, (good, expected) in checks.items():
            if not good:
                raise ScenarioError(f"SatelliteScenario.{name} must be {expected}, not {getattr(self, name)!r}")
        for name in ("imu_errors", "joint_errors", "pose_errors"):
            try:
                getattr(self, name).check(f"SatelliteScenario.{name}")
            except ValueError as error:
                raise ScenarioError(str(error)) from None

    def interface(self) -> Interface:
        s = Servicer()
        age = 5 * PERIOD
        fingers = np.full(2, s.opening)
        lower, upper = np.concatenate((s.lower, 0.0 * fingers)), np.concatenate((s.upper, fingers))
        rate = np.concatenate((s.speeds, np.full(2, s.finger_speed)))
        act = [
            Signal("joint_position", size=9, unit="rad, m", lower=lower, upper=upper, rate=rate, idle=s.home),
        ]
        if self.wheels:
            limit = s.wheel_torque
            act.append(Signal("wheel_torque", size=3, unit="N m", lower=-limit, upper=limit, idle=0.0))
        return Interface(
            sense=[
                Signal(
                    "joint_position",
                    size=9,
                    unit="rad, m",
                    lower=lower - np.repeat([0.1, 0.01], [7, 2]),
                    upper=upper + np.repeat([0.1, 0.01], [7, 2]),
                    rate=4.0 * rate,
                    max_age=age,
                ),
                Signal("imu", size=6, unit="rad/s, m/s^2", lower=-10.0, upper=10.0, max_age=age),
                Signal("target_pose", size=7, unit="1, m", lower=-100.0, upper=100.0, max_age=5 * POSE_PERIOD),
            ],
            act=act,
            commands=[Signal("capture", size=1, lower=STOP, upper=GO, default=GO)],
        )

    def make_dps(self) -> Diagram:
        return make_dps(wheels=self.wheels, pose_latency=self.pose_errors.latency * POSE_PERIOD)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        # Imported here: the DPS on the satellite runs without a plant.
        from vtbdrake_diagrams.satellite.plant import add_servicer, add_target
        from vtbdrake_diagrams.satellite.pose_sensor import PoseSensor
        from vtbdrake_diagrams.satellite.start import Release, random_start

        start = random_start(self.seed, tumble=np.radians(self.tumble_deg), distance=self.distance)
        plant, _ = builder.add_plant(self.plant_config)
        servicer = add_servicer(plant, wheels=self.wheels)
        target = add_target(plant, start.X_WT)
        plant.Finalize()
        base, body = plant.GetBodyByName("base", servicer), plant.GetBodyByName("body", target)

        joints = [plant.GetJointByName(name, servicer) for name in JOINT_NAMES]
        builder.add_sensor("joint_position", JointEncoders(plant, joints, period=PERIOD, errors=self.joint_errors))
        imu = Imu(plant, plant.GetFrameByName("imu", servicer), period=PERIOD, errors=self.imu_errors)
        builder.add_sensor("imu", imu)
        pose_sensor = PoseSensor(plant, base, body, period=POSE_PERIOD, stream=2, errors=self.pose_errors)
        builder.add_sensor("target_pose", pose_sensor)

        # The servos are the plant's own PD controllers; they are to reach the position and to rest there.
        rest = np.vstack([np.eye(len(JOINT_NAMES)), np.zeros((len(JOINT_NAMES), len(JOINT_NAMES)))])
        servos = builder.add("act", "servos", MatrixGain(rest))
        builder.connect(servos.get_output_port(), plant.get_desired_state_input_port(servicer))
        builder.sim_actuator("joint_position", servos.get_input_port())
        if self.wheels:
            # What turns the base one way turns the wheels the other way.
            wheels = builder.add("act", "wheels", MatrixGain(-np.eye(len(WHEEL_JOINT_NAMES))))
            instance = plant.GetModelInstanceByName("wheels")
            builder.connect(wheels.get_output_port(), plant.get_actuation_input_port(instance))
            builder.sim_actuator("wheel_torque", wheels.get_input_port())

        release = builder.add("env", "release", Release(plant, target, start))
        builder.connect(plant.get_state_output_port(), release.get_input_port())
        builder.connect(release.get_output_port(), plant.get_applied_spatial_force_input_port())

    @staticmethod
    def _declare_belief(builder: VirtualTestbedBuilder) -> None:
        """Declare what the servicer believes: base and target move as it estimates, in its own inertial frame."""
        for k, name in enumerate(JOINT_NAMES):
            builder.believe(
                f"sim.sys.servicer.{name}.position", of=["sense.joint_position"], by=itemgetter(k), age=PERIOD
            )
