"""YAML files of scenarios, and scenarios by their names ``package.module:Class``."""

from __future__ import annotations

import importlib
import logging
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from inspect import isabstract
from pathlib import Path
from typing import Any, TypeVar, Union, get_args

import yaml
from pydrake.common.yaml import yaml_load_typed

from vtbdrake.common.field_types import alternatives, field_types, resolve_types
from vtbdrake.common.scenario_names import ScenarioNameError, file_name, full_name, importable_name, suggested_scenarios
from vtbdrake.common.suggestions import did_you_mean
from vtbdrake.testbed.scenario import FILE_KEYS, Scenario, class_name
from vtbdrake.testbed.scenario_identity import ScenarioError

_log = logging.getLogger(__name__)

S = TypeVar("S", bound=Scenario)
_LARGEST_FILE = 1 << 22  # bytes
_MOST_NODES = 100_000
# Packages that are imported because a file names them: they are installed beside this module.
_OWN = ("vtbdrake", "vtbdrake_diagrams", "builtins", "math", "numpy")


def load_scenario(source: str | os.PathLike[str]) -> Scenario:
    """Return the scenario that ``source`` names.

    Importing a module runs its code. So no module is imported because a file names it.

    Args:
        source: One of

            * ``package.module:Class``: the scenario with its defaults;
            * ``cart_pole``: the same by a short name, which packages declare as entry points of the group
              ``vtbdrake.scenarios`` (``vtbdrake examples`` lists them);
            * ``folder/file.py:Class``: the class in a file, whose folder (of a package, the folder that holds it) is
              appended to ``sys.path``;
            * ``package.module:Class@FILE``, or one of the others with ``@FILE``: with the fields of a YAML file;
            * ``package.module:Class@FILE#KEY``: with the fields below one of several keys of the file, as in files of
              Drake's ``hardware_sim``;
            * the YAML file alone, if the class that it names is imported already. For example::

                  vtbdrake_diagrams.space_climber:SpaceClimberScenario:
                    gravity: 3.71

    Raises:
        ScenarioError: The class, file or key does not exist, a key of the file is unknown or occurs twice, or a value
            has the wrong type or is rejected by the scenario.
    """
    try:
        text = importable_name(full_name(os.fspath(source)))
    except ScenarioNameError as error:
        raise ScenarioError(str(error)) from error
    name, at, file = text.partition("@")
    if not (at and ":" in name):  # A file may have any name.
        name, file = "", text
    file, key = file_and_key(file)
    is_file = file.endswith((".yaml", ".yml"))
    if name and not is_file:
        raise ScenarioError(f"after package.module:Class@ comes the name of a .yaml file, not {file!r}")
    scenario = _load_yaml(Path(file), name, key) if is_file else _with_defaults(scenario_class(text))()
    scenario.validate()
    if scenario.pedigree.reasons:
        reasons = "; ".join(scenario.pedigree.reasons)
        _log.warning("%s has numbers of a calibration that was not accepted: %s", source, reasons)
    return scenario


def scenario_of_text(name: str, text: str) -> Scenario:
    """Return the scenario ``package.module:Class`` with the fields of a text that `scenario_text` has returned.

    Args:
        name: The name ``package.module:Class``, whose module is imported.
        text: YAML of the fields, as `scenario_text` returns it.

    Raises:
        ScenarioError: As in `load_scenario`.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.yaml"
        path.write_text(text, "utf-8")
        scenario = load_scenario(f"{name}@{path}")
    scenario.forget_origin()
    return scenario


def file_and_key(source: str) -> tuple[str, str]:
    """Return the parts of ``FILE#KEY``; the key is empty without one. A file that exists may have any name."""
    file, _, key = source.partition("#") if not Path(source).exists() else (source, "", "")
    return file, key


