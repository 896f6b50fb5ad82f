"""Settings: the range and the unit of a configuration's field, declared beside its default, for all who need them.

For example::

    @dataclass
    class ScannerConfig:
        frequency: float = setting(10.0, "Scans per second.", unit="Hz", gt=0.0, le=50.0)

`check_settings` checks the values, `schema` describes them as a JSON Schema, the command line makes options of them.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from inspect import getdoc
from itertools import pairwise
from math import inf, isfinite
from numbers import Integral, Real
from types import NoneType
from typing import Any, get_args, get_origin

from vtbdrake.common.field_types import alternatives, field_types, is_dataclass_type

_KEY = "setting"
# By a type in an annotation: the types of its values, and what messages and JSON Schema call it.
_TYPES: dict[Any, tuple[type, str, str]] = {
    bool: (bool, "True or False", "boolean"),
    int: (Integral, "a whole number", "integer"),
    float: (Real, "a number", "number"),
    str: (str, "a text", "string"),
    NoneType: (NoneType, "None", "null"),
    **dict.fromkeys((list, tuple, Sequence), (Collection, "a list", "array")),
    **dict.fromkeys((dict, Mapping), (Mapping, "a mapping", "object")),
}


@dataclass(frozen=True, kw_only=True)
class Setting:
    """The possible values of a field; for a list or a mapping, the possible values of its entries.

    Attributes:
        doc: A sentence that says what the field is.
        unit: The unit of the values; empty if they have none.
        gt: A bound that all values are above.
        ge: The least value.
        lt: A bound that all values are below.
        le: The largest value.
        choices: The only values; empty for all in the range.
        finite: Whether infinity is excluded.
        below: The field whose value this one is below.
        ascending: Whether two entries are the lower one, then the upper one.
        remedy: The reason for the range, or what to do, for error messages.
    """

    doc: str = ""
    unit: str = ""
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    choices: tuple[Any, ...] = ()
    finite: bool = True
    below: str = ""
    ascending: bool = False
    remedy: str = ""

    def contains(self, value: Any) -> bool:
        """Return whether a value of the right type is possible."""
        if self.choices:
            return value in self.choices
        if not isinstance(value, int | float):
            return True
        return (
            (isinstance(value, int) or isfinite(value) or (value == value and not self.finite))
            and (self.gt is None or value > self.gt)
            and (self.ge is None or value >= self.ge)
            and (self.lt is None or value < self.lt)
            and (self.le is None or value <= self.le)
        )

    @property
    def bounds(self) -> tuple[float, float]:
        """Return the ends of the range, infinite where it is open."""
        lower, upper = self.gt if self.ge is None else self.ge, self.lt if self.le is None else self.le
        return -inf if lower is None else float(lower), inf if upper is None else float(upper)

    @property
    def range(self) -> str:
        """Return the range in words, with the unit, such as "from 0 to 3 m/s"; empty without both."""
        above, least, below, most = map(_text, (self.gt, self.ge, self.lt, self.le))
        if least and (below or most):
            words = f"from {least} to {f'below {below}' if below else most}"
        else:
            lower = f"above {above}" if above else f"at least {least}" if least else ""
            upper = f"below {below}" if below else f"at most {most}" if most else ""
            words = " and ".join(bound for bound in (lower, upper) if bound)
        if self.unit:
            words = f"{words or 'in'} {self.unit}"
        return words


def _text(bound: float | None) -> str:
    return "" if bound is None else f"{bound:g}" if isinstance(bound, float) else str(bound)


_ANY = Setting()


def setting(default: Any = MISSING, doc: str = "", *, default_factory: Any = MISSING, **limits: Any) -> Any:
    """Return a field of a dataclass, as `dataclasses.field` does, with a `Setting`.

    A subclass that only gives another default keeps the rest.

    Args:
        default: The default value.
        doc: A sentence that says what the field is.
        default_factory: A function that makes the default value.
        limits: The other attributes of the `Setting`.
    """
    return field(default=default, default_factory=default_factory, metadata={_KEY: Setting(doc=doc, **limits)})


def declared_settings(kind: type) -> dict[str, Setting]:
    """Return the settings that a dataclass and its bases declare, by field."""
    items = [item for base in reversed(kind.__mro__) for item in vars(base).get("__dataclass_fields__", {}).values()]
    return {item.name: item.metadata[_KEY] for item in items if _KEY in item.metadata}


def _is_sized(kind: Any) -> bool:
    """Return whether a type tells the number of entries."""
    return get_origin(kind) is tuple and bool(get_args(kind)) and ... not in get_args(kind)


def _entry(kind: Any, index: int) -> Any:
    """Return the type of an entry of a list or mapping."""
    entries = get_args(kind)
    if not entries:
        return Any
    return entries[-1] if _TYPES[get_origin(kind)][2] == "object" else entries[index if _is_sized(kind) else 0]


def _accepts(kind: Any, value: Any) -> bool:
    """Return whether a value is of a type, without a look at its entries."""
    python_type: Any
    python_type, _, name = _TYPES[get_origin(kind) or kind]
    if isinstance(value, bool) or (name == "array" and isinstance(value, str | bytes | Mapping)):
        return python_type is bool
    return isinstance(value, python_type) and (not _is_sized(kind) or len(value) == len(get_args(kind)))


def _checkable(types: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the types, or none if one of them is not among `_TYPES`: the values can be anything then."""
    return types if all((get_origin(each) or each) in _TYPES for each in types) else ()


