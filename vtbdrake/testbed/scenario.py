"""Scenarios: plain data that builds a testbed, in this process or in another, from Python or from YAML."""

from __future__ import annotations

import copy
import difflib
import importlib
import math
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from importlib.metadata import version
from inspect import isabstract
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, Self, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.systems.analysis import GetIntegrationSchemes
from pydrake.systems.framework import System

from vtbdrake.state.variables import suggestion
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.config import SimulatorFields
from vtbdrake.testbed.signal import Interface
from vtbdrake.testbed.testbed import VirtualTestbed

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

# Seen with 1.51.1, and not with 1.58: after a fixed step of CENIC, poses and contact results are those before it.
_DRAKE = version("drake")
_CENIC_IS_FRESH = tuple(int(part) for part in _DRAKE.split(".")[:2]) >= (1, 58)

_LARGEST_FILE = 1 << 22  # bytes
_MOST_NODES = 100_000


class ScenarioError(ValueError):
    """A scenario that cannot be found, read or built."""


@dataclass
class Scenario(ABC):
    """A dataclass of plain types, with a default for every field, that builds a testbed.

    A subclass adds its fields and says what the interface of the DPS is, what the DPS is, and what the simulated
    world is. What sits in the Context (masses, gains, poses) is a variable of the testbed; what needs another Diagram
    (geometry, gravity, a time step) is a field.

    When a study varies a field, a testbed is built for each value. Python's garbage collector frees those that are not
    used any more if every system in Python has ``__slots__ = NO_DICT``, and gives its output ports ``weakly(self,
    Class._calc)`` instead of the bound method; see `vtbdrake.state.collectable`. The others stay until their process
    ends: `ProcessExecutor` replaces a worker that has grown too much, while serial rollouts and threads keep them.
    """

    simulator: SimulatorFields = field(default_factory=SimulatorFields)

    @abstractmethod
    def interface(self) -> Interface:
        """The DPS's signals."""

    @abstractmethod
    def make_dps(self) -> System:
        """The data processing system; the same for the testbed, its mental copies and the robot."""

    @abstractmethod
    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        """Adds the simulated sensors, system, actuators and environment."""

    def validate(self) -> None:
        """Looks at the values as they are when the testbed is built.

        Raises:
            ScenarioError: a value is of another type than its field, a number is not finite, or the integration scheme
                is unknown. Subclasses add their own.
        """
        for name, owner, kinds in _scalar_fields(self):
            value = getattr(owner, name.rpartition(".")[2])
            if value is not None:  # A field that may be None has a type like float | None.
                _scalar(value, kinds, f"{type(self).__name__}.{name}")
        for name, value in _flat(asdict(self)):
            if isinstance(value, float) and not math.isfinite(value):
                raise ScenarioError(f"{type(self).__name__}.{name} must be finite, not {value}")
        known = GetIntegrationSchemes()
        if self.simulator.integration_scheme not in known:
            raise ScenarioError(
                f"{type(self).__name__}.simulator.integration_scheme is one of {', '.join(known)}, not "
                f"{self.simulator.integration_scheme!r}"
            )
        if (
            self.simulator.integration_scheme == "cenic"
            and not self.simulator.use_error_control
            and not _CENIC_IS_FRESH
        ):
            raise ScenarioError(
                f"{type(self).__name__}.simulator: CENIC without error control leaves poses one step behind in Drake "
                f"{_DRAKE}; set use_error_control to true, or use Drake 1.58"
            )
        if self.simulator.max_step_size <= 0 or self.simulator.accuracy <= 0:
            raise ScenarioError(
                f"{type(self).__name__}.simulator takes a positive max_step_size and accuracy, not "
                f"{self.simulator.max_step_size} s and {self.simulator.accuracy}"
            )

    def build(self, *, mode: str = "sim", meshcat: Meshcat | None = None, prefix: str = "") -> VirtualTestbed:
        """A new testbed.

        Args:
            mode: where the switches stand at first: sim, shadow, real or twin.
            meshcat: draws the simulated world while it runs, under ``prefix``.

        Raises:
            ScenarioError: a field has a value that no testbed can be built with.
            SignalError: the signals of DPS and world do not fit.
        """
        self.validate()
        own = copy.deepcopy(self)  # A scenario that is changed afterwards is another one.
        builder = VirtualTestbedBuilder(own.interface(), simulator=own.simulator)
        builder.set_dps(own.make_dps())
        own.add_world(builder)
        return builder.build(mode=mode, scenario=own, meshcat=meshcat, prefix=prefix)

    def name(self) -> str:
        """``package.module:Class``."""
        return class_name(type(self))

    def record(self) -> dict[str, Any]:
        """What identifies it, as plain data: its name and all fields, nested ones by dotted names."""
        return {"scenario": self.name(), **dict(_flat(asdict(self)))}

    def with_fields(self, values: Mapping[str, Any]) -> Self:
        """A copy in which some fields have other values; nested ones by dotted names (``simulator.accuracy``).

        Fields that are a bool, int, float or str can be given; an int will do for a float, and numpy's scalars for
        Python's.

        Raises:
            ScenarioError: there is no such field, the value is of another type, or the scenario refuses it.
        """
        changed = copy.deepcopy(self)
        known = {name: (owner, kinds) for name, owner, kinds in _scalar_fields(changed)}
        for name, value in values.items():
            if name not in known:
                near = suggestion(f"scenario.{name}", [f"scenario.{k}" for k in known])
                raise ScenarioError(f"{type(self).__name__} has no field {name!r} of a plain type{near}")
            owner, kinds = known[name]
            setattr(owner, name.rpartition(".")[2], _scalar(value, kinds, f"{type(self).__name__}.{name}"))
        changed.validate()
        return changed

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a YAML file that `load_scenario` reads."""
        _resolve_types(type(self))
        Path(path).write_text(yaml_dump_typed(self, child_name=self.name()))


def load_scenario(source: str | os.PathLike[str]) -> Scenario:
    """Return the scenario that ``source`` names.

    Args:
        source: ``package.module:Class``; ``package.module:Class@FILE``, where FILE is a YAML file with its fields; or
            the file alone, if the class that it names is imported already. The file looks like ::

                diagrams.space_climber:SpaceClimberScenario:
                  gravity: 3.71

            To import a module runs its code. So no module is imported because a file names it.

    Raises:
        ScenarioError: the class or file does not exist, a key of the file is unknown or occurs twice, or a value has
            the wrong type or is refused by the scenario.
    """
    text = os.fspath(source)
    name, at, file = text.partition("@")
    if not (at and ":" in name):  # A file may have any name.
        name, file = "", text
    is_file = file.endswith((".yaml", ".yml"))
    if name and not is_file:
        raise ScenarioError(f"after package.module:Class@ comes the name of a .yaml file, not {file!r}")
    scenario = _load_yaml(Path(file), name) if is_file else scenario_class(text)()
    scenario.validate()
    return scenario


def scenario_class(name: str) -> type[Scenario]:
    """Return the scenario ``package.module:Class``; its module is imported, which runs its code.

    Raises:
        ScenarioError: there is no such, or its module cannot be imported.
    """
    module_name, _, class_name = name.partition(":")
    if not module_name or not class_name:
        raise ScenarioError(f"a scenario is named package.module:Class, or by a .yaml file, not {name!r}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ScenarioError(
            f"cannot import {module_name}, of the scenario {name}: {error}. Is its folder on the Python path?"
        ) from error
    except Exception as error:
        raise ScenarioError(f"cannot import {module_name}, of the scenario {name}: {error!r}") from error
    found = getattr(module, class_name, None)
    if isinstance(found, type) and issubclass(found, Scenario) and isabstract(found):
        raise ScenarioError(f"{name} is no whole scenario: it lacks {', '.join(sorted(found.__abstractmethods__))}")
    if not (isinstance(found, type) and issubclass(found, Scenario)):
        known = [
            k for k, v in vars(module).items() if isinstance(v, type) and issubclass(v, Scenario) and not isabstract(v)
        ]
        raise ScenarioError(f"{module_name} has no scenario {class_name!r}; it has: {', '.join(known) or 'none'}")
    return found


def class_name(scenario: type[Scenario]) -> str:
    """Return ``package.module:Class``, where the module is the one that defines the class."""
    return f"{scenario.__module__}:{scenario.__qualname__}"


def is_imported(name: str) -> bool:
    """Return whether the module of the scenario ``package.module:Class`` is imported in this process."""
    return name.partition(":")[0] in sys.modules


def _load_yaml(path: Path, named: str) -> Scenario:
    """
    Args:
        path: the file.
        named: the scenario that the user says it is of; empty if that is left to the file.
    """
    if not path.exists():
        raise ScenarioError(f"there is no scenario file {path}")
    if not path.is_file() or path.stat().st_size > _LARGEST_FILE:
        raise ScenarioError(f"{path} is no file of YAML, or larger than {_LARGEST_FILE} bytes")
    try:
        document = yaml.compose(path.read_text(), Loader=yaml.SafeLoader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ScenarioError(f"{path} is not YAML: {error}") from error
    if not isinstance(document, yaml.MappingNode) or len(document.value) != 1:
        raise ScenarioError(f"{path} must have one key, package.module:Class, with the scenario's fields below it")
    _check_nodes(document, path)
    name = document.value[0][0].value
    if named and name not in (named, class_name(found := scenario_class(named))):
        raise ScenarioError(f"{path} is of the scenario {name}, not of {class_name(found)}")
    if not named and ":" in name and not is_imported(name):
        raise ScenarioError(
            f"{path} names the scenario {name}, and to import its module runs its code: if that is what you want, "
            f"name it as {name}@{path}, or import it first"
        )
    try:
        schema = scenario_class(named or name)
        _resolve_types(schema)
        _refuse_unknown(document.value[0][1], schema)
        return yaml_load_typed(schema=schema, filename=path, child_name=name)
    except (RuntimeError, TypeError, ValueError, AssertionError) as error:
        if isinstance(error, ScenarioError):
            raise ScenarioError(f"{path}: {error}") from error
        raise ScenarioError(f"{path} does not fit {name}: {error}") from error


def _resolve_types(schema: type) -> None:
    # Drake's reader wants the types of fields; `from __future__ import annotations` leaves their names.
    hints = get_type_hints(schema)
    for item in fields(schema):
        item.type = hints[item.name]
        for part in _parts(item.type):
            if isinstance(part, type) and is_dataclass(part):
                _resolve_types(part)


def _parts(hint: Any) -> Iterator[Any]:
    """A type, and those that it is made of: of list[Rock] | None also list[Rock], Rock and None."""
    yield hint
    for argument in get_args(hint):
        yield from _parts(argument)


def _check_nodes(document: yaml.Node, path: Path) -> None:
    """
    Raises:
        ScenarioError: a key occurs twice, or a few aliases stand for very much.
    """
    waiting, count = [document], 0
    while waiting:
        node = waiting.pop()
        count += 1
        if count > _MOST_NODES:
            raise ScenarioError(f"{path} has more than {_MOST_NODES} entries, those by aliases included")
        if isinstance(node, yaml.MappingNode):
            # Of two equal keys, YAML readers silently keep the last.
            keys = [str(key.value) for key, _ in node.value]
            if len(set(keys)) < len(keys):
                twice = next(key for key in keys if keys.count(key) > 1)
                raise ScenarioError(f"{path} has the key {twice!r} twice, near line {node.start_mark.line + 1}")
            waiting += [value for _, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value


def _refuse_unknown(node: yaml.Node, hint: Any, name: str = "") -> None:
    """
    Args:
        node: what is given for a field.
        hint: the type of that field.
        name: its dotted name.

    Raises:
        ScenarioError: a key is no field of the dataclass that is expected there.
    """
    alternatives = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    inside: Any = tuple(part for alternative in alternatives for part in get_args(alternative))
    inside = Union[inside] if inside else Any  # noqa: UP007
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _refuse_unknown(item, inside, name)
        return
    if not isinstance(node, yaml.MappingNode):
        return
    # Of several dataclasses, a tag names the one that is meant, and the first one needs no tag.
    classes = [part for part in alternatives if isinstance(part, type) and is_dataclass(part)]
    expected = next((part for part in classes if node.tag == f"!{part.__name__}"), classes[0] if classes else None)
    known = {} if expected is None else {item.name: item.type for item in fields(expected)}
    for key, value in node.value:
        below = f"{name}.{key.value}".lstrip(".")
        if expected is None:  # A dict, say.
            _refuse_unknown(value, inside, below)
        elif key.value == "<<":  # Keys that are taken over from elsewhere in the file.
            for merged in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                _refuse_unknown(merged, expected, name)
        elif key.value in known:
            _refuse_unknown(value, known[key.value], below)
        else:
            near = difflib.get_close_matches(key.value, known, n=1, cutoff=0.5)
            hint_text = f"did you mean {near[0]}?" if near else f"it has: {', '.join(known)}"
            raise ScenarioError(
                f"line {key.start_mark.line + 1}: {expected.__name__} has no field {below!r}; {hint_text}"
            )


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict | list | tuple) and not value:
        yield name, None
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, f"{name}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _flat(item, f"{name}[{i}]")
    else:
        yield name, value


_SCALARS: dict[str, type] = {"bool": bool, "int": int, "float": float, "str": str}


def _scalar_fields(owner: Any, prefix: str = "") -> Iterator[tuple[str, Any, tuple[type, ...]]]:
    """Dotted name, owner and types of every field of a plain type, of ``owner`` and of the dataclasses in it."""
    for item in fields(owner):
        value = getattr(owner, item.name)
        if is_dataclass(value):
            yield from _scalar_fields(value, f"{prefix}{item.name}.")
            continue
        # By their names: in another process, those of a class from a notebook cannot be looked up.
        kind = item.type.__name__ if isinstance(item.type, type) else str(item.type)
        names = [part.strip() for part in kind.split("|")]
        kinds = tuple(_SCALARS[part] for part in names if part in _SCALARS)
        if kinds:
            yield f"{prefix}{item.name}", owner, kinds


def _scalar(value: Any, kinds: tuple[type, ...], name: str) -> Any:
    if isinstance(value, np.generic | np.ndarray) and np.ndim(value) == 0:
        value = value.item()
    if type(value) is int and int not in kinds and float in kinds:
        value = float(value)
    if type(value) not in kinds:
        expected = " or ".join(kind.__name__ for kind in kinds)
        raise ScenarioError(f"{name} takes a value of type {expected}, not {value!r} of type {type(value).__name__}")
    return value
