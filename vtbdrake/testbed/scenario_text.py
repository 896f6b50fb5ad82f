"""The YAML text of a scenario, with the entries of its dictionaries in their order."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import yaml
from pydrake.common.yaml import yaml_dump_typed

from vtbdrake.common.field_types import resolve_types
from vtbdrake.testbed.pedigree import Pedigree
from vtbdrake.testbed.scenario_identity import IdentifiedScenario, ScenarioError

if TYPE_CHECKING:
    from vtbdrake.common.validity_domain import ValidityDomain

# The pedigree in the text of a scenario.
_PEDIGREE = re.compile(r"^  pedigree:\n(?:    .*\n)*", re.MULTILINE)


def scenario_text(scenario: IdentifiedScenario) -> str:
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
    text = _in_order(text, scenario)
    # A file without a pedigree is one that hardware_sim reads, too.
    return text if scenario.pedigree != Pedigree() else _PEDIGREE.sub("", text)


def _in_order(text: str, scenario: IdentifiedScenario) -> str:
    """Return the text of a scenario with the entries of its dictionaries in their order, which Drake's writer sorts.

    Signals follow the order of a dictionary, such as the commands of a station.
    """
    document = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(document, yaml.MappingNode)
    [(_, content)] = document.value
    return text[: content.start_mark.index] + _ordered(text, content, scenario) + "\n"


def _ordered(text: str, node: yaml.Node, value: Any) -> str:
    """Return the text of a node that holds ``value``, with its entries in the order of ``value``."""
    if not isinstance(node, yaml.CollectionNode) or node.flow_style or not node.value:
        return text[node.start_mark.index : node.end_mark.index].rstrip()
    is_dict = isinstance(value, Mapping)
    if isinstance(node, yaml.MappingNode):
        parts = {
            key.value: text[key.start_mark.index : item.start_mark.index]
            + _ordered(text, item, value.get(key.value) if is_dict else getattr(value, key.value, None))
            for key, item in node.value
        }
        first = node.value[0][0].start_mark
        names = [name for name in value if name in parts] if is_dict else []
        entries = [parts[name] for name in (names if len(names) == len(parts) else parts)]
        begin = text[node.start_mark.index : first.index]  # the tag of a class
    else:
        items = list(value) if isinstance(value, list | tuple) else [None] * len(node.value)
        first, begin = node.start_mark, ""
        entries = ["- " + _ordered(text, item, part) for item, part in zip(node.value, items, strict=True)]
    return begin + ("\n" + " " * first.column).join(entries)


def save_scenario(
    scenario: IdentifiedScenario, path: str | os.PathLike[str], *, domain: ValidityDomain | None = None
) -> None:
    """Write a YAML file that `vtbdrake.testbed.load_scenario` reads.

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