def plain_types(annotation: Any) -> tuple[type, ...]:
    """Return the plain types among the alternatives of the type of a field: float for ``float | None``."""
    return tuple(each for each in alternatives(annotation) if each in (bool, int, float, str))


def check_settings(config: Any, *, name: str = "", error: type[ValueError] = ValueError) -> None:
    """Check the fields of a configuration and of the configurations in it.

    Numbers, texts, True and False, and lists and mappings of them, have the type of their field; numbers are finite;
    values are in the range of the `setting`. Fields of other types are not checked.

    Args:
        config: A dataclass.
        name: The name of the configuration in messages; by default its class.
        error: The class of the error.

    Raises:
        ValueError: A value is not possible; the message has the field, the possible values and their unit.
    """
    settings = declared_settings(type(config))
    for key, annotation in field_types(config).items():
        path = f"{name or type(config).__name__}.{key}"
        check_value(path, getattr(config, key), annotation, settings.get(key), error=error)
    for key, limits in settings.items():
        path, value = f"{name or type(config).__name__}.{key}", getattr(config, key)
        if limits.below and not value < getattr(config, limits.below):
            most = f"{limits.below}, {getattr(config, limits.below):g} {limits.unit}".rstrip()
            raise error(f"{path} must be below the {most}, not {value!r}")
        if limits.ascending and not all(lower < upper for lower, upper in pairwise(value)):
            raise error(f"{path} must be the lower one, then the upper one, not {value!r}")


def check_value(
    name: str, value: Any, annotation: Any, limits: Setting | None = None, *, error: type[ValueError] = ValueError
) -> None:
    """Check one value as `check_settings` does.

    Args:
        name: The name of the value in messages.
        value: The value.
        annotation: The type of the field.
        limits: The setting of the field, if it has one.
        error: The class of the error.

    Raises:
        ValueError: The value is not possible.
    """
    if field_types(value) and not isinstance(value, type):
        check_settings(value, name=name, error=error)
        return
    types = _checkable(alternatives(annotation))
    if hasattr(value, "tolist"):
        if not (types or limits):  # An array of data.
            return
        value = value.tolist()
    matches = [each for each in types if _accepts(each, value)]
    entries: Iterable[tuple[Any, Any]] | None = None
    if isinstance(value, Collection) and not isinstance(value, str | bytes):
        entries = value.items() if isinstance(value, Mapping) else enumerate(value)
    is_limited = (types or limits) and entries is None and value is not None
    if (types and not matches) or (is_limited and not (limits or _ANY).contains(value)):
        raise error(f"{name} must be {_expected(types, limits or _ANY, value)}, not {value!r}{_because(limits)}")
    for index, (key, entry) in enumerate(entries or ()):
        check_value(f"{name}[{key}]", entry, _entry(matches[0], index) if matches else Any, limits, error=error)


