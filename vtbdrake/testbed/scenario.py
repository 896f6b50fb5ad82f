"""Scenarios: plain data that builds a testbed, in this process or in another, from Python or from YAML."""

from __future__ import annotations

import copy
import copyreg
import math
import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, is_dataclass, replace
from inspect import get_annotations
from types import FunctionType, NoneType
from typing import TYPE_CHECKING, Any, ClassVar, Self, Union

import numpy as np
from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig
from pydrake.systems.framework import System

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.field_types import alternatives, field_types
from vtbdrake.common.settings import check_settings, check_value, plain_types
from vtbdrake.drake_workarounds.cenic import DRAKE, FIXED_STEPS_ARE_STALE
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.pedigree import Number, Pedigree
from vtbdrake.testbed.posterior_samples import samples
from vtbdrake.testbed.scenario_identity import ScenarioError
from vtbdrake.testbed.scenario_text import save_scenario
from vtbdrake.testbed.signal import Interface
from vtbdrake.testbed.testbed import VirtualTestbed

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from vtbdrake.common.validity_domain import ValidityDomain
    from vtbdrake.testbed.hand_command import HandCommand
    from vtbdrake.upper_layers import Deployment, Runtime

# The keys of these fields in files.
FILE_KEYS = {"simulator_config": "simulator", "plant_config": "plant"}
# Begin of the addresses of fields.
_FIELD = "scenario."
# Fields of SimulatorConfig that do not change a trajectory.
_NO_IDENTITY = {"simulator.start_time", "simulator.target_realtime_rate", "simulator.publish_every_time_step"}


