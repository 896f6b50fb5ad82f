"""YAML files of scenarios, and scenarios by their names ``package.module:Class``."""

from __future__ import annotations

import difflib
import importlib
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from inspect import isabstract
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from vtbdrake.settings import field_types
from vtbdrake.testbed.pedigree import Pedigree
from vtbdrake.testbed.scenario import FILE_KEYS, Scenario, ScenarioError, class_name

if TYPE_CHECKING:
    from vtbdrake.validity_domain import ValidityDomain

S = TypeVar("S", bound=Scenario)
_LARGEST_FILE = 1 << 22  # bytes
_MOST_NODES = 100_000
# Packages that are imported because a file names them: they are installed beside this module.
_OWN = ("vtbdrake", "vtbdrake_diagrams", "builtins", "math", "numpy")
# What lies below the key in a file.
_PEDIGREE = re.compile(r"^  pedigree:\n(?:    .*\n)*", re.MULTILINE)


def load_scenario(source: str | os.PathLike[str]) -> Scenario:
    """Return the scenario that ``source`` names.

    Importing a module runs its code. So no module is imported because a file names it.

    Args:
        source: One of

            * ``package.module:Class``: the scenario with its defaults;
            * ``package.module:Class@FILE``: with the fields of a YAML file;
            * ``package.module:Class@FILE#KEY``: with the fields below one of several keys of the file, as in files of
              Drake's ``hardware_sim``;
            * the YAML file alone, if the class that it names is imported already. For example::

                  vtbdrake_diagrams.space_climber:SpaceClimberScenario:
                    gravity: 3.71

    Raises:
        ScenarioError: The class, file or key does not exist, a key of the file is unknown or occurs twice, or a value
            has the wrong type or is rejected by the scenario.
    """
    text = os.fspath(source)
    name, at, file = text.partition("@")
    if not (at and ":" in name):  # A file may have any name.
        name, file = "", text
    file, key = file_and_key(file)
    is_file = file.endswith((".yaml", ".yml"))
    if name and not is_file:
        raise ScenarioError(f"after package.module:Class@ comes the name of a .yaml file, not {file!r}")
    scenario = _load_yaml(Path(file), name, key) if is_file else scenario_class(text)()
    scenario.validate()
    return scenario


def scenario_of_text(name: str, text: str) -> Scenario:
    """Return the scenario ``package.module:Class`` with the fields of a text that `scenario_text` has returned.

    Raises:
        ScenarioError: As in `load_scenario`.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.yaml"
        path.write_text(text, "utf-8")
        return load_scenario(f"{name}@{path}")


def scenario_text(scenario: Scenario) -> str:
    """Return the text of the file that `save_scenario` writes.

    Raises:
        ScenarioError: A field is of a type that no file can hold.
    """
    resolve_types(type(scenario))
    try:
        text = yaml_dump_typed(scenario, child_name=scenario.name())
    except Exception:
        for item in fields(scenario):
            try:
                yaml_dump_typed({"": getattr(scenario, item.name)}, schema=dict[str, item.type])  # type: ignore[name-defined]
            except Exception as error:
                raise ScenarioError(
                    f"no file can hold {type(scenario).__name__}.{item.name}, a {_type_name(item.type)}: make it of "
                    "numbers, texts, lists, dictionaries, dataclasses of them and Drake's configs"
                ) from error
        raise
    # A file without a pedigree is one that hardware_sim reads, too.
    return text if scenario.pedigree != Pedigree() else _PEDIGREE.sub("", text)


def file_and_key(source: str) -> tuple[str, str]:
    """Return the parts of ``FILE#KEY``; the key is empty without one. A file that exists may have any name."""
    file, _, key = source.partition("#") if not Path(source).exists() else (source, "", "")
    return file, key


def save_scenario(scenario: Scenario, path: str | os.PathLike[str], *, domain: ValidityDomain | None = None) -> None:
    """Write a YAML file that `load_scenario` reads.

    Args:
        scenario: The scenario.
        path: The file.
        domain: The validity domain of its model: it gets a file beside, NAME.domain.json, which the pedigree names.

    Raises:
        ScenarioError: A field is of a type that no file can hold.
    """
    if domain is not None:
        file = Path(path).with_suffix(".domain.json")
        domain.save(file)
        scenario.pedigree.domain = file.name
    Path(path).write_text(scenario_text(scenario))


def _type_name(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) and not get_args(kind) else str(kind)


