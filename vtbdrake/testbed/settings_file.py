"""YAML files of settings: dataclasses, nested ones too, whose fields a file gives, with errors that name its line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml

from vtbdrake.common.field_types import alternatives, field_types, is_dataclass_type
from vtbdrake.common.scenario_names import file_name, full_name
from vtbdrake.common.settings import check_settings
from vtbdrake.testbed.scenario_file import compose_yaml, lines_by_name, refuse_unknown
from vtbdrake.testbed.scenario_identity import ScenarioError

T = TypeVar("T")
# The name of an entry in a message: criteria[a], or qualities[0].
_ENTRY = re.compile(r"\[([^\]\s]+)\]")


class Lines:
    """The lines of a file, by the dotted names of its keys, and by addresses and other texts with a dot or a colon.

    Args:
        path: The file.
        node: Its content.
        kind: The name of the class that has its keys as fields.
    """

    def __init__(self, path: Path = Path(), node: yaml.Node | None = None, kind: str = "") -> None:
        self._path = path
        self._names = dict(lines_by_name(node))
        self._texts: dict[str, int] = {f"{kind}.{name}": line for name, line in self._names.items()}
        for text, line in [*self._names.items(), *_texts(node)]:
            if "." in text or ":" in text:
                self._texts.setdefault(text, line)

    @contextmanager
    def at(self, name: str) -> Iterator[None]:
        """Give the errors of a block the line of a dotted name, unless they have one."""
        try:
            yield
        except (ValueError, OSError) as error:
            if name not in self._names or str(error).startswith("line "):
                raise
            raise ValueError(f"line {self._names[name]}: {error}") from error

    def message(self, error: object) -> str:
        """Return an error with the file, and its line or the line of the first text of the file that it mentions."""
        text = str(error)
        if text.startswith("line "):
            return f"{self._path}: {text}"
        mentioned = _ENTRY.sub(r".\1", text).partition("did you mean")[0]
        places = [(mentioned.find(name), -len(name), line) for name, line in self._texts.items() if name in mentioned]
        if (key := text.partition(" ")[0]) in self._names:
            places.append((0, -len(key), self._names[key]))
        line = f"line {min(places)[2]}: " if places else ""
        return f"{self._path}: {line}{text}"


def _texts(node: yaml.Node | None) -> Iterator[tuple[str, int]]:
    """Yield (text, line) of keys and values that are texts."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield str(key.value), key.start_mark.line + 1
            yield from _texts(value)
    elif isinstance(node, yaml.SequenceNode):
        for entry in node.value:
            yield from _texts(entry)
    elif node is not None and node.tag.endswith(":str"):
        yield str(node.value), node.start_mark.line + 1


def read_settings(kind: type[T], path: Path, *, noun: str, example: str, error: type[ValueError]) -> tuple[T, Lines]:
    """Return a dataclass with the fields of a file, checked as `check_settings` does, and the file's lines.

    Args:
        kind: The class; all its fields have defaults.
        path: The file.
        noun: A word for what the file states, in messages.
        example: Some of its keys, in messages.
        error: The class of the errors.

    Raises:
        ValueError: The file does not exist or is not YAML, or a key or value in it is not possible.
    """
    try:
        node = compose_yaml(path, kind=noun, loader=Loader)
    except ScenarioError as cause:
        raise error(str(cause)) from cause
    if not isinstance(node, yaml.MappingNode):
        raise error(f"{path}: its content is no mapping: it has keys such as {example}")
    lines = Lines(path, node, kind.__name__)
    try:
        refuse_unknown(node, kind)
        config: T = _typed(kind, Loader("").construct_document(node), "", error)
        check_settings(config, error=error)
    except (ValueError, yaml.YAMLError) as cause:
        raise error(lines.message(cause)) from cause
    return config, lines


def scenario_beside(path: Path, scenario: str) -> str:
    """Return the name of a scenario that a file names; a file of the scenario is looked for beside that file.

    A short name becomes ``package.module:Class``, whose module has to be trusted.

    Args:
        path: The file that names the scenario.
        scenario: The name in it: ``package.module:Class``, or a short one, with ``@file.yaml`` behind it for a file.

    Raises:
        ScenarioError: It is named by its Python file.
    """
    if (module := file_name(scenario)) is not None:
        raise ScenarioError(f"a file names a scenario as package.module:Class, not {scenario}: try {module.stem}:CLASS")
    name, at, file = full_name(scenario).partition("@")
    beside = path.parent / file.partition("#")[0]
    return f"{name}@{path.parent / file}" if at and beside.exists() else f"{name}{at}{file}"


class Loader(yaml.SafeLoader):
    """Reads 1e-3 as a number, as YAML 1.2 and JSON do, and keys as texts: no, on and 010 are names as they stand."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the content of a mapping, with the texts of its keys.

        Args:
            node: The mapping.
            deep: Whether its values are constructed at once.
        """
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                key.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep)


Loader.yaml_implicit_resolvers = {key: [*rows] for key, rows in yaml.SafeLoader.yaml_implicit_resolvers.items()}
Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+"), list("-+0123456789")
)


def _typed(hint: Any, content: Any, name: str, error: type[ValueError]) -> Any:
    """Return content of a file with dataclasses where the type of its field has them, and texts as keys."""
    for kind in alternatives(hint):
        if is_dataclass_type(kind):
            types = field_types(kind)
            if not isinstance(content, Mapping):
                raise error(f"{name} is a mapping of {', '.join(types)}, not {content!r}")
            # A key without content is left out.
            values = {key: value for key, value in content.items() if value is not None}
            return kind(**{k: _typed(types[k], v, f"{name}.{k}".lstrip("."), error) for k, v in values.items()})
        if get_origin(kind) is dict and isinstance(content, Mapping):
            inner = get_args(kind)[1]
            # {} may be left out, too.
            empty: dict[str, Any] | None = {} if get_origin(inner) is dict else None
            values = {str(key): empty if value is None else value for key, value in content.items()}
            return {key: _typed(inner, value, f"{name}.{key}", error) for key, value in values.items()}
        if get_origin(kind) is list and isinstance(content, list):
            inner = get_args(kind)[0]
            return [_typed(inner, value, f"{name}[{index}]", error) for index, value in enumerate(content)]
    return content
