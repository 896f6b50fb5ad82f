"""The drivers of a station: the signals that each offers, its simulated and its real end, and what keeps it safe."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.lcm import DrakeLcmParams
from pydrake.manipulation import IiwaDriver, SchunkWsgDriver
from pydrake.multibody.parsing import ModelInstanceInfo
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import System
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer, PassThrough
from pydrake.systems.sensors import CameraConfig, ImageDepth16U, ImageLabel16I, ImageRgba8U

from vtbdrake.control.fallback import Brake, Fallback, Hold, gravity_compensation
from vtbdrake.drake_workarounds.schunk_wsg import FORCE_LIMIT, STATUS_PERIOD
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.sensor_messages import image_array_map
from vtbdrake.lcm.wsg_messages import wsg_command, wsg_status
from vtbdrake.station.models import JointLimits, arm_model, driven_joints
from vtbdrake.testbed import ScenarioError, Signal, VirtualTestbedBuilder

AGE = 10.0
"""The largest age of a sensor signal, in periods of its messages."""
ACTING_LATENCY = 4.0
"""The number of periods within which a command acts on an arm and is in its status: 20 ms at 200 Hz."""
_MARGIN = np.radians(5.0)  # by which joints run into their stops
_FINGER_MARGIN = 0.02  # m
_BRAKING_TIME = 0.1  # s, in which the brake of an arm takes the speed of a joint that moves alone
_LOOSE = 10.0  # how far, by effort limits, external torques and forces are plausible


class StationDriver(ABC):
    """One driver of a station's file.

    Attributes:
        name: The model that it drives.
        sense: The sensor signals that it offers.
        needed: Those that a deployment needs, whether the DPS reads them or not: for pace, continuity and fallbacks.
        act: The actuator signals that it takes.
        optional: The actuator signals that a DPS may leave out.
        mode: What it takes, in words, for messages.
        period: The period of its status messages in s.
    """

    name: str
    sense: Sequence[Signal]
    needed: frozenset[str]
    act: Sequence[Signal]
    optional: frozenset[str] = frozenset()
    mode: str
    period: float

    @abstractmethod
    def connect(self, builder: VirtualTestbedBuilder, simulated: System, used: Collection[str]) -> None:
        """Connect the signals to the simulated driver.

        Args:
            builder: The builder of the testbed.
            simulated: What `HardwareSimScenario.add_drivers` has added.
            used: The signals of the interface.
        """

    @abstractmethod
    def status(self, used: Collection[str]) -> LcmMap:
        """Return the map of the messages of the real driver, with the signals of the interface."""

    @abstractmethod
    def command(self, used: Collection[str]) -> LcmMap:
        """Return the map of the messages to the real driver."""

    @abstractmethod
    def continuity(self, period: float) -> Mapping[str, tuple[str, ArrayLike] | None]:
        """Return the signals from which the actuator commands start at a switch to real, in a loop of this period."""

    @abstractmethod
    def fallbacks(self) -> Mapping[str, Fallback]:
        """Return the fallbacks of the actuator signals."""

    def reported(self) -> Mapping[str, str]:
        """Return `Protocol.reported`: of a gripper nothing, whose status does not tell its target.

        No status of these drivers tells of the machine's own stop, so there is no `Protocol.robot_mode`.
        """
        return {}

    def idle(self) -> Mapping[str, float]:
        """Return the commands that act while the machine does without any, for `Deployment.released_by`."""
        return {}


class Arm(StationDriver):
    """An arm with a KUKA iiwa's control cabinet, in one of its control modes.

    Signals, with the name of the model before each: the sensor signals ``_position_measured``, ``_velocity_estimated``,
    ``_position_commanded`` (in the position modes), ``_torque_commanded``, ``_torque_measured``, ``_torque_external``,
    and ``_torque_added`` (in torque-only mode): the commanded torque on top of the gravity compensation. The actuator
    signals ``_position`` and ``_torque``, as the mode has them. In ``position_and_torque``, the torque may be left out.

    Where its model has no limit, a commanded position may reach its largest speed within ``speed_time``, a torque its
    largest value within ``effort_time``, in s.

    After a fault, a position is held; torques brake the joints, and vanish without a measured velocity: the cabinet
    carries the weight.

    Args:
        driver: The driver in the file.
        plant: The plant of the station's models.
        models: The models, by name.
        bus: The LCM bus of the driver.
        speed_time: The time in s in which a position without a limit may reach its largest speed.
        effort_time: The time in s in which a torque without a limit may reach its largest value.
        where: The place in the file, for messages.
    """

    def __init__(
        self,
        name: str,
        driver: IiwaDriver,
        plant: MultibodyPlant,
        models: Mapping[str, ModelInstanceInfo],
        *,
        bus: DrakeLcmParams,
        speed_time: float,
        effort_time: float,
        where: str,
    ) -> None:
        if driver.control_mode not in _MODES:
            raise ScenarioError(
                f"{where}: control_mode of {name} is one of {', '.join(_MODES)}, not {driver.control_mode!r}"
            )
        self.name, self.mode, self.period = name, driver.control_mode, driver.lcm_status_period
        self._suffix = bus.channel_suffix
        joints, limits = driven_joints(plant, models[name], driver=type(driver).__name__, where=where)
        self.joints = tuple(joint.name() for joint in joints)
        self.limits: JointLimits = limits
        self.new_model = partial(arm_model, plant, models, name, driver)
        self.model = self.new_model()
        self._has_position, self._has_torque = "position" in self.mode, "torque" in self.mode
        self._torque_alone = not self._has_position
        self._size = len(joints)
        home = plant.GetDefaultPositions(models[name].model_instance)
        self.sense = self._sensors()
        self.act = self._commands(np.clip(home, limits.lower, limits.upper), speed_time, effort_time)
        self.optional = frozenset({f"{name}_torque"} if self._has_position else ())
        extra = ("position_commanded",) if self._has_position else ("torque_added", "velocity_estimated")
        self.needed = frozenset(f"{name}_{needed}" for needed in ("position_measured", *extra))

    def _sensors(self) -> list[Signal]:
        limits, age = self.limits, AGE * self.period
        positions = {"unit": "rad", "lower": limits.lower - _MARGIN, "upper": limits.upper + _MARGIN}

        def sensor(name: str, **options: Any) -> Signal:
            return Signal(f"{self.name}_{name}", size=self._size, max_age=age, entry_names=self.joints, **options)

        def torque(name: str, factor: float) -> Signal:
            return sensor(name, unit="N m", lower=-factor * limits.effort, upper=factor * limits.effort)

        # What is measured may pass the limits of the commands; only what is impossible is refused.
        sensors = [
            sensor("position_measured", **positions),
            sensor("velocity_estimated", unit="rad/s", lower=-_LOOSE * limits.speed, upper=_LOOSE * limits.speed),
            torque("torque_commanded", 2.0),
            torque("torque_measured", 2.0),
            torque("torque_external", _LOOSE),
        ]
        if self._has_position:
            sensors.append(sensor("position_commanded", **positions))
        else:
            sensors.append(torque("torque_added", 4.0))
        return sensors

    def _commands(self, home: np.ndarray, speed_time: float, effort_time: float) -> list[Signal]:
        limits, commands = self.limits, []
        if self._has_position:
            acceleration = np.where(np.isfinite(limits.acceleration), limits.acceleration, limits.speed / speed_time)
            commands.append(
                Signal(
                    f"{self.name}_position",
                    size=self._size,
                    unit="rad",
                    lower=limits.lower,
                    upper=limits.upper,
                    rate=limits.speed,
                    acceleration=acceleration,
                    idle=home,
                    entry_names=self.joints,
                )
            )
        if self._has_torque:
            # On top of a position controller, nothing measures it: no limited rate could start anywhere.
            rate = limits.effort / effort_time if self._torque_alone else np.inf
            commands.append(
                Signal(
                    f"{self.name}_torque",
                    size=self._size,
                    unit="N m",
                    lower=-limits.effort,
                    upper=limits.effort,
                    rate=rate,
                    idle=0.0,
                    entry_names=self.joints,
                )
            )
        return commands

    def connect(self, builder: VirtualTestbedBuilder, simulated: System, used: Collection[str]) -> None:
        for name in (signal.name for signal in self.sense if signal.name in used):
            port = name.removeprefix(f"{self.name}_")
            if port != "torque_added":
                builder.sim_sensor(name, simulated.GetOutputPort(port))
        if self._has_position:
            builder.sim_actuator(f"{self.name}_position", simulated.GetInputPort("position"))
        if self._torque_alone:
            added = builder.add("act", f"{self.name}_torque", PassThrough(self._size))
            # The driver passes NaN on, and the plant raises.
            builder.sim_actuator(f"{self.name}_torque", added.get_input_port(), raises_at="nan")
            builder.sim_sensor(f"{self.name}_torque_added", added.get_output_port())
            builder.connect(added.get_output_port(), simulated.GetInputPort("torque"))
        elif f"{self.name}_torque" in used:
            builder.sim_actuator(f"{self.name}_torque", simulated.GetInputPort("torque"), raises_at="nan")
        elif self._has_torque:
            nothing = builder.add("act", f"{self.name}_torque", ConstantVectorSource(np.zeros(self._size)))
            builder.connect(nothing.get_output_port(), simulated.GetInputPort("torque"))

    def status(self, used: Collection[str]) -> LcmMap:
        fields = {
            f"{self.name}_position_measured": "joint_position_measured",
            f"{self.name}_velocity_estimated": "joint_velocity_estimated",
            f"{self.name}_position_commanded": "joint_position_commanded",
            f"{self.name}_torque_commanded": "joint_torque_commanded",
            f"{self.name}_torque_measured": "joint_torque_measured",
            f"{self.name}_torque_external": "joint_torque_external",
        }
        fields = _of(fields, used)
        channel = f"IIWA_STATUS{self._suffix}"
        if self._has_position:
            return iiwa_status({**fields, self._reported: "joint_position_commanded"}, channel=channel)
        on_top = {f"{self.name}_torque_added": "joint_torque_measured", self._reported: "joint_torque_commanded"}
        return iiwa_status(fields, on_top=on_top, gravity=gravity_compensation(self.model), channel=channel)

    @property
    def _reported(self) -> str:
        return f"{self.name}_{'position' if self._has_position else 'torque'}_reported"

    def reported(self) -> Mapping[str, str]:
        # The status says nothing about a torque on top of a position controller.
        return {f"{self.name}_{'position' if self._has_position else 'torque'}": self._reported}

    def idle(self) -> Mapping[str, float]:
        return {f"{self.name}_torque": 0.0} if self._torque_alone else {}

    def command(self, used: Collection[str]) -> LcmMap:
        fields = {f"{self.name}_position": "joint_position", f"{self.name}_torque": "joint_torque"}
        return iiwa_command(_of(fields, used), channel=f"IIWA_COMMAND{self._suffix}")

    def continuity(self, period: float) -> Mapping[str, tuple[str, ArrayLike] | None]:
        starts: dict[str, tuple[str, ArrayLike] | None] = {}
        for signal in self.act:
            allowed = np.broadcast_to(np.asarray(signal.rate) * period, (self._size,))
            if signal.unit == "rad":
                starts[signal.name] = (f"{self.name}_position_commanded", np.where(np.isinf(allowed), 0.005, allowed))
            elif self._torque_alone:
                starts[signal.name] = (f"{self.name}_torque_added", np.where(np.isinf(allowed), 2.5, allowed))
            else:
                starts[signal.name] = None
        return starts

    def fallbacks(self) -> Mapping[str, Fallback]:
        # The inertia of a joint is smallest while the others are free.
        mass = self.model.CalcMassMatrix(self.model.CreateDefaultContext())
        inertia = 1.0 / np.diag(np.linalg.inv(mass))
        brake = Brake(f"{self.name}_velocity_estimated", gain=inertia / _BRAKING_TIME)
        return {signal.name: Hold() if signal.unit == "rad" else brake for signal in self.act}


def _of(fields: Mapping[str, str], used: Collection[str]) -> dict[str, str]:
    """Return the fields of the signals that are used."""
    return {name: path for name, path in fields.items() if name in used}


_MODES = ("position_only", "position_and_torque", "torque_only")


class Gripper(StationDriver):
    """A Schunk WSG gripper under position control.

    Signals of size 1, with the name of the model before each: the sensor signals ``_position_measured`` (the distance
    of the fingers in m), ``_velocity_measured`` (m/s) and ``_force_measured`` (N, never negative); the actuator signals
    ``_position`` (the distance in m) and ``_force_limit`` (N), which may be left out.

    After a fault, the last command goes on: a gripper that has grasped something keeps it.

    Args:
        driver: The driver in the file.
        plant: The plant of the station's models.
        models: The models, by name.
        bus: The LCM bus of the driver.
        where: The place in the file, for messages.
    """

    period = STATUS_PERIOD
    mode = "position"

    def __init__(
        self,
        name: str,
        driver: SchunkWsgDriver,
        plant: MultibodyPlant,
        models: Mapping[str, ModelInstanceInfo],
        *,
        bus: DrakeLcmParams,
        where: str,
    ) -> None:
        self.name, self._suffix = name, bus.channel_suffix
        instance = models[name].model_instance
        if (plant.num_positions(instance), plant.num_actuators(instance)) != (2, 2):
            raise ScenarioError(
                f"{where}: {type(driver).__name__} cannot drive {name} ({models[name].model_path}): it needs two "
                f"actuated fingers, not {plant.num_positions(instance)} positions and {plant.num_actuators(instance)} "
                "actuators"
            )
        _, limits = driven_joints(plant, models[name], driver=type(driver).__name__, where=where)
        # Finger 0 opens to negative positions, finger 1 to positive ones.
        least, most = max(0.0, limits.lower[1] - limits.upper[0]), limits.upper[1] - limits.lower[0]
        home = plant.GetDefaultPositions(instance)
        largest_force = 2.0 * float(limits.effort.min())
        force = min(FORCE_LIMIT, largest_force)
        age = AGE * STATUS_PERIOD
        self.sense = [
            Signal(
                f"{name}_position_measured",
                size=1,
                unit="m",
                lower=least - _FINGER_MARGIN,
                upper=most + _FINGER_MARGIN,
                max_age=age,
            ),
            Signal(f"{name}_velocity_measured", size=1, unit="m/s", lower=-10.0, upper=10.0, max_age=age),
            Signal(f"{name}_force_measured", size=1, unit="N", lower=0.0, upper=_LOOSE * largest_force, max_age=age),
        ]
        self.act = [
            Signal(
                f"{name}_position",
                size=1,
                unit="m",
                lower=least,
                upper=most,
                idle=float(np.clip(home[1] - home[0], least, most)),
            ),
            Signal(f"{name}_force_limit", size=1, unit="N", lower=0.0, upper=largest_force, idle=force),
        ]
        self._force = force
        self.optional = frozenset({f"{name}_force_limit"})
        self.needed = frozenset({f"{name}_position_measured"})

    def connect(self, builder: VirtualTestbedBuilder, simulated: System, used: Collection[str]) -> None:
        state = builder.add("sense", f"{self.name}_state", Demultiplexer(2, 1))
        builder.connect(simulated.GetOutputPort("state_measured"), state.get_input_port())
        ports = {
            f"{self.name}_position_measured": state.get_output_port(0),
            f"{self.name}_velocity_measured": state.get_output_port(1),
            f"{self.name}_force_measured": simulated.GetOutputPort("force_measured"),
        }
        for name, port in ports.items():
            if name in used:
                builder.sim_sensor(name, port)
        builder.sim_actuator(f"{self.name}_position", simulated.GetInputPort("position"), raises_at="not finite")
        if f"{self.name}_force_limit" in used:
            builder.sim_actuator(
                f"{self.name}_force_limit", simulated.GetInputPort("force_limit"), raises_at="not finite"
            )
        else:
            limit = builder.add("act", f"{self.name}_force_limit", ConstantVectorSource([self._force]))
            builder.connect(limit.get_output_port(), simulated.GetInputPort("force_limit"))

    def status(self, used: Collection[str]) -> LcmMap:
        fields = {
            f"{self.name}_position_measured": "actual_position_mm",
            f"{self.name}_velocity_measured": "actual_speed_mm_per_s",
            f"{self.name}_force_measured": "actual_force",
        }
        return wsg_status(_of(fields, used), channel=f"SCHUNK_WSG_STATUS{self._suffix}")

    def command(self, used: Collection[str]) -> LcmMap:
        fields = _of({f"{self.name}_position": "target_position_mm", f"{self.name}_force_limit": "force"}, used)
        force = None if "force" in fields.values() else self._force
        return wsg_command(fields, force=force, channel=f"SCHUNK_WSG_COMMAND{self._suffix}")

    def continuity(self, period: float) -> Mapping[str, tuple[str, ArrayLike] | None]:
        # A gripper moves to its target at its own speed, wherever it is.
        return {signal.name: None for signal in self.act}

    def fallbacks(self) -> Mapping[str, Fallback]:
        return {signal.name: Hold() for signal in self.act}


class CameraImages:
    """The images of a camera: sensor signals that a DPS may read, with the name of the camera before each.

    They are ``_color_image`` (`ImageRgba8U`), ``_depth_image`` (`ImageDepth16U`, in mm) and ``_label_image``
    (`ImageLabel16I`), as far as ``rgb``, ``depth`` and ``label`` of the `CameraConfig` ask for them.

    Args:
        config: The camera in the file.
        bus: The LCM bus of its images.
    """

    _KINDS = (
        ("rgb", "color_image", "color_image", "rgb", ImageRgba8U),
        ("depth", "depth_image", "depth_image_16u", "depth", ImageDepth16U),
        ("label", "label_image", "label_image", "label", ImageLabel16I),
    )

    def __init__(self, config: CameraConfig, *, bus: DrakeLcmParams) -> None:
        self.period = 1.0 / config.fps
        self._channel = f"DRAKE_RGBD_CAMERA_IMAGES_{config.name}{bus.channel_suffix}"
        self._compress = config.do_compress
        kinds = [(f"{config.name}_{kind[1]}", *kind) for kind in self._KINDS if getattr(config, kind[0])]
        self.sense = [
            Signal(name, model_value=image(config.width, config.height), max_age=AGE * self.period)
            for name, *_, image in kinds
        ]
        self._ports = {name: port for name, _, _, port, _, _ in kinds}
        self._frames = {name: frame for name, *_, frame, _ in kinds}

    def connect(self, builder: VirtualTestbedBuilder, camera: System, used: Collection[str]) -> None:
        """Connect the images that the DPS reads to the simulated camera.

        Args:
            builder: The builder of the testbed.
            camera: The simulated camera, a system with the image ports of Drake's cameras.
            used: The names of the sensor signals that the DPS reads.
        """
        for name, port in self._ports.items():
            if name in used:
                builder.sim_sensor(name, camera.GetOutputPort(port))

    def images(self, used: Collection[str]) -> LcmMap:
        """Return the map of the messages of the real camera, as Drake's simulated one sends them."""
        return image_array_map(self._channel, _of(self._frames, used), compress=self._compress)
