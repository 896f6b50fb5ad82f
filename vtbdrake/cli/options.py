"""Options and arguments that several commands share, with the parsers that check them before anything long begins."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from vtbdrake.state import Snapshot
from vtbdrake.testbed import load_scenario

if TYPE_CHECKING:
    from vtbdrake.optimization import Choice, Parameter

# (address, value)
Setting = tuple[str, float | list[Any]]


def converted(parse: Callable[[Any], Any]) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """Return a click callback that parses the text of an option, or each of its texts."""

    def convert(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        if ctx.resilient_parsing or value is None:
            return None
        return tuple(parse(text) for text in value) if isinstance(value, tuple) else parse(value)

    return convert


def _assignment(text: str, form: str) -> tuple[str, str]:
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        raise click.BadParameter(f"expected {form}, not {text!r}")
    return name, value


def _json_or_text(value: str) -> Any:
    try:
        return json.loads(value)
    except json.JSONDecodeError:
        return value


def parse_setting(text: str) -> Setting:
    """Parse ``ADDRESS=VALUE``, where the value is a number or a JSON list of numbers."""
    address, value = _assignment(text, "ADDRESS=VALUE")
    number = _json_or_text(value)
    if isinstance(number, bool) or not isinstance(number, int | float | list):
        raise click.BadParameter(f"the value of {address} is a number or a JSON list of numbers, not {value!r}")
    return address, number


def parse_field(text: str) -> tuple[str, Any]:
    """Parse ``NAME=VALUE``, where the value is JSON, or else a text."""
    name, value = _assignment(text, "NAME=VALUE")
    return name, _json_or_text(value)


def parse_condition(text: str) -> dict[str, Any]:
    """Parse settings that hold together: ``ADDRESS=VALUE[;ADDRESS=VALUE...]``."""
    return settings(parse_setting(part) for part in text.split(";"))


def parse_choice(text: str) -> Choice:
    """Parse ``ADDRESS=OPTION,OPTION,...``, where each option is JSON, or else a text."""
    from vtbdrake.optimization import Choice

    address, options = _assignment(text, "ADDRESS=OPTION,OPTION[,...]")
    return Choice(address, [_json_or_text(option.strip()) for option in options.split(",")])


def parse_range(text: str) -> Parameter:
    """Parse ``ADDRESS=LOWER:UPPER``."""
    from vtbdrake.optimization import Parameter

    address, (lower, upper) = _numbers(text, (float, float), "ADDRESS=LOWER:UPPER")
    return Parameter(address, lower, upper)


def parse_scaled_range(text: str) -> Parameter:
    """Parse ``ADDRESS=LOWER:UPPER``, followed by ``:log``, ``:integer`` or both."""
    from vtbdrake.optimization import Parameter

    bounds, kinds = text.split(":")[:2], [part.strip() for part in text.split(":")[2:]]
    if len(set(kinds) & {"log", "integer"}) < len(kinds):
        raise click.BadParameter(f"expected ADDRESS=LOWER:UPPER, then :log, :integer or both, not {text!r}")
    address, (lower, upper) = _numbers(":".join(bounds), (float, float), "ADDRESS=LOWER:UPPER")
    return Parameter(address, lower, upper, log="log" in kinds, integer="integer" in kinds)


def parse_grid(text: str) -> tuple[Parameter, int]:
    """Parse ``ADDRESS=LOWER:UPPER:POINTS``."""
    from vtbdrake.optimization import Parameter

    address, (lower, upper, points) = _numbers(text, (float, float, int), "ADDRESS=LOWER:UPPER:POINTS")
    return Parameter(address, lower, upper), points


def _numbers(text: str, kinds: Sequence[Callable[[str], Any]], form: str) -> tuple[str, list[Any]]:
    address, _, values = text.rpartition("=")
    parts = values.split(":")
    if not address.strip() or len(parts) != len(kinds):
        raise click.BadParameter(f"expected {form}, not {text!r}")
    try:
        return address.strip(), [kind(part) for kind, part in zip(kinds, parts, strict=True)]
    except ValueError as error:
        raise click.BadParameter(f"expected {form} with numbers, not {text!r}: {error}") from error


def parse_url(text: str) -> str:
    """Check the URL of an LCM bus."""
    provider, separator, _ = text.partition("://")
    if not (provider and separator):
        raise click.BadParameter(f"expected the URL of an LCM bus, such as tcpq://127.0.0.1:7700, not {text!r}")
    try:
        _ = urlsplit(text).port
    except ValueError as error:
        raise click.BadParameter(f"{text!r} has no valid port: {error}") from error
    return text


def positive(value: float) -> float:
    """Check a time in seconds."""
    if not value > 0.0:
        raise click.BadParameter(f"expected a positive time in seconds, not {value:g}")
    return value


def output(*suffixes: str, new: bool = False) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """Return a callback that checks that a file can be written.

    Args:
        suffixes: The suffixes that its name may have; any by default.
        new: Reject a file that exists.
    """

    def parse(text: str) -> Path:
        path = Path(text)
        if suffixes and path.suffix not in suffixes:
            raise click.BadParameter(f"expected a file name that ends in {' or '.join(suffixes)}, not {text!r}")
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


def settings(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return a mapping of addresses or names to values.

    Raises:
        click.UsageError: A name occurs twice.
    """
    values: dict[str, Any] = {}
    for name, value in pairs:
        if name in values:
            raise click.UsageError(f"{name} is set twice")
        values[name] = value
    return values


scenario_argument = click.argument("scenario", callback=converted(load_scenario))
set_option = click.option(
    "--set",
    "values",
    callback=converted(parse_setting),
    multiple=True,
    metavar="ADDRESS=VALUE",
    help="Set a variable in s0 to a number or a JSON list. May be repeated.",
)
url_option = click.option(
    "--url",
    callback=converted(parse_url),
    required=True,
    metavar="URL",
    help="The LCM bus, for example tcpq://127.0.0.1:7700 for a hub.",
)
timeout_option = click.option(
    "--timeout",
    type=float,
    callback=converted(positive),
    default=5.0,
    show_default=True,
    metavar="S",
    help="Give up after so many seconds without an answer.",
)
horizon_option = click.option("--horizon", type=float, required=True, metavar="S", help="The horizon t_m, in seconds.")
sample_period_option = click.option(
    "--sample-period",
    type=float,
    default=0.05,
    show_default=True,
    metavar="S",
    help="The time between two samples, in seconds.",
)
start_option = click.option(
    "--start",
    callback=converted(Snapshot.load),
    metavar="SNAPSHOT",
    help="Take s0 from this file instead of the defaults.",
)
