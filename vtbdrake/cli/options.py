"""What the commands take: scenarios, settings, ranges and files, checked before anything long begins."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario, load_scenario

if TYPE_CHECKING:
    from vtbdrake.optimization import Choice, Parameter

# (address, value)
Setting = tuple[str, float | list[Any]]


def converted(parse: Callable[[Any], Any]) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """A callback that makes of the text of an option, or of each of its texts, what the command takes."""

    def convert(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        if ctx.resilient_parsing or value is None:
            return None
        return tuple(parse(text) for text in value) if isinstance(value, tuple) else parse(value)

    return convert


def parse_setting(text: str) -> Setting:
    """``ADDRESS=VALUE``, the value a number or a JSON list of numbers."""
    address, equals, value = (part.strip() for part in text.partition("="))
    if not (address and equals and value):
        raise click.BadParameter(f"it takes ADDRESS=VALUE, not {text!r}")
    try:
        number = json.loads(value)
    except json.JSONDecodeError:
        number = None
    if isinstance(number, bool) or not isinstance(number, int | float | list):
        raise click.BadParameter(f"the value of {address} is a number or a JSON list of numbers, not {value!r}")
    return address, number


def parse_field(text: str) -> tuple[str, Any]:
    """``NAME=VALUE``, the value in JSON, or else a text."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        raise click.BadParameter(f"it takes NAME=VALUE, not {text!r}")
    return name, _json_or_text(value)


def _json_or_text(value: str) -> Any:
    try:
        return json.loads(value)
    except json.JSONDecodeError:
        return value


def parse_condition(text: str) -> dict[str, Any]:
    """Settings that hold together: ``ADDRESS=VALUE[;ADDRESS=VALUE...]``."""
    return settings(parse_setting(part) for part in text.split(";"))


def parse_url(text: str) -> str:
    """The URL of an LCM bus."""
    provider, separator, _ = text.partition("://")
    if not (provider and separator):
        raise click.BadParameter(f"the URL of a bus has the form tcpq://127.0.0.1:7700, unlike {text!r}")
    try:
        _ = urlsplit(text).port
    except ValueError as error:
        raise click.BadParameter(f"{text!r} has no port that there can be: {error}") from error
    return text


def positive(value: float) -> float:
    """A time in seconds."""
    if not value > 0.0:
        raise click.BadParameter(f"it is a positive time in seconds, unlike {value:g}")
    return value


def parse_range(text: str) -> Parameter:
    """``ADDRESS=LOWER:UPPER``."""
    from vtbdrake.optimization import Parameter

    (lower, upper), address = _numbers(text, (float, float), "ADDRESS=LOWER:UPPER")
    return Parameter(address, lower, upper)


# What may follow a range.
SCALES = {"log", "integer"}


def parse_scaled_range(text: str) -> Parameter:
    """``ADDRESS=LOWER:UPPER``, and ``:log``, ``:integer`` or both after it."""
    parts = text.split(":")
    kinds = [part.strip() for part in parts[2:]]
    if len(set(kinds) & SCALES) < len(kinds):
        raise click.BadParameter(f"it takes ADDRESS=LOWER:UPPER, then :log, :integer or both, not {text!r}")
    return replace(parse_range(":".join(parts[:2])), log="log" in kinds, integer="integer" in kinds)


def parse_choice(text: str) -> Choice:
    """``ADDRESS=OPTION,OPTION,...``, each in JSON, or else a text."""
    from vtbdrake.optimization import Choice

    address, equals, options = (part.strip() for part in text.partition("="))
    if not (address and equals and options):
        raise click.BadParameter(f"it takes ADDRESS=OPTION,OPTION[,...], not {text!r}")
    return Choice(address, [_json_or_text(option.strip()) for option in options.split(",")])


def parse_grid(text: str) -> tuple[Parameter, int]:
    """``ADDRESS=LOWER:UPPER:POINTS``."""
    from vtbdrake.optimization import Parameter

    (lower, upper, points), address = _numbers(text, (float, float, int), "ADDRESS=LOWER:UPPER:POINTS")
    return Parameter(address, lower, upper), points


def _numbers(text: str, kinds: Sequence[Callable[[str], Any]], form: str) -> tuple[list[Any], str]:
    address, _, values = text.rpartition("=")
    parts = values.split(":")
    if not address.strip() or len(parts) != len(kinds):
        raise click.BadParameter(f"it takes {form}, not {text!r}")
    try:
        return [kind(part) for kind, part in zip(kinds, parts, strict=True)], address.strip()
    except ValueError as error:
        raise click.BadParameter(f"it takes {form} in numbers, not {text!r}: {error}") from error


def output(*suffixes: str, new: bool = False) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """A callback that checks a file to be written: its folder takes it, and its name ends as one of ``suffixes``.

    Args:
        new: it must not exist.
    """

    def parse(text: str) -> Path:
        path = Path(text)
        if suffixes and path.suffix not in suffixes:
            raise click.BadParameter(f"the name of the file ends in {' or '.join(suffixes)}, unlike {text!r}")
        if path.is_dir():
            raise click.BadParameter(f"{path} is a folder")
        if not path.parent.is_dir():
            raise click.BadParameter(f"{path} lies in a folder that does not exist")
        if not os.access(path.parent, os.W_OK, effective_ids=True):
            raise click.BadParameter(f"{path} lies in a folder that you cannot write to")
        if new and path.exists():
            raise click.BadParameter(f"{path} exists, and is not overwritten: give another name, or remove it")
        return path

    return converted(parse)


scenario_argument = click.argument("scenario", callback=converted(load_scenario))
set_option = click.option(
    "--set",
    "values",
    callback=converted(parse_setting),
    multiple=True,
    metavar="ADDRESS=VALUE",
    help="Set a variable in s0: a number, or a JSON list. May be repeated.",
)
field_option = click.option(
    "--field",
    "fields",
    callback=converted(parse_field),
    multiple=True,
    metavar="NAME=VALUE",
    help="Set a field of the scenario: a number, true, false or a text. May be repeated.",
)
url_option = click.option(
    "--url",
    callback=converted(parse_url),
    required=True,
    metavar="URL",
    help="The LCM bus: tcpq://127.0.0.1:7700, of a hub, say.",
)
timeout_option = click.option(
    "--timeout",
    type=float,
    callback=converted(positive),
    default=5.0,
    show_default=True,
    metavar="S",
    help="Give up when nobody has answered for so long.",
)
horizon_option = click.option("--horizon", type=float, required=True, metavar="S", help="t_m, in seconds.")
sample_period_option = click.option(
    "--sample-period",
    type=float,
    default=0.05,
    show_default=True,
    metavar="S",
    help="Time between two samples, in seconds.",
)
start_option = click.option(
    "--start",
    callback=converted(Snapshot.load),
    metavar="SNAPSHOT",
    help="Take s0 from this file instead of the defaults.",
)


def with_fields(scenario: Scenario, pairs: Iterable[tuple[str, Any]]) -> Scenario:
    """A copy of the scenario with these fields.

    Raises:
        click.UsageError: a field is set twice.
        ScenarioError: the scenario refuses one.
    """
    values: dict[str, Any] = {}
    for name, value in pairs:
        if name in values:
            raise click.UsageError(f"the field {name} is set twice")
        values[name] = value
    return scenario.with_fields(values)


def settings(pairs: Iterable[Setting]) -> dict[str, Any]:
    """Address -> value.

    Raises:
        click.UsageError: an address is set twice.
    """
    values: dict[str, Any] = {}
    for address, value in pairs:
        if address in values:
            raise click.UsageError(f"{address} is set twice")
        values[address] = value
    return values
