"""The satellite testbed: a servicer with an arm captures a tumbling target."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Self

import numpy as np
from drake import lcmt_scope
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, MatrixGain

from vtbdrake.common.scan import Scan
from vtbdrake.common.settings import setting
from vtbdrake.components.environment.light import LightConfig
from vtbdrake.components.perception.target_tracker import pose_of_state
from vtbdrake.components.sensors import ErrorModel, Imu, JointEncoders
from vtbdrake.components.sensors.laser_scanner import LaserScannerConfig
from vtbdrake.control.fallback import Hold
from vtbdrake.control.robot_mode import RobotMode
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import LcmMap, vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.lcm.sensor_messages import image_map, scan_map
from vtbdrake.state.systems import pose_from_array, pose_later, pose_to_array
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, WHEEL_JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.dps import PERIOD, POSE_PERIOD, ApproachConfig, TargetSensors, make_dps
from vtbdrake_diagrams.satellite.perception import PerceptionConfig, target_board
from vtbdrake_diagrams.satellite.plant import plant_config
from vtbdrake_diagrams.satellite.supervisor import GO, STAY, STOP

if TYPE_CHECKING:
    from pydrake.systems.sensors import CameraInfo

PERCEPTIONS = ("camera+scanner", "camera", "scanner", "pose_sensor")
APPROACHES = ("resolved_rate", "planned")
ONLOOKERS = ("", *PERCEPTIONS[:3])


def _scanner() -> LaserScannerConfig:
    return LaserScannerConfig(frequency=2.0, rays_per_second=4000.0, azimuth=1.0, elevation=0.8, max_range=30.0)


def _light() -> LightConfig:
    """Return the sun from behind the servicer, 45 deg off the normal of the front face, and the Earth below."""
    return LightConfig(direction=[0.7, 0.5, -0.5], earth_shine=0.1)


@dataclass
class SatelliteScenario(Scenario):
    """A servicer captures a target that tumbles; ``u.capture`` (1: go, 0: wait, -1: abort) starts and ends it.

    The start is drawn at random from ``seed``, see `random_start`.
    """

    # Discrete, with the SAP solver: halving its step changes nothing that counts.
    plant_config: MultibodyPlantConfig = field(default_factory=plant_config)
    seed: int = setting(0, "Determines the start: axis, attitude, place and drift of the target.", ge=0)
    tumble_deg: float = setting(1.5, "The target's angular velocity.", unit="deg/s", ge=0.0, le=30.0)
    distance: float = setting(
        2.5,
        "The distance of the target's centre from the servicer's when the target faces it.",
        unit="m",
        ge=1.8,
        remedy="nearer, the satellites would touch",
    )
    perception: str = setting(
        "camera+scanner",
        "What the tracker of the DPS follows; pose_sensor stands for camera and scanner.",
        choices=PERCEPTIONS,
    )
    onlookers: str = setting(
        "", "Sensors that are aboard beside those that guide, and whose data are evaluated.", choices=ONLOOKERS
    )
    blind: bool = setting(
        False, "Whether camera and scanner show nothing, and cost nothing: a black image, and a scan without points."
    )
    image_width: int = setting(320, "Width of the images of the docking camera.", unit="pixels", gt=0)
    image_height: int = setting(240, "Height of these images.", unit="pixels", gt=0)
    fov_y: float = setting(0.9, "Field of view of the camera from top to bottom.", unit="rad", gt=0.0, lt=np.pi)
    camera_fps: float = setting(5.0, "Images per second.", unit="Hz", gt=0.0, le=0.5 / PERIOD)
    # Where the camera sits on the base, for the world and for the DPS: [x, y, z, roll, pitch, yaw] of C in B, in m and
    # rad; empty: the nominal place.
    camera_pose: list[float] = field(default_factory=list)
    # Errors of the images, in counts.
    camera_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=1.0))
    # The laser scanner, and the errors of its ranges in m.
    scanner: LaserScannerConfig = field(default_factory=_scanner)
    scanner_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=0.01))
    # Sun and earth-shine.
    light: LightConfig = field(default_factory=_light)
    lamp: float = setting(0.0, "Brightness of the lamp on the camera, see `Camera`.", ge=0.0)
    # How images and scans are evaluated.
    evaluation: PerceptionConfig = field(default_factory=PerceptionConfig)
    wheels: bool = setting(False, "Whether the servicer holds its attitude by reaction wheels.")
    approach: str = setting(
        "resolved_rate", "How the arm comes before the bar: by resolved rate, or along a plan.", choices=APPROACHES
    )
    approach_time: float = setting(15.0, "The duration of a planned approach.", unit="s", ge=5.0, le=40.0)
    planning_time: float = setting(
        4.0, "How long the arm waits for its plan, which then has to be there.", unit="s", ge=PERIOD, le=30.0
    )
    # Errors of the sensors, latency in periods; the IMU's noise is in rad/s (gyros) and in m/s^2 (accelerometers).
    imu_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=1e-4))
    joint_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=1e-4))
    pose_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=0.005, latency=1))

    def validate(self) -> None:
        super().validate()
        if not self.plant_config.time_step > 0.0:
            raise ScenarioError(
                "SatelliteScenario.plant_config.time_step must be a number above 0 s, not "
                f"{self.plant_config.time_step!r}: servos and gripper need a discrete plant"
            )
        try:
            self.light.check("SatelliteScenario.light")
        except ValueError as error:
            raise ScenarioError(str(error)) from None

        if len(self.camera_pose) not in (0, 6) or not np.isfinite(self.camera_pose).all():
            raise ScenarioError(
                "SatelliteScenario.camera_pose must be [x, y, z, roll, pitch, yaw] in m and rad, or empty for the "
                f"nominal pose, not {self.camera_pose!r}"
            )

    @property
    def X_BC(self) -> RigidTransform:
        """Pose of the docking camera on the base."""
        return pose_from_array(np.array(self.camera_pose)) if self.camera_pose else Servicer().X_BC

    @property
    def aboard(self) -> tuple[str, ...]:
        """Those of camera and scanner whose data the DPS evaluates."""
        return tuple(sensor for sensor in ("camera", "scanner") if sensor in f"{self.perception}+{self.onlookers}")

    @property
    def camera_info(self) -> CameraInfo:
        """Size and intrinsics of the docking camera."""
        from pydrake.systems.sensors import CameraInfo

        return CameraInfo(self.image_width, self.image_height, self.fov_y)

    def mental(self) -> Self:
        """Return what the servicer simulates when it reasons: a pose sensor in place of what it sees with.

        The DPS of the copy has the same parts, so that it continues from the state of the running one.
        """
        return replace(self, perception="pose_sensor", onlookers="+".join(self.aboard), blind=True)

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
                Signal("target_pose", size=7, unit="1, 1, 1, 1, m, m, m", lower=-100.0, upper=100.0),
                *self._abstract_signals(),
            ],
            act=act,
            commands=[Signal("capture", size=1, values=(STOP, STAY, GO), default=GO)],
        )

    def _abstract_signals(self) -> list[Signal]:
        signals = []
        if "camera" in self.aboard:
            from pydrake.systems.sensors import ImageRgba8U

            image = ImageRgba8U(self.image_width, self.image_height)
            signals.append(Signal("image", model_value=image, max_age=5.0 / self.camera_fps))
        if "scanner" in self.aboard:
            signals.append(Signal("scan", model_value=Scan.empty(), max_age=5.0 / self.scanner.frequency))
        return signals

    def make_dps(self) -> Diagram:
        sensing = TargetSensors(
            guides=tuple(self.perception.split("+")),
            aboard=self.aboard,
            config=self.evaluation,
            image=self.camera_info if "camera" in self.aboard else None,
            X_BC=self.X_BC,
            image_latency=self.camera_errors.latency / self.camera_fps,
            pose_latency=self.pose_errors.latency * POSE_PERIOD,
        )
        planned = self.approach == "planned"
        approach = ApproachConfig(duration=self.approach_time, latency=self.planning_time) if planned else None
        return make_dps(sensing, wheels=self.wheels, approach=approach)

    def deployment(self) -> Deployment:
        """Return how the DPS runs on its satellite: joints hold after a fault, and CAPTURE carries the command.

        Signals of numbers travel as ``lcmt_scope``; images and scans leave before them in the satellite's cycle. Before
        those, it tells which commands act, on channels that end in ``_ACTING``, and on SATELLITE_MODE whether it takes
        commands (see `RobotMode`): its own stop blocks them.
        """
        sense = [_lcm_map(signal, signal.name) for signal in reversed(self.interface().sense)]
        periods = {"TARGET_POSE": POSE_PERIOD}
        if "camera" in self.aboard:
            periods["IMAGE"] = 1.0 / self.camera_fps
        if "scanner" in self.aboard:
            periods["SCAN"] = 1.0 / self.scanner.frequency
        act = [_lcm_map(signal, f"{signal.name}_command") for signal in self.interface().act]
        reported = {signal.name: f"{signal.name}_acting" for signal in self.interface().act}
        reports = ["satellite_mode", *reported.values()]
        sense = [*(vector_map(name.upper(), lcmt_scope, {name: "value"}) for name in reports), *sense]
        commands = [_lcm_map(signal, signal.name) for signal in self.interface().commands]
        return Deployment(
            protocol=Protocol(
                sense=sense,
                act=act,
                commands=commands,
                reported=reported,
                robot_mode=RobotMode(carrier="satellite_mode"),
                periods=periods,
            ),
            period=PERIOD,
            guards={"fallback": {"joint_position": Hold()}},
            continuity={
                "joint_position": ("joint_position", np.repeat([0.02, 0.005], [7, 2])),
                **({"wheel_torque": None} if self.wheels else {}),  # Nothing measures it.
            },
        )

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        # Imported here: the DPS on the satellite runs without a plant.
        from vtbdrake.components.perception.markers import add_markers
        from vtbdrake_diagrams.satellite.plant import add_servicer, add_target
        from vtbdrake_diagrams.satellite.pose_sensor import PoseSensor
        from vtbdrake_diagrams.satellite.start import Release, random_start

        start = random_start(self.seed, tumble=np.radians(self.tumble_deg), distance=self.distance)
        plant, _ = builder.add_plant(self.plant_config)
        servicer = add_servicer(plant, wheels=self.wheels)
        target = add_target(plant, start.X_WT)
        add_markers(plant, plant.GetBodyByName("body", target), target_board())
        plant.Finalize()
        base, body = plant.GetBodyByName("base", servicer), plant.GetBodyByName("body", target)

        joints = [plant.GetJointByName(name, servicer) for name in JOINT_NAMES]
        builder.add_sensor("joint_position", JointEncoders(plant, joints, period=PERIOD, errors=self.joint_errors))
        imu = Imu(plant, plant.GetFrameByName("imu", servicer), period=PERIOD, errors=self.imu_errors)
        builder.add_sensor("imu", imu)
        if self.perception == "pose_sensor":
            pose_sensor = PoseSensor(plant, base, body, period=POSE_PERIOD, errors=self.pose_errors)
            builder.add_sensor("target_pose", pose_sensor)
        else:
            nothing = builder.add("sense", "target_pose", ConstantVectorSource(np.zeros(7)))
            builder.sim_sensor("target_pose", nothing.get_output_port())
        if self.aboard and self.blind:
            for signal in self._abstract_signals():
                dark = builder.add("sense", signal.name, ConstantValueSource(signal.abstract_value()))
                builder.sim_sensor(signal.name, dark.get_output_port())
        else:
            self._add_eyes(builder)

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
        self._declare_belief(builder)

    def _add_eyes(self, builder: VirtualTestbedBuilder) -> None:
        """Add the docking camera ``docking_camera`` with the ``light``, and the laser scanner ``scanner``."""
        from vtbdrake.components.environment.light import Light
        from vtbdrake.components.ray_casting import RayCaster
        from vtbdrake.components.sensors.camera import Camera, connect_camera
        from vtbdrake.components.sensors.laser_scanner import LaserScanner, connect_laser_scanner

        plant, scene_graph = builder.plant, builder.scene_graph
        if "camera" in self.aboard:
            light = builder.add("env", "light", Light(self.light))
            frame, X_FC = plant.GetFrameByName("camera"), None
            if self.camera_pose:
                frame, X_FC = frame.body().body_frame(), self.X_BC
            camera = Camera(
                plant,
                frame,
                X_FC=X_FC,
                period=1.0 / self.camera_fps,
                info=self.camera_info,
                supersampling=2,
                errors=self.camera_errors,
            )
            builder.add("sense", "docking_camera", camera)
            connect_camera(builder.diagram_builder, camera, scene_graph, light=light)
            builder.sim_sensor("image", camera.GetOutputPort("color_image"))
        if "scanner" in self.aboard:
            caster = RayCaster(plant, scene_graph)
            frame = plant.GetFrameByName("scanner")
            scanner = LaserScanner(plant, frame, caster, config=self.scanner, errors=self.scanner_errors)
            builder.add("sense", "scanner", scanner)
            connect_laser_scanner(builder.diagram_builder, scanner, plant)
            builder.sim_sensor("scan", scanner.GetOutputPort("scan"))

    @staticmethod
    def _declare_belief(builder: VirtualTestbedBuilder) -> None:
        """Declare what the servicer believes: both bodies move in its own inertial frame as it estimates.

        All of it is about the last instant but one: encoders, IMU and DPS take a period each. Until the present, all
        moves on with the velocities that it is believed to have. The fingers rest.
        """
        measured, rate = "dps.impl.controller.measured_position", "dps.impl.controller.joint_rate_command"
        positions, velocities = (
            [f"sim.sys.servicer.{name}.{value}" for name in JOINT_NAMES] for value in ("position", "velocity")
        )
        builder.believe(positions, of=[measured, rate], by=_joints_later, age=PERIOD, period=PERIOD)
        builder.believe(velocities[:ARM_JOINTS], of=[rate], by=itemgetter(slice(ARM_JOINTS)), age=PERIOD)
        base, target = "dps.env.base", "dps.env.target"
        builder.believe(
            "sim.sys.servicer.base.pose",
            of=[f"{base}.{name}" for name in ("orientation", "position", "angular_velocity", "velocity")],
            by=_base_later,
            age=PERIOD,
            period=PERIOD,
        )
        builder.believe(
            "sim.sys.servicer.base.velocity",
            of=[f"{base}.angular_velocity", f"{base}.velocity"],
            by=lambda w, v: np.concatenate((w, v)),
            age=PERIOD,
        )
        of = [f"{target}.pose", f"{target}.velocity"]
        builder.believe("sim.sys.target.body.pose", of=of, by=_target_later, age=PERIOD, period=PERIOD)
        builder.believe("sim.sys.target.body.velocity", of=of[1:], age=PERIOD)


def _lcm_map(signal: Signal, channel: str) -> LcmMap:
    """Return how a signal travels on a channel."""
    channel = channel.upper()
    if signal.name == "image":
        return image_map(channel, signal.name)
    if signal.name == "scan":
        return scan_map(channel, signal.name)
    return vector_map(channel, lcmt_scope, {signal.name: "value"})


def _joints_later(position: np.ndarray, rate: np.ndarray, *, late: float) -> np.ndarray:
    return position + late * np.append(rate[:ARM_JOINTS], np.zeros(len(position) - ARM_JOINTS))


def _base_later(q: np.ndarray, p: np.ndarray, w: np.ndarray, v: np.ndarray, *, late: float) -> np.ndarray:
    return pose_later(pose_to_array(pose_of_state(np.concatenate((q, p)))), np.concatenate((w, v)), late)


def _target_later(pose: np.ndarray, velocity: np.ndarray, *, late: float) -> np.ndarray:
    # The estimate is about the instant at which the DPS gets the samples.
    return pose_later(pose, velocity, late - PERIOD)