@dataclass
class Scenario(ABC):
    """A dataclass, with a default for every field, that builds a testbed.

    A subclass adds fields and defines the interface of the DPS, the DPS, and the simulated world. Elements of the
    Context (masses, gains, poses) are variables of the testbed; properties that need another Diagram (geometry,
    gravity, a time step) are fields. Fields are plain types, dataclasses of them, and Drake's configs
    (`MultibodyPlantConfig`, `CameraConfig`, ...), so that a scenario can be written as YAML and sent to other
    processes.

    When a study varies a field, a testbed is built for each value. Python's garbage collector frees unused ones if
    every system in Python is a `vtbdrake.state.AddressedSystem`. Others stay until their process ends;
    `ProcessExecutor` replaces workers that have grown.

    Attributes:
        simulator_config: The integrator. ``target_realtime_rate`` and ``publish_every_time_step`` hold for
            `VirtualTestbed.simulator`, not for rollouts and control loops.
        pedigree: Where the numbers of the testbed are from. Those with a value begin with it in s0.
    """

    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    pedigree: Pedigree = field(default_factory=Pedigree, kw_only=True)

    # Names of fields that tell where something lies, not what it is: no part of the identity.
    _PLACES: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _refuse_replaced_methods(cls)
        # Else, the dataclass decorator would replace them: Drake's configs have no equality.
        for name in ("__eq__", "__repr__"):
            if name not in cls.__dict__:
                setattr(cls, name, getattr(cls, name))

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return dict(_flat(self)) == dict(_flat(other))

    # Scenarios are mutable.
    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """Show the class and the fields that differ from their defaults."""
        return _changed_fields(self)

    def __setattr__(self, name: str, value: Any) -> None:
        # Already here, since multiprocessing copies the table of copyreg before it pickles anything.
        _make_picklable(value)
        super().__setattr__(name, value)

    def __reduce_ex__(self, protocol: Any) -> Any:
        _make_picklable(self.__dict__)  # A list may have got another config since.
        return super().__reduce_ex__(protocol)

    @classmethod
    def blank(cls) -> Self:
        """Return the scenario that the fields of a file are filled into: by default, that with the defaults."""
        return cls()

    def set_origin(self, path: str, lines: Mapping[str, int]) -> None:
        """Remember the file that the fields come from, and the line of each dotted name, for `where`.

        Args:
            path: Path of the file.
            lines: Line numbers by dotted name of a field, from 1.
        """
        self.__dict__["_origin"] = (path, lines)

    def forget_origin(self) -> None:
        """Forget the file that the fields come from: it is gone."""
        self.__dict__.pop("_origin", None)

    def where(self, name: str = "") -> str:
        """Return the place where a field is set, for messages: file and line of a field from a file, else its class."""
        if "_origin" not in self.__dict__:
            return f"{type(self).__name__}.{name}" if name else type(self).__name__
        path, lines = self.__dict__["_origin"]
        while name and name not in lines:
            name = name.rpartition(".")[0]
        return f"{path}, line {lines[name]}" if name else str(path)

    def where_position(self, model: str, joint: str) -> str:
        """Return the place where the default position of a joint is declared, for messages.

        Args:
            model: Name of the model instance.
            joint: Name of the joint.
        """
        return self.where()

    @abstractmethod
    def interface(self) -> Interface:
        """Return the signals of the DPS."""

    @abstractmethod
    def make_dps(self) -> System:
        """Return a new data processing system; the same for the testbed, its mental copies and the robot."""

    @abstractmethod
    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        """Add the simulated sensors, system, actuators and environment."""

    def validate(self) -> None:
        """Check the fields; called by `build` and `load_scenario`. Subclasses add their own checks.

        Raises:
            ScenarioError: A value has another type than its field, a number is not finite, or the simulator_config
                cannot be used.
        """
        name = type(self).__name__
        for kind in type(self).__mro__:
            plain = list(get_annotations(kind)) if "__dataclass_fields__" not in vars(kind) else []
            if plain and issubclass(kind, Scenario):
                raise ScenarioError(f"{kind.__name__}.{plain[0]} is no field: decorate {kind.__name__} with @dataclass")
        check_settings(self, error=ScenarioError)
        for key, value in _flat(self):  # Arrays, too.
            if isinstance(value, float) and not math.isfinite(value):
                raise ScenarioError(f"{name}.{key} must be a finite number, not {value}")
        for address, number in self.pedigree.numbers.items():
            if address.startswith(_FIELD) and number.value is not None:
                raise ScenarioError(f"{name}.pedigree gives {address} a value: set the field itself")
        config = self.simulator_config
        if not isinstance(config, SimulatorConfig):
            raise ScenarioError(f"{name}.simulator_config is a SimulatorConfig of Drake, not {config!r}")
        schemes = GetIntegrationSchemes()
        if config.integration_scheme not in schemes:
            raise ScenarioError(
                f"{name}.simulator_config.integration_scheme is one of {', '.join(schemes)}, not "
                f"{config.integration_scheme!r}"
            )
        if config.integration_scheme == "cenic" and not config.use_error_control and FIXED_STEPS_ARE_STALE:
            raise ScenarioError(
                f"{name}.simulator_config: CENIC without error control leaves poses one step behind in Drake "
                f"{DRAKE}; set use_error_control to true, or use Drake 1.58"
            )
        if config.max_step_size <= 0 or config.accuracy <= 0:
            raise ScenarioError(
                f"{name}.simulator_config needs a positive max_step_size and accuracy, not {config.max_step_size} s "
                f"and {config.accuracy}"
            )
        if config.start_time != 0.0:
            raise ScenarioError(
                f"{name}.simulator_config.start_time must be 0, not {config.start_time} s: a simulation starts at the "
                "time of its Context, which you can set"
            )

    def build(self, *, mode: str = "sim", meshcat: Meshcat | None = None, prefix: str = "") -> VirtualTestbed:
        """Build a new testbed.

        Args:
            mode: Initial position of the switches: ``sim``, ``shadow``, ``real`` or ``twin``.
            meshcat: Draws the simulated world while it runs.
            prefix: Path in Meshcat under which the world is drawn; ``visualizer`` by default.

        Raises:
            ScenarioError: A field has a value with which no testbed can be built.
            SignalError: The signals of DPS and world do not match.
            RuntimeError: Drake rejects what is built; a failed assertion in it, which would end the process, too.
        """
        self.validate()
        scenario = copy.deepcopy(self)  # The caller may change this one afterwards.
        builder = VirtualTestbedBuilder(scenario.interface(), simulator_config=scenario.simulator_config)
        builder.place_of = scenario.where_position
        try:
            builder.set_dps(scenario.make_dps())
            scenario.add_world(builder)
            return builder.build(mode=mode, scenario=scenario, meshcat=meshcat, prefix=prefix)
        except SystemExit as error:
            raise RuntimeError(f"{self!r} cannot be built: {error}") from error

    def mental(self) -> Scenario:
        """Return the scenario that the robot simulates when it reasons; by default this scenario itself.

        A mental scenario may differ in its world (another integrator, the terrain of an a-priori map, no cameras) and
        in the periods of its sensors and of its DPS. Its DPS has the same systems, with state and parameters of the
        same sizes, because it continues from the state of the running one.
        """
        return self

    def deployment(self) -> Deployment:
        """Return a new deployment: how the DPS runs on its machine; the default has no protocol."""
        return upper_layers.Deployment()

    def hand_command(self) -> HandCommand | None:
        """Return the command by which a hand in virtual reality leads a robot, or None if no command takes it."""
        return None

    def deploy(
        self, url: str, *, record: str | os.PathLike[str] | None = None, **options: Any
    ) -> AbstractContextManager[Runtime]:
        """Connect the DPS to its machine, for the time of a ``with`` block.

        For example::

            with scenario.deploy("tcpq://127.0.0.1:7700", record="arm.lcm") as runtime:
                runtime.take_over()
                runtime.run(seconds=5.0)

        The block begins when the processes of slow parts and recorder are ready: no result and no cycle is missed.
        The DPS runs without its simulated world, and commands from `Runtime.take_over` on. At the end of the block, the
        fallbacks command for a while (see `Runtime.leave`), and the connection is closed. In the block, SIGTERM and
        SIGHUP raise KeyboardInterrupt, unless the program handles them: they end the block as Ctrl-C does. Sent to the
        whole process group, they end the loop first, and then its processes: the log holds the last commands. A loop
        that runs in another thread is stopped at the end.

        Args:
            url: The URL of the LCM bus.
            record: A new file in which the loop is recorded, for `vtbdrake.replay`.
            options: Further keyword arguments:

                * ``target`` (VirtualTestbed or DpsAlone): the diagram to run, for instance the whole testbed; by
                  default a new DPS alone.
                * ``context`` (Context): the state of the target to continue from.
                * ``start`` (Snapshot): a snapshot to continue from.
                * ``values`` (mapping of address to value): variables to set before the first cycle.
                * ``deployment`` (Deployment): replaces the scenario's.
                * ``live`` (bool): serve ``vtbdrake get``, ``set``, ``watch`` and ``reset``; False by default.
                * ``claim`` (bool): ask the hub for protected channels whose owner has fallen silent; False by default.
                * ``clock``, ``watchers``, ``statistics``: see `Runtime`.

        Raises:
            DeploymentError: The DPS cannot run safely on its machine.
            ProtocolError: The deployment has no protocol, or it does not fit the signals.
            BridgeError: There is no bus at this URL.
            ProcessStartError: The process of a slow part, or of the recorder, does not start.
            RecordingError: At the end of the block: the log lacks cycles.
        """
        return upper_layers.deploy(self, url, record=record, **options)

    def name(self) -> str:
        """Return ``package.module:Class``."""
        return class_name(type(self))

    def record(self) -> dict[str, Any]:
        """Return the identity of the scenario as plain data: its name and all fields, nested ones by dotted names."""
        left_out = {*self._PLACES, "pedigree"}
        values = {FILE_KEYS.get(key, key): value for key, value in _values(self).items() if key not in left_out}
        flat = {key: value for key, value in _flat(values) if key not in _NO_IDENTITY}
        return {"scenario": self.name(), **flat, **self.pedigree.values}

    def order_differences(self, record: Mapping[str, Any], *, where: str) -> list[str]:
        """Return the differences in the order of dictionaries, which signals follow, from a `record`, as phrases.

        ``where`` tells where the record comes from.

        Args:
            record: A `record` of a scenario of this class.
            where: Where the record comes from, for the phrases.
        """
        return [
            f"{name}: {', '.join(theirs)} {where}, {', '.join(entries)} here"
            for name, entries in _dictionaries(self)
            if (theirs := _recorded_order(record, name, entries)) != list(entries)
        ]

    def take_order(self, record: Mapping[str, Any]) -> None:
        """Bring the entries of all dictionaries into the order of a `record` of this scenario."""
        for name, entries in _dictionaries(self):
            ordered = {key: entries[key] for key in _recorded_order(record, name, entries)}
            entries.clear()
            entries.update(ordered)

    def numeric_fields(self) -> dict[str, float]:
        """Return the fields that are numbers, nested ones by dotted names, without the integrator's fields."""
        values = {name: getattr(owner, name.rpartition(".")[2]) for name, owner, _ in _plain_fields(self)}
        return {
            name: value
            for name, value in values.items()
            if type(value) in (int, float) and not name.startswith(("simulator_config.", "pedigree."))
        }

    def with_fields(self, values: Mapping[str, Any]) -> Self:
        """Return a copy in which some fields have other values.

        Args:
            values: Values by field, nested ones by dotted names (``simulator_config.accuracy``). Only fields that are a
                bool, int, float or str can be set, to None if their type allows it; an int will do for a float, and
                numpy's scalars for Python's.

        Raises:
            ScenarioError: There is no such field, the value has another type, or the scenario rejects it.
        """
        changed = copy.deepcopy(self)
        owners = {name: (owner, annotation) for name, owner, annotation in _plain_fields(changed)}
        for name, value in values.items():
            if name not in owners:
                near = suggestion(name, owners)
                raise ScenarioError(f"{type(self).__name__} has no field {name!r} of a plain type{near}")
            owner, annotation = owners[name]
            types = plain_types(annotation)
            if value is None and NoneType in alternatives(annotation):
                types = (*types, NoneType)
            check_value(f"{type(self).__name__}.{name}", value, Union[types], error=ScenarioError)  # noqa: UP007
            if isinstance(value, np.generic | np.ndarray):
                value = value.item()
            if type(value) is int and int not in types:
                value = float(value)
            setattr(owner, name.rpartition(".")[2], value)
        changed.validate()
        return changed

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """Return a copy whose testbeds begin with some other values.

        Args:
            values: Values by address of a variable or of an entry of one, or by ``scenario.<field>``: one of `samples`,
                say. Arrays are given entry by entry.

        Raises:
            ScenarioError: As in `with_fields`, or a value is no finite number.
        """
        fields = {a.removeprefix(_FIELD): value for a, value in values.items() if a.startswith(_FIELD)}
        changed = self.with_fields(fields)
        for address, value in values.items():
            if not address.startswith(_FIELD):
                number = changed.pedigree.numbers.get(address, Number())
                changed.pedigree.numbers[address] = replace(number, value=float(value))
        changed.validate()
        return changed

    def samples(self, count: int, *, seed: int = 0, disturbances: bool = True) -> list[dict[str, float]]:
        """Return samples of the numbers that were calibrated, as they vary together: address -> value.

        They are conditions of a `Problem`, values for `VirtualTestbed.write`, and other scenarios by `with_values`.
        Every sample of an inertia is one of a body. Combinations that the recordings did not tell keep their estimate.

        The recordings also show how far a machine departs from the model with the right numbers: so each sample lets
        the scenario's `JointDrives` disturb their joints at random, with the deviation and the correlation time of the
        calibration, and a seed. What is predicted with samples is then as uncertain as it is.

        Args:
            count: Number of samples.
            seed: Determines the samples; the first ones of a larger number are the same.
            disturbances: False: the numbers alone vary, as where a simulated machine has disturbances of its own.

        Raises:
            ScenarioError: Nothing was calibrated.

        Warns:
            UserWarning: The calibration was not accepted.
        """
        if self.pedigree.reasons:
            warnings.warn(
                f"the calibration of {type(self).__name__} was not accepted, and its samples are nearer to each other "
                f"than to the truth: {'; '.join(self.pedigree.reasons)}",
                stacklevel=2,
            )
        return samples(self.pedigree.posterior, count, seed=seed, disturbances=disturbances)

    def save(self, path: str | os.PathLike[str], *, domain: ValidityDomain | None = None) -> None:
        """Write a YAML file that `load_scenario` reads, and the model's validity domain beside it.

        Args:
            path: The file.
            domain: Where the model was compared with recordings; None for none.
        """
        save_scenario(self, path, domain=domain)