def scenario_class(name: str) -> type[Scenario]:
    """Return the class ``package.module:Class``; its module is imported, which runs its code.

    Raises:
        ScenarioError: There is no such class, or its module cannot be imported.
    """
    module_name, _, class_ = name.partition(":")
    if not module_name or not class_:
        near = suggested_scenarios(name) or "; 'vtbdrake examples' lists short names"
        raise ScenarioError(
            f"a scenario is named package.module:Class, file.py:Class, by a file or a short name, not {name!r}{near}"
        )
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if near := suggested_scenarios(name):
            raise ScenarioError(f"cannot import {module_name}: {error}{near}") from error
        raise ScenarioError(
            f"cannot import {module_name}, of the scenario {name}: {error}. Is its folder on the Python path?"
        ) from error
    except Exception as error:
        raise ScenarioError(f"cannot import {module_name}, of the scenario {name}: {error!r}") from error
    kind = getattr(module, class_, None)
    if isinstance(kind, type) and issubclass(kind, Scenario) and isabstract(kind):
        raise ScenarioError(f"{name} is abstract: it lacks the methods {', '.join(sorted(kind.__abstractmethods__))}")
    if not (isinstance(kind, type) and issubclass(kind, Scenario)):
        alternatives = [
            k for k, v in vars(module).items() if isinstance(v, type) and issubclass(v, Scenario) and not isabstract(v)
        ]
        near = did_you_mean(class_, alternatives, count=1)
        raise ScenarioError(
            f"{module_name} has no scenario {class_!r}{near}; it has: {', '.join(alternatives) or 'none'}"
        )
    return kind


def is_imported(name: str) -> bool:
    """Return whether the module of the scenario ``package.module:Class`` is imported in this process."""
    return name.partition(":")[0] in sys.modules


def is_trusted(name: str, *, trusted: Sequence[str] = ()) -> bool:
    """Return whether the module of ``package.module:name`` may be imported because a file names it.

    Importing a module runs its code. So it must be imported already, or one of vtbdrake's or of those in ``trusted``,
    which are modules, or packages of them.

    Args:
        name: The name ``package.module:name`` in the file.
        trusted: Modules that may be imported, or packages of them; by default none but vtbdrake's.
    """
    module = name.partition(":")[0]
    if module in sys.modules and module != "__main__":
        return True
    if file_name(name) is not None or not module.replace(".", "_").isidentifier():
        return False  # The name of a file, which may begin like a module's.
    return any(module == each or module.startswith(f"{each}.") for each in (*_OWN, *trusted))


def scenario_of(record: Mapping[str, Any], *, base: Scenario | None = None) -> Scenario:
    """Return the scenario of a `Scenario.record`, such as a snapshot's.

    Args:
        record: The record.
        base: A scenario of the same class, in which fields of plain types are set; that with the defaults if left out.

    Raises:
        ScenarioError: The class is not vtbdrake's, nor imported already, or the record has a value that cannot be set.
    """
    name = str(record.get("scenario", ""))
    if base is None:
        if not is_trusted(name):
            raise ScenarioError(
                f"it is of {name or 'a bare Diagram'}, and importing a module runs its code: name the "
                "scenario, if you trust it"
            )
        base = load_scenario(name)
    elif base.name() != name:
        raise ScenarioError(f"the record does not belong to {base.name()}, but to {name or 'a bare Diagram'}")
    present = base.record()
    fields_by_key = {key: field for field, key in FILE_KEYS.items()}
    changed = {}
    for key, value in record.items():
        if key != "scenario" and present.get(key) != value:
            head, dot, rest = key.partition(".")
            changed[f"{fields_by_key.get(head, head)}{dot}{rest}"] = value
    scenario = base.with_fields(changed)
    scenario.take_order(record)
    if scenario.record() != dict(record):
        raise ScenarioError(f"the record does not fit {name} with today's code: name the scenario with its file")
    return scenario


_NUMBER_TAGS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
"""The tags that YAML gives to numbers."""

_ANOTHER_BASE = re.compile(r"[-+]?(?:(?P<octal>0[0-9_]+$)|[0-9][0-9_]*(?::[0-5]?[0-9])+)")
"""Numbers of YAML 1.1 that mean something else than they look like: 010 is 8, and 1:30 is 90."""


