"""`Station`: a scenario that a file of Drake's ``hardware_sim`` describes, but for its data processing system."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Callable, Collection, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, fields, replace
from math import inf
from pathlib import Path
from typing import Any, ClassVar, Self

from pydrake.lcm import DrakeLcmParams
from pydrake.manipulation import IiwaDriver, ZeroForceDriver
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import Multiplexer

from vtbdrake.common.argument_checks import check_takes, suggestion
from vtbdrake.common.settings import setting
from vtbdrake.control.bridge import acts_idle
from vtbdrake.control.runtime import Runtime
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.station.drivers import ACTING_LATENCY, AGE, Arm, CameraImages, Gripper, StationDriver
from vtbdrake.station.hardware_sim import HardwareSimScenario
from vtbdrake.station.models import JointLimits
from vtbdrake.testbed import Interface, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake.testbed.scenario_file import file_and_key, is_imported, read_fields

_DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0"  # LCM's default


@dataclass
class StationCommand:
    """A command u of a station's DPS: an input port for what an operator or a task asks of it.

    Attributes:
        default: The values that it has at first.
        entry_names: Short names of the entries; empty: the joints of the arm that the command's name begins with, if
            there is one, and an entry for each of them.
    """

    default: list[float] = field(default_factory=list)
    unit: str = setting("1", "The unit of the values.")
    lower: float | None = setting(None, "The least value of each entry.")
    upper: float | None = setting(None, "The largest value of each entry.")
    entry_names: list[str] = field(default_factory=list)

    def signal(self, name: str) -> Signal:
        """Return the command as a signal."""
        lower, upper = -inf if self.lower is None else self.lower, inf if self.upper is None else self.upper
        names, size = self.entry_names, len(self.default)
        return Signal(name, size, unit=self.unit, lower=lower, upper=upper, default=self.default, entry_names=names)


def _with_joints(command: Signal, drivers: Iterable[StationDriver]) -> Signal:
    """Return a command of a station, whose entries have the names of the joints of the arm that it begins with."""
    for arm in drivers:
        if not isinstance(arm, Arm) or not command.name.startswith(f"{arm.name}_"):
            continue
        if not command.entry_names and command.size == len(arm.joints):
            return replace(command, entry_names=arm.joints)
    return command


@dataclass
class Station(HardwareSimScenario):
    """A scenario from a file of Drake's ``hardware_sim``; the user adds the DPS only.

    For example::

        scenario = vtb.Station("my_station.yaml#Demo", dps=make_dps)
        testbed = scenario.build()
        with scenario.deploy("tcpq://127.0.0.1:7700") as runtime: ...

    ``make_dps(station)`` returns a new system. Its ports are signals of `signals`, by their names: the DPS reads the
    sensor signals that it has an input port for, and commands every actuator signal of the drivers but the optional
    ones. The other input ports are its commands u, which ``commands`` declares. The system becomes ``dps.impl`` of the
    testbed.

    The simulated drivers are Drake's (`HardwareSimScenario.add_drivers`). `deployment` describes the real ones: the
    messages of Drake's driver programs on the buses of the file, one cycle per status message of the first arm, limits
    and fallbacks by the models of the file, and where commands start from.

    A subclass overrides `make_impl`, names its ``file``, and so has a name ``package.module:Class`` for the command
    line; ``package.module:Class@FILE#KEY`` takes another file.

    Attributes:
        file: Class attribute of a subclass: the file ``FILE#KEY`` of stations that are made without one.
        dps: The name ``package.module:function`` of the function that makes the DPS.
        commands: The commands u of the DPS, by name.
        simulator_config: As in hardware_sim, whose default it has, but for ``target_realtime_rate``.
    """

    file: ClassVar[str] = ""

    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(max_step_size=1e-3, accuracy=1e-2)
    )
    lcm_buses: dict[str, DrakeLcmParams] = field(default_factory=lambda: {"default": DrakeLcmParams()})
    dps: str = setting("", "The function that makes the DPS, package.module:function.")
    commands: dict[str, StationCommand] = field(default_factory=dict)
    speed_time: float = setting(
        0.5, "The time in which a commanded position may reach its largest speed.", unit="s", gt=0.0
    )
    effort_time: float = setting(
        0.5, "The time in which a commanded torque may reach its largest value.", unit="s", gt=0.0
    )

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" not in cls.__dict__:  # Else, the dataclass decorator would replace it.
            cls.__init__ = cls.__init__  # type: ignore[method-assign]

    def __init__(
        self, file: str | os.PathLike[str] = "", *, dps: Callable[[Self], System] | str = "", **values: Any
    ) -> None:
        """Read a file of ``hardware_sim``.

        Args:
            file: ``FILE``, or ``FILE#KEY`` of one with several stations; by default the ``file`` of the class.
            dps: The function that makes the DPS, or its name ``package.module:function``.
            values: Values of fields, which override the file's.

        Raises:
            ScenarioError: The file does not exist, or does not describe a station.
        """
        self._set_defaults()
        if source := os.fspath(file) or self.file:
            path, key = file_and_key(source)
            self.__dict__.update(read_fields(self, Path(path), key).__dict__)
        if callable(dps):
            self.__dict__["_dps_function"] = dps
            dps = function_name(dps)
        for name, value in {**({"dps": dps} if dps else {}), **values}.items():
            names = [item.name for item in fields(self)]
            if name not in names:
                raise ScenarioError(f"{type(self).__name__} has no field {name!r}{suggestion(name, names)}")
            setattr(self, name, value)

    @classmethod
    def blank(cls) -> Self:
        station = cls.__new__(cls)
        station._set_defaults()
        return station

    def _set_defaults(self) -> None:
        for item in fields(self):
            value = item.default_factory() if callable(item.default_factory) else item.default
            setattr(self, item.name, value)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_contents"}

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        copied = type(self).__new__(type(self))
        copied.__dict__.update(copy.deepcopy(self.__getstate__(), memo))
        if "_contents" in self.__dict__:  # What has been read is not changed: both can use it.
            copied.__dict__["_contents"] = self.__dict__["_contents"]
        return copied

    def validate(self) -> None:
        """Check the fields, and the models and drivers that they describe.

        Raises:
            ScenarioError: A driver does not fit its model, or a model cannot be read.
        """
        super().validate()
        self._read()

    def signals(self) -> dict[str, Signal]:
        """Return all signals that the drivers and the cameras of the file offer, by name."""
        contents = self._read()
        sensors = [signal for sender in contents.senders for signal in sender.sense]
        return {signal.name: signal for signal in [*sensors, *contents.actuators]}

    def arm_model(self, name: str) -> MultibodyPlant:
        """Return a new plant of an arm with its hand alone, as its driver knows it: for a DPS that needs a model."""
        return self._arm(name).new_model()

    def joint_limits(self, name: str) -> JointLimits:
        """Return the limits of the joints of an arm."""
        return self._arm(name).limits

    def _arm(self, name: str) -> Arm:
        arms = {driver.name: driver for driver in self._read().drivers if isinstance(driver, Arm)}
        if name not in arms:
            raise ScenarioError(
                f"{self.where('model_drivers')}: no IiwaDriver drives {name!r}; there are: {', '.join(arms) or 'none'}"
            )
        return arms[name]

    def make_impl(self) -> System:
        """Return a new system of the user, ``dps.impl``; by default the one that the function ``dps`` makes."""
        function = self.__dict__.get("_dps_function")
        if function is None and self.dps:
            module, _, name = self.dps.partition(":")
            if not is_imported(self.dps):
                raise ScenarioError(
                    f"{self.where('dps')} names the function {self.dps}, and to import its module runs its code: if "
                    f"that is what you want, import {module} first, or add --trust {module} on the command line"
                )
            function = sys.modules[module]
            for part in name.split("."):
                function = getattr(function, part, None)
        if not callable(function):
            raise ScenarioError(
                f"{type(self).__name__} has no DPS: give it dps=, a function of the station that returns a System"
                + (f"; {self.dps} is none" if self.dps else "")
            )
        check_takes(function, ["the station"], name=f"the function {self.dps}")
        system = function(self)
        if not isinstance(system, System):
            raise ScenarioError(f"{self.dps} returns a new System for a station, not {system!r}")
        return system

    def make_dps(self) -> Diagram:
        """Return the DPS: ``impl``, and an end for the sensor signals that it does not read."""
        interface, builder = self.interface(), DiagramBuilder()
        impl = builder.AddNamedSystem("impl", self.make_impl())
        inputs = [impl.get_input_port(i).get_name() for i in range(impl.num_input_ports())]
        for signal in interface.commands:
            if signal.name not in inputs:
                raise ScenarioError(
                    f"the DPS has no input port for the command {signal.name!r}; it has: "
                    f"{', '.join(inputs) or 'none'}. Add it, or leave the command out"
                )
        unread = [signal for signal in interface.sense if signal.name not in inputs]
        for signal in [*interface.sense, *interface.commands]:
            if signal not in unread:
                builder.ExportInput(impl.GetInputPort(signal.name), signal.name)
        if unread:
            end = builder.AddNamedSystem("unread", Multiplexer([signal.size or 1 for signal in unread]))
            for index, signal in enumerate(unread):
                builder.ExportInput(end.get_input_port(index), signal.name)
        for signal in interface.act:
            builder.ExportOutput(impl.GetOutputPort(signal.name), signal.name)
        return builder.Build()

    def interface(self) -> Interface:
        """Return the sensor signals that the DPS reads or its deployment needs, the actuator signals, the commands.

        Raises:
            ScenarioError: The ports of the DPS do not fit the file.
        """
        contents = self._read()
        if contents.interface is None:
            contents.interface = self._fitted(contents, self.make_impl())
        return contents.interface

    def _fitted(self, contents: _Contents, impl: System) -> Interface:
        inputs = [impl.get_input_port(i).get_name() for i in range(impl.num_input_ports())]
        outputs = [impl.get_output_port(i).get_name() for i in range(impl.num_output_ports())]
        needed = {name for driver in contents.drivers for name in driver.needed}
        sensors = [s for driver in contents.drivers for s in driver.sense if s.name in needed or s.name in inputs]
        sensors += [signal for camera in contents.cameras.values() for signal in camera.sense if signal.name in inputs]
        offered = [signal.name for sender in contents.senders for signal in sender.sense]
        modes = ", ".join(f"{driver.name} ({driver.mode})" for driver in contents.drivers) or "no driver"
        actuators = {signal.name: signal for signal in contents.actuators}
        for name in outputs:
            if name not in actuators:
                raise ScenarioError(
                    f"the DPS has an output port {name!r}, but the drivers of {self.where('model_drivers')}, {modes}, "
                    f"take {', '.join(actuators) or 'no actuator signal'}: rename it, or change the control_mode"
                )
        for driver in contents.drivers:
            for signal in driver.act:
                if signal.name not in outputs and signal.name not in driver.optional:
                    raise ScenarioError(
                        f"the DPS has no output port {signal.name}, which {driver.name} "
                        f"({self.where(f'model_drivers.{driver.name}')}) needs in its mode {driver.mode}; it has: "
                        f"{', '.join(outputs) or 'none'}. Add it, change the control_mode, or make {driver.name} a "
                        "!ZeroForceDriver"
                    )
        for name in inputs:
            if name not in offered and name not in self.commands:
                raise ScenarioError(
                    f"the DPS has an input port {name!r}, but {self.where('model_drivers')} offers no such sensor "
                    f"signal{suggestion(name, offered)}: rename it, or declare it as a command, "
                    f"commands={{{name!r}: StationCommand(default=[...])}}"
                )
        for name, command in self.commands.items():
            if not isinstance(command, StationCommand):
                raise ScenarioError(f"the command {name!r} is a StationCommand(default=[...]), not {command!r}")
        return Interface(
            sense=sensors,
            act=[signal for name, signal in actuators.items() if name in outputs],
            commands=[_with_joints(command.signal(name), contents.drivers) for name, command in self.commands.items()],
        )

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        contents = self._read()
        interface = builder.interface
        used = {signal.name for signal in (*interface.sense, *interface.act)}
        simulated = self.add_drivers(builder, self.add_models(builder))
        for driver in contents.drivers:
            driver.connect(builder, simulated[driver.name], used)
        cameras = self._read_cameras(contents, used)
        for key, system in self.add_cameras(builder, only=cameras).items():
            cameras[key].connect(builder, system, used)

    @staticmethod
    def _read_cameras(contents: _Contents, read: Collection[str]) -> dict[str, CameraImages]:
        """Return the cameras with an image that the DPS reads, by their keys."""
        return {
            key: camera
            for key, camera in contents.cameras.items()
            if any(signal.name in read for signal in camera.sense)
        }

    def deployment(self) -> Deployment:
        contents, interface = self._read(), self.interface()
        if not contents.drivers:
            return Deployment()
        commanded = [signal.name for signal in interface.act]
        read = [signal.name for signal in interface.sense]
        pacer = next((driver for driver in contents.drivers if isinstance(driver, Arm)), contents.drivers[0])
        sense = [(driver.status(read), driver.period, driver.name) for driver in contents.drivers]
        cameras = self._read_cameras(contents, read)
        sense += [(camera.images(read), camera.period, key) for key, camera in cameras.items()]
        self._check_channels([(map.channel, name) for map, _, name in sense])
        starts = [driver.continuity(pacer.period) for driver in contents.drivers]
        fallbacks = [driver.fallbacks() for driver in contents.drivers]
        idle = {name: value for driver in contents.drivers for name, value in driver.idle().items()}
        return Deployment(
            protocol=Protocol(
                sense=[map for map, _, _ in sense],
                act=[driver.command(commanded) for driver in contents.drivers],
                reported={name: other for driver in contents.drivers for name, other in driver.reported().items()},
                periods={map.channel: period for map, period, _ in sense if period != pacer.period},
            ),
            period=pacer.period,
            guards={
                "fallback": {name: each[name] for each in fallbacks for name in each if name in commanded},
                "max_delay": {driver.sense[0].name: AGE * driver.period for driver in contents.drivers},
                "acting_latency": ACTING_LATENCY,
            },
            continuity={name: each[name] for each in starts for name in each if name in commanded},
            released_by=acts_idle(idle),
            pace=pacer.sense[0].name,
        )

    def _check_channels(self, channels: list[tuple[str, str]]) -> None:
        names: dict[str, str] = {}
        for channel, name in channels:
            if channel in names:
                raise ScenarioError(
                    f"{self.where('model_drivers')}: {names[channel]} and {name} both send on the channel {channel}: "
                    "give them two lcm_buses, one with a channel_suffix"
                )
            names[channel] = name

    def url(self) -> str:
        """Return the URL of the bus that the file gives its drivers and the cameras that the DPS reads.

        Raises:
            ScenarioError: They are on several buses, or on one that no other process can reach.
        """
        contents = self._read()
        cameras = self._read_cameras(contents, [signal.name for signal in self.interface().sense])
        users: list[Any] = [self.model_drivers[driver.name] for driver in contents.drivers]
        users += [self.cameras[key] for key in cameras]
        default = os.environ.get("LCM_DEFAULT_URL") or _DEFAULT_URL
        urls = {self._bus(user, self.where()).lcm_url or default for user in users}
        if len(urls) != 1 or next(iter(urls)).startswith("memq:"):
            raise ScenarioError(
                f"{self.where('lcm_buses')}: the drivers are on {', '.join(sorted(urls)) or 'no bus'}, and a "
                "deployment needs one that other processes reach: name it, deploy(url)"
            )
        return urls.pop()

    def deploy(
        self, url: str = "", *, record: str | os.PathLike[str] | None = None, **options: Any
    ) -> AbstractContextManager[Runtime]:
        """Connect the DPS to the machine, see `Scenario.deploy`; by default on the bus of the file.

        Args:
            url: The LCM URL; by default the bus of the file.
            record: File of the log; None for none.
            **options: As in `Scenario.deploy`.
        """
        return super().deploy(url or self.url(), record=record, **options)

    def _bus(self, user: Any, where: str) -> DrakeLcmParams:
        """Return the bus of a driver or a camera."""
        if user.lcm_bus not in self.lcm_buses:
            raise ScenarioError(
                f"{where}: there is no bus {user.lcm_bus!r} in lcm_buses, but: {', '.join(self.lcm_buses) or 'none'}"
            )
        return self.lcm_buses[user.lcm_bus]

    def _read(self) -> _Contents:
        """Return the contents that the fields describe; the ones read before, if they are the same."""
        key = repr((self.record(), self.__dict__.get("_dps_function")))
        contents: _Contents | None = self.__dict__.get("_contents")
        if contents is None or contents.key != key:
            contents = self.__dict__["_contents"] = self._new_contents(key)
        return contents

    def _new_contents(self, key: str) -> _Contents:
        plant = MultibodyPlant(self.plant_config.time_step or 1e-3)
        models = self.add_models_to(plant)
        self._check_drivers(models)
        self._check_cameras()
        by_name = {model.model_name: model for model in models}
        times = {"speed_time": self.speed_time, "effort_time": self.effort_time}
        drivers: list[StationDriver] = []
        for name, driver in self.model_drivers.items():
            where = self.where(f"model_drivers.{name}")
            if isinstance(driver, ZeroForceDriver):
                continue
            bus = self._bus(driver, where)
            if isinstance(driver, IiwaDriver):
                drivers.append(Arm(name, driver, plant, by_name, bus=bus, where=where, **times))
            else:
                drivers.append(Gripper(name, driver, plant, by_name, bus=bus, where=where))
        cameras = {
            name: CameraImages(config, bus=self._bus(config, self.where(f"cameras.{name}")))
            for name, config in self.cameras.items()
        }
        return _Contents(key, drivers, cameras)


@dataclass
class _Contents:
    """The drivers and cameras of a station, as they were read."""

    key: str  # the fields that they were read from
    drivers: list[StationDriver]
    cameras: dict[str, CameraImages]  # by their keys
    interface: Interface | None = None

    @property
    def senders(self) -> list[StationDriver | CameraImages]:
        return [*self.drivers, *self.cameras.values()]

    @property
    def actuators(self) -> list[Signal]:
        return [signal for driver in self.drivers for signal in driver.act]


def function_name(function: Callable[..., Any]) -> str:
    """Return ``package.module:function``, for records and files."""
    return f"{function.__module__}:{getattr(function, '__qualname__', type(function).__qualname__)}"