def _because(limits: Setting | None) -> str:
    return f": {limits.remedy}" if limits and limits.remedy else ""


def _expected(types: Sequence[Any], limits: Setting, value: Any) -> str:
    """Return the possible values in words."""
    if limits.choices:
        return f"one of {', '.join(str(choice) or 'empty' for choice in limits.choices)}"
    words = []
    for each in types:
        _, noun, name = _TYPES[get_origin(each) or each]
        if each in (int, float):
            is_open = each is float and limits.finite and limits.lt is limits.le is None
            noun = f"a {'finite ' if is_open else ''}{noun.removeprefix('a ')}"
            preposition = " of " if limits.range.startswith("at ") else " " if limits.range else ""
            noun = f"{noun}{preposition}{limits.range}"
        elif _is_sized(each):
            noun = f"{noun} of {len(get_args(each))} entries"
        elif name == "array" and isinstance(value, str):
            noun = f"{noun}, such as [{value!r}]"
        words.append(noun)
    return " or ".join(dict.fromkeys(words)) or limits.range or "finite"


def schema(kind: type) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a configuration, with types, ranges, defaults and descriptions.

    The unit of a field is its keyword "unit".

    Args:
        kind: A dataclass whose fields have defaults, or one of Drake's configs.
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_object_schema(kind, kind())}


def _object_schema(kind: type, config: Any) -> dict[str, Any]:
    settings = declared_settings(kind)
    properties = {
        key: _schema(annotation, settings.get(key, _ANY), getattr(config, key, None))
        for key, annotation in field_types(kind).items()
    }
    title, text = kind.__name__, getdoc(kind) or ""
    return {
        "title": title,
        # A dataclass without a docstring gets its signature as one.
        "description": "" if text.startswith(f"{title}(") else text.split("\n\n")[0].replace("\n", " "),
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def _schema(annotation: Any, limits: Setting, default: Any) -> dict[str, Any]:
    described = _object_schema(type(default), default) if field_types(default) else _type_schema(annotation, limits)
    described |= {key: text for key, text in (("description", limits.doc), ("unit", limits.unit)) if text}
    if _is_json(default):
        described["default"] = default
    return described


def _with_defaults(kind: type) -> Any:
    """Return a dataclass with the defaults of its fields; None if a field has none."""
    try:
        return kind()
    except TypeError:
        return None


def _type_schema(annotation: Any, limits: Setting) -> dict[str, Any]:
    kinds = alternatives(annotation)
    if objects := [_object_schema(each, _with_defaults(each)) for each in kinds if is_dataclass_type(each)]:
        nothing = [{"type": "null"}] if NoneType in kinds else []
        return {"anyOf": [*objects, *nothing]} if len(objects) + len(nothing) > 1 else objects[0]
    types = _checkable(kinds)
    names = list(dict.fromkeys(_TYPES[get_origin(each) or each][2] for each in types))
    described: dict[str, Any] = {"type": names[0] if len(names) == 1 else names} if names else {}
    bounds = {
        "exclusiveMinimum": limits.gt,
        "minimum": limits.ge,
        "exclusiveMaximum": limits.lt,
        "maximum": limits.le,
    }
    for each in types:
        kind = _TYPES[get_origin(each) or each][2]
        if kind == "array":
            described["items"] = _type_schema(_entry(each, 0), limits)
            if _is_sized(each):
                described |= {"minItems": len(get_args(each)), "maxItems": len(get_args(each))}
        elif kind == "object":
            described["additionalProperties"] = _type_schema(_entry(each, 0), limits)
        elif limits.choices:
            described["enum"] = [*limits.choices]
        elif kind in ("integer", "number"):
            described |= {key: bound for key, bound in bounds.items() if bound is not None}
    return described


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return False
    return value is not None