def check_is_scenario(value: Any) -> None:
    """Raise a ValueError if ``value`` is not an instance of a scenario: a class, say, or a name."""
    if not isinstance(value, Scenario):
        raise ValueError(f"a scenario is an instance, MyScenario() or load_scenario(name), not {value!r}")


def class_name(scenario: type[Scenario]) -> str:
    """Return ``package.module:Class``, where the module is the one that defines the class."""
    return f"{scenario.__module__}:{scenario.__qualname__}"


def _values(owner: Any) -> dict[str, Any]:
    return {name: getattr(owner, name) for name in field_types(owner)}


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of everything inside."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    elif isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, dict | list | tuple) and not value:
        yield name, None
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _flat(item, f"{name}[{i}]")
    elif isinstance(value, dict) or field_types(value):
        for key, item in (value if isinstance(value, dict) else _values(value)).items():
            yield from _flat(item, f"{name}.{key}".lstrip("."))
    else:
        # One of Drake's configs without fields, such as Rotation.Identity.
        yield name, type(value).__name__ if hasattr(value, "__fields__") else value


def _dictionaries(value: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (dotted name, dictionary) of every dictionary inside, by the names of `_flat`."""
    if isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _dictionaries(item, f"{name}[{i}]")
    elif isinstance(value, dict) or field_types(value):
        if isinstance(value, dict):
            yield name, value
        for key, item in (value if isinstance(value, dict) else _values(value)).items():
            yield from _dictionaries(item, f"{name}.{key}".lstrip("."))


def _recorded_order(record: Mapping[str, Any], name: str, entries: Mapping[str, Any]) -> list[str]:
    """Return the keys of a dictionary in the order of a record; those that it lacks stay at the end."""
    places: dict[str, int] = {}
    for place, recorded in enumerate(record):
        for key in entries:
            if recorded == f"{name}.{key}" or recorded.startswith((f"{name}.{key}.", f"{name}.{key}[")):
                places.setdefault(key, place)
    return sorted(entries, key=lambda key: places.get(key, len(record)))


def _changed_fields(owner: Any) -> str:
    try:
        default = type(owner)()
    except TypeError:  # A field has no default.
        default = None
    shown = []
    for name, value in _values(owner).items():
        if default is None or dict(_flat(value)) != dict(_flat(getattr(default, name))):
            shown.append(f"{name}={_short(value)}")
    return f"{type(owner).__name__}({', '.join(shown)})"


def _short(value: Any) -> str:
    if isinstance(value, Pedigree):
        return repr(value)
    items = list(value.values()) if isinstance(value, dict) else value
    if isinstance(items, list) and any(hasattr(item, "__fields__") for item in items):
        return f"<{len(items)} {type(items[0]).__name__}>"
    return _changed_fields(value) if hasattr(value, "__fields__") else repr(value)


def _drake_types(value: Any) -> Iterator[type]:
    """Yield the types of all of Drake's configs inside."""
    if isinstance(value, Mapping):
        value = list(value.values())
    elif hasattr(type(value), "__fields__") or is_dataclass(value):
        if not is_dataclass(value):
            yield type(value)
        value = list(_values(value).values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from _drake_types(item)


def _refuse_replaced_methods(kind: type[Scenario]) -> None:
    """Raise a ScenarioError if a class has a field or a value under the name of one of this package's methods."""
    annotated = get_annotations(kind)
    for name in {**annotated, **vars(kind)}:
        base = next((base for base in kind.__mro__[1:] if name in vars(base)), object)
        replaced = isinstance(vars(base).get(name), FunctionType | classmethod | staticmethod | property)
        value = vars(kind).get(name)
        is_method = name not in annotated and (callable(value) or hasattr(value, "__get__"))
        if replaced and not is_method and base.__module__.startswith(f"{__package__.partition('.')[0]}."):
            raise ScenarioError(
                f"{kind.__name__}.{name} would replace the method {name} of {base.__name__}: give it another name, "
                f"such as {kind.__name__.lower()}_{name}"
            )


def _make_picklable(value: Any) -> None:
    """Register the types of all of Drake's configs inside with copyreg: they do not pickle by themselves."""
    for kind in set(_drake_types(value)):
        copyreg.pickle(kind, _reduce_config)


def _reduce_config(config: Any) -> tuple[Any, ...]:
    return _make_config, (type(config), _values(config))


def _make_config(kind: type, values: Mapping[str, Any]) -> Any:
    config = kind()
    for name, value in values.items():
        setattr(config, name, value)
    return config


def _plain_fields(owner: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield (dotted name, owner, type) of every field of a plain type, in ``owner`` and in its nested dataclasses."""
    for name, annotation in field_types(owner).items():
        if field_types(value := getattr(owner, name)):
            yield from _plain_fields(value, f"{prefix}{name}.")
        elif plain_types(annotation):
            yield f"{prefix}{name}", owner, annotation