def scenario_class(name: str) -> type[Scenario]:
    """Return the class ``package.module:Class``; its module is imported, which runs its code.

    Raises:
        ScenarioError: There is no such class, or its module cannot be imported.
    """
    module_name, _, class_ = name.partition(":")
    if not module_name or not class_:
        raise ScenarioError(f"a scenario is named package.module:Class, or by a .yaml file, not {name!r}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
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
        raise ScenarioError(f"{module_name} has no scenario {class_!r}; it has: {', '.join(alternatives) or 'none'}")
    return kind


def is_imported(name: str) -> bool:
    """Return whether the module of the scenario ``package.module:Class`` is imported in this process."""
    return name.partition(":")[0] in sys.modules


def is_trusted(name: str, *, trusted: Sequence[str] = ()) -> bool:
    """Return whether the module of ``package.module:name`` may be imported because a file names it.

    Importing a module runs its code. So it must be imported already, or one of vtbdrake's or of those in ``trusted``,
    which are modules, or packages of them.
    """
    module = name.partition(":")[0]
    if module in sys.modules and module != "__main__":
        return True
    return any(module == each or module.startswith(f"{each}.") for each in (*_OWN, *trusted))


def scenario_of(record: Mapping[str, Any], *, base: Scenario | None = None) -> Scenario:
    """Return the scenario of a `Scenario.record`, such as that of a snapshot.

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
        raise ScenarioError(f"the record is not that of {base.name()}, but of {name or 'a bare Diagram'}")
    present = base.record()
    fields_by_key = {key: field for field, key in FILE_KEYS.items()}
    changed = {}
    for key, value in record.items():
        if key != "scenario" and present.get(key) != value:
            head, dot, rest = key.partition(".")
            changed[f"{fields_by_key.get(head, head)}{dot}{rest}"] = value
    scenario = base.with_fields(changed)
    if scenario.record() != dict(record):
        raise ScenarioError(f"the record is not that of {name} with today's code: name the scenario with its file")
    return scenario


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
    return _filled(schema.blank(), content, path, name)


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
    """Yield (dotted name, line, counted from 1) of keys and of the entries of lists, which have numbers."""
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
    """Rename the keys of older files to those of the fields."""
    keys = field_types(schema)
    renamed = {old: new for new, old in FILE_KEYS.items() if new in keys and old not in keys}
    for key, _ in content.value if isinstance(content, yaml.MappingNode) else []:
        key.value = renamed.get(key.value, key.value)


def resolve_types(schema: type) -> None:
    """Replace the names of the types of a dataclass by types, also in the dataclasses of its fields."""
    # Drake's reader needs types; `from __future__ import annotations` leaves their names.
    hints = get_type_hints(schema)
    for item in fields(schema):
        item.type = hints[item.name]
        for part in _parts(item.type):
            if isinstance(part, type) and is_dataclass(part):
                resolve_types(part)


def _parts(hint: Any) -> Iterator[Any]:
    """Yield a type and its parts: for list[Rock] | None also list[Rock], Rock and None."""
    yield hint
    for argument in get_args(hint):
        yield from _parts(argument)


def _check_nodes(document: yaml.Node | None, path: Path) -> None:
    """Refuse keys that occur twice, and aliases that expand to very many nodes."""
    waiting, count = [document], 0
    while waiting:
        node = waiting.pop()
        count += 1
        if count > _MOST_NODES:
            raise ScenarioError(f"{path} has more than {_MOST_NODES} entries, with aliases expanded")
        if isinstance(node, yaml.MappingNode):
            # Of two equal keys, YAML readers silently keep the last.
            keys = [str(key.value) for key, _ in node.value]
            if len(set(keys)) < len(keys):
                twice = next(key for key in keys if keys.count(key) > 1)
                lines = [str(key.start_mark.line + 1) for key, _ in node.value if str(key.value) == twice]
                raise ScenarioError(f"{path} has the key {twice!r} twice, in lines {' and '.join(lines)}: remove one")
            waiting += [value for _, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value


def refuse_unknown(node: yaml.Node, hint: Any, name: str = "") -> None:
    """Refuse keys that are no field of the expected class.

    Args:
        node: The content of a file.
        hint: The expected type, of which `resolve_types` has made the dataclasses ready.
        name: The name of the field that has this content.

    Raises:
        ScenarioError: There is such a key.
    """
    alternatives = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    inside: Any = tuple(part for alternative in alternatives for part in get_args(alternative))
    inside = Union[inside] if inside else Any  # noqa: UP007
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            refuse_unknown(item, inside, name)
        return
    if not isinstance(node, yaml.MappingNode):
        return
    # A tag chooses one of several classes; the first one needs no tag.
    classes = [p for p in alternatives if isinstance(p, type) and (field_types(p) or hasattr(p, "__fields__"))]
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
            near = difflib.get_close_matches(key.value, types, n=1, cutoff=0.5)
            hint_text = f"did you mean {near[0]}?" if near else f"it has: {', '.join(types)}"
            raise ScenarioError(
                f"line {key.start_mark.line + 1}: {expected.__name__} has no field {below!r}; {hint_text}"
            )