def compose_yaml(
    path: Path, *, kind: str = "scenario", loader: type[yaml.SafeLoader] = yaml.SafeLoader
) -> yaml.Node | None:
    """Return the nodes of a file of YAML, in which no key occurs twice; None if it is empty.

    Args:
        path: The file.
        kind: A word for the file in messages.
        loader: The class that recognizes numbers.

    Raises:
        ScenarioError: The file does not exist, is too large, or is not YAML.
    """
    if not path.exists():
        raise ScenarioError(f"there is no {kind} file {path}")
    if not path.is_file() or path.stat().st_size > _LARGEST_FILE:
        raise ScenarioError(f"{path} is no file of YAML, or larger than {_LARGEST_FILE} bytes")
    try:
        document = yaml.compose(path.read_text(), Loader=loader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ScenarioError(f"{path} is not YAML: {error}") from error
    _check_nodes(document, path)
    return document


def _load_yaml(path: Path, named: str, key: str) -> Scenario:
    """Return the scenario of a file.

    Args:
        path: The file.
        named: The class that the user has named; empty if only the file names it.
        key: The top-level key of the scenario; empty if there is only one.
    """
    name, content = _scenario_node(path, key)
    if named and ":" in name and name not in (named, class_name(expected := scenario_class(named))):
        raise ScenarioError(f"{path} is of the scenario {name}, not of {class_name(expected)}")
    if not named and ":" in name and not is_imported(name):
        raise ScenarioError(
            f"{path} names the scenario {name}, and to import its module runs its code: if that is what you want, "
            f"name it as {name}@{path}, or import it first"
        )
    try:
        schema = scenario_class(named or name)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from error
    return _filled(_with_defaults(schema).blank(), content, path, name)


def _with_defaults(schema: type[Scenario]) -> type[Scenario]:
    """Return a class of scenarios; raise a ScenarioError if a field has no default."""
    for item in fields(schema):
        if item.init and item.default is MISSING and item.default_factory is MISSING:
            raise ScenarioError(
                f"{schema.__name__}.{item.name} has no default: give it one, which files and the command line replace"
            )
    return schema


def read_fields(scenario: S, path: Path, key: str = "") -> S:
    """Return a copy of ``scenario`` with the fields below a top-level key of a YAML file; see `load_scenario`.

    Args:
        scenario: The scenario whose fields keep their values where the file gives none.
        path: The file.
        key: The key; empty if there is only one.
    """
    name, content = _scenario_node(path, key)
    return _filled(scenario, content, path, name)


def _scenario_node(path: Path, key: str) -> tuple[str, yaml.Node]:
    """Return the top-level key of the scenario in a file, and what lies below it."""
    document = compose_yaml(path)
    if not isinstance(document, yaml.MappingNode) or (
        not key and (len(document.value) != 1 or isinstance(document.value[0][1], yaml.ScalarNode))
    ):
        raise ScenarioError(
            f"{path} must have one key, package.module:Class, with the scenario's fields below it, or name the key "
            f"as {path}#KEY"
        )
    contents = {str(node.value): content for node, content in document.value}
    if key and key not in contents:
        raise ScenarioError(f"{path} has no key {key!r}; it has: {', '.join(contents) or 'none'}")
    name = key or next(iter(contents))
    return name, contents[name]


def _filled(scenario: S, content: yaml.Node, path: Path, name: str) -> S:
    """Return a copy of ``scenario`` with the fields of a YAML node."""
    schema = type(scenario)
    try:
        resolve_types(schema)
        _use_new_keys(content, schema)
        refuse_unknown(content, schema)
        filled: S = yaml_load_typed(schema=schema, data=yaml.serialize(content), defaults=scenario)
    except (RuntimeError, TypeError, ValueError, AssertionError) as error:
        if isinstance(error, ScenarioError):
            raise ScenarioError(f"{path}: {error}") from error
        raise ScenarioError(f"{path} does not fit {name}: {error}") from error
    filled.set_origin(str(path.absolute()), dict(lines_by_name(content)))
    return filled


def lines_by_name(node: yaml.Node | None, name: str = "") -> Iterator[tuple[str, int]]:
    """Yield (dotted name, line, counted from 1) of keys and of the entries of lists, which have numbers.

    Args:
        node: A node of the YAML file; None, or a scalar, has no keys.
        name: The dotted name of ``node``, which begins every name; empty by default, for the outermost node.
    """
    entries: list[tuple[str, yaml.Node, yaml.Node]] = []
    if isinstance(node, yaml.MappingNode):
        entries = [(str(key.value), key, value) for key, value in node.value]
    elif isinstance(node, yaml.SequenceNode):
        entries = [(str(index), value, value) for index, value in enumerate(node.value)]
    for key, place, value in entries:
        below = f"{name}.{key}".lstrip(".")
        yield below, place.start_mark.line + 1
        yield from lines_by_name(value, below)


def _use_new_keys(content: yaml.Node, schema: type[Scenario]) -> None:
    """Rename the keys of older files to the names of the fields."""
    keys = field_types(schema)
    renamed = {old: new for new, old in FILE_KEYS.items() if new in keys and old not in keys}
    for key, _ in content.value if isinstance(content, yaml.MappingNode) else []:
        key.value = renamed.get(key.value, key.value)


def _check_nodes(document: yaml.Node | None, path: Path) -> None:
    """Refuse keys that occur twice, and aliases that expand to very many nodes."""
    waiting, count = [document], 0
    while waiting:
        node = waiting.pop()
        count += 1
        if count > _MOST_NODES:
            raise ScenarioError(f"{path} has more than {_MOST_NODES} entries, with aliases expanded")
        if isinstance(node, yaml.MappingNode):
            # YAML readers silently keep the last of two equal keys.
            keys = [str(key.value) for key, _ in node.value]
            if len(set(keys)) < len(keys):
                twice = next(key for key in keys if keys.count(key) > 1)
                lines = [str(key.start_mark.line + 1) for key, _ in node.value if str(key.value) == twice]
                raise ScenarioError(f"{path} has the key {twice!r} twice, in lines {' and '.join(lines)}: remove one")
            waiting += [value for _, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value
        elif (
            isinstance(node, yaml.ScalarNode)
            and node.tag in _NUMBER_TAGS
            and (number := _ANOTHER_BASE.match(node.value))
        ):
            base = "8" if number["octal"] else "60"
            raise ScenarioError(
                f"{path}: line {node.start_mark.line + 1}: {node.value} is a number to the base {base} in YAML: write "
                "it to the base 10, or in quotes if it is a text"
            )


def refuse_unknown(node: yaml.Node, hint: Any, name: str = "") -> None:
    """Refuse keys that are no field of the expected class.

    Args:
        node: The content of a file.
        hint: The expected type.
        name: The name of the field that has this content.

    Raises:
        ScenarioError: There is such a key.
    """
    kinds = alternatives(hint)
    inside: Any = tuple(part for alternative in kinds for part in get_args(alternative))
    inside = Union[inside] if inside else Any  # noqa: UP007
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            refuse_unknown(item, inside, name)
        return
    if not isinstance(node, yaml.MappingNode):
        return
    # A tag chooses one of several classes; the first one needs no tag.
    classes = [p for p in kinds if isinstance(p, type) and (field_types(p) or hasattr(p, "__fields__"))]
    expected = next((part for part in classes if node.tag == f"!{part.__name__}"), classes[0] if classes else None)
    if len(classes) > 1 and node.tag.startswith("!") and expected and node.tag != f"!{expected.__name__}":
        tags = ", ".join(f"!{part.__name__}" for part in classes)
        raise ScenarioError(f"line {node.start_mark.line + 1}: {name} is one of {tags}, not {node.tag}")
    types = field_types(expected)
    for key, value in node.value:
        below = f"{name}.{key.value}".lstrip(".")
        if expected is None:  # A dict, say.
            refuse_unknown(value, inside, below)
        elif key.value == "<<":  # Keys merged from elsewhere in the file.
            for merged in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                refuse_unknown(merged, expected, name)
        elif key.value in types:
            refuse_unknown(value, types[key.value], below)
        else:
            near = did_you_mean(key.value, types, count=1, cutoff=0.5) or f"; it has: {', '.join(types)}"
            raise ScenarioError(f"line {key.start_mark.line + 1}: {expected.__name__} has no field {below!r}{near}")
