"""Options and arguments that several commands share, with the parsers that check them before anything long begins."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from vtbdrake.cli.completion import complete_file, complete_scenario
from vtbdrake.common.settings import declared_settings

if TYPE_CHECKING:
    from vtbdrake.optimization import Choice, Parameter
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario

# (address, value)
Setting = tuple[str, float | list[Any]]


def converted(parse: Callable[[Any], Any]) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """Return a click callback that parses the text of an option, or each of its texts."""

    def convert(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        if ctx.resilient_parsing or value is None:
            return None
        return tuple(parse(text) for text in value) if isinstance(value, tuple) else parse(value)

    return convert


def option(
    usage: str, text: str, *, name: str | None = None, parse: Callable[[Any], Any] | None = None, **settings: Any
) -> Callable[[Any], Any]:
    """Return a ``click.option``.

    Args:
        usage: Its names, and the word for its value, such as ``--horizon S``.
        text: Its help.
        name: The parameter of the command that gets the value; by default the last of its names.
        parse: Makes the value of a text, or of each text if there may be several.
        settings: Further arguments of ``click.option``.
    """
    names = [word for word in usage.split() if word.startswith("-")]
    metavar = usage.removeprefix(" ".join(names)).strip() or None
    if parse is not None:
        settings["callback"] = converted(parse)
    if metavar in ("FILE", "SNAPSHOT", "OTHER"):
        settings.setdefault("shell_complete", complete_file)
    return click.option(*names, *([name] if name else []), metavar=metavar, help=text, **settings)


def grouped(name: str, *options: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a decorator that gives a command several options, whose values it gets as one dictionary ``name``.

    Groups of the same name become one dictionary.

    Args:
        name: The argument of the command that gets the dictionary.
        options: Decorators of click that add one option each, in the order of the help.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def with_group(**arguments: Any) -> Any:
            group = arguments.pop(name, {}) | {member: arguments.pop(member) for member in members}
            return command(**arguments, **{name: group})

        inherited = len(getattr(with_group, "__click_params__", ()))
        for add_option in reversed(options):
            add_option(with_group)
        members = [parameter.name for parameter in with_group.__click_params__[inherited:]]  # type: ignore[attr-defined]
        return with_group

    return decorate


def config_option(
    config: Any, usage: str, text: str = "", *, field: str = "", per: int = 1, **settings: Any
) -> Callable[[Any], Any]:
    """Return the option that sets a field of a configuration; default, help, unit and range come from the field.

    Args:
        config: The configuration with the default values.
        usage: As in `option`.
        text: Replaces the help of the field.
        field: The field; by default the field with the option's name.
        per: A whole multiple of the field's unit, in which the option counts instead.
        settings: Further arguments of `option`.
    """
    field = field or usage.split()[0].removeprefix("--").replace("-", "_")
    declared, default = declared_settings(type(config))[field], getattr(config, field)
    if not text:
        text = f"{declared.doc[:-1]} ({declared.range})." if declared.range and per == 1 else declared.doc
    if default is None:
        settings.setdefault("type", float)
    elif not settings.get("multiple"):
        settings.setdefault("default", default if per == 1 else default // per)
    return option(usage, text, name=field, **settings)


def assignment(text: str, form: str) -> tuple[str, str]:
    """Parse ``NAME=VALUE``; ``form`` names the two parts.

    Args:
        text: The text that the user wrote.
        form: The expected form for the error message, such as ``ADDRESS=VALUE``.
    """
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        raise click.BadParameter(f"expected {form}, not {text!r}")
    return name, value


def _json_or_text(value: str) -> Any:
    try:
        return json.loads(value)
    except json.JSONDecodeError:
        return value


def parse_scenario(text: str) -> Scenario:
    """Load a scenario. Drake is imported here: a hub without a scenario starts without it."""
    from vtbdrake.testbed import load_scenario

    return load_scenario(text)


def parse_snapshot(path: str) -> Snapshot:
    """Load a snapshot."""
    from vtbdrake.state import Snapshot

    return Snapshot.load(path)


def parse_setting(text: str) -> Setting:
    """Parse ``ADDRESS=VALUE``, where the value is a number or a JSON list of numbers."""
    address, value = assignment(text, "ADDRESS=VALUE")
    number = _json_or_text(value)
    if isinstance(number, str) and isinstance(_json_or_text(f"[{value}]"), list):
        raise click.BadParameter(f"a list is written in brackets, and in quotes for the shell: '{address}=[{value}]'")
    if isinstance(number, bool) or not isinstance(number, int | float | list):
        raise click.BadParameter(f"the value of {address} is a number or a JSON list of numbers, not {value!r}")
    return address, number


def parse_field(text: str) -> tuple[str, Any]:
    """Parse ``NAME=VALUE``, where the value is JSON, or else a text."""
    name, value = assignment(text, "NAME=VALUE")
    return name, _json_or_text(value)


def parse_condition(text: str) -> dict[str, Any]:
    """Parse settings that hold together: ``ADDRESS=VALUE[;ADDRESS=VALUE...]``."""
    return settings(parse_setting(part) for part in text.split(";"))


def parse_choice(text: str) -> Choice:
    """Parse ``ADDRESS=OPTION,OPTION,...``, where each option is JSON, or else a text."""
    from vtbdrake.optimization import Choice

    address, options = assignment(text, "ADDRESS=OPTION,OPTION[,...]")
    return Choice(address, [_json_or_text(option.strip()) for option in options.split(",")])


def parse_limits(text: str) -> tuple[str, dict[str, Any]]:
    """Parse ``ADDRESS=LOWER:UPPER``, where an end may be missing, or ``ADDRESS=OPTION,...``.

    Returns:
        The address, and ``lower`` and ``upper`` (None if missing), or ``options``.
    """
    address, values = assignment(text, "ADDRESS=LOWER:UPPER or ADDRESS=OPTION[,...]")
    if ":" not in values:
        return address, {"options": [_json_or_text(option.strip()) for option in values.split(",")]}
    try:
        lower, upper = (float(end) if end.strip() else None for end in values.split(":"))
    except ValueError as error:
        raise click.BadParameter(f"expected {address}=LOWER:UPPER with numbers, not {text!r}") from error
    return address, {"lower": lower, "upper": upper}


def parse_optional(text: str) -> Any:
    """Parse JSON, or else a text; ``none`` is None."""
    return None if text == "none" else _json_or_text(text)


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
    if provider == "memq":
        raise click.BadParameter(f"{text!r} is private to this process and reaches no other: name a hub or a network")
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


class LazyChoice(click.Choice[str]):
    """A choice among names of the library, which is imported when they are needed: Drake takes its time.

    Args:
        load: Returns the names.
    """

    def __init__(self, load: Callable[[], Iterable[str]]) -> None:
        self.case_sensitive = True
        self._load = load

    @property
    def choices(self) -> Sequence[str]:  # type: ignore[override]
        """Return the names."""
        return tuple(self._load())


def output(*suffixes: str, new: bool = False) -> Callable[[str], Path]:
    """Return a function that checks that a file can be written, and returns its path.

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

    return parse


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


def scenario_argument(
    command: Callable[..., Any],
    *,
    parse: Callable[[str], Any] = parse_scenario,
    complete: Callable[..., Any] = complete_scenario,
    metavar: str | None = None,
) -> Callable[..., Any]:
    """Give a command its argument ``scenario``, with the fields that ``--field`` sets.

    Args:
        command: The command.
        parse: Loads the scenario, or what the command accepts instead.
        complete: Completes it in a shell.
        metavar: What the command accepts, for its help.
    """

    @wraps(command)
    def with_scenario(*, scenario: Any, scenario_fields: tuple[tuple[str, Any], ...], **parameters: Any) -> Any:
        from vtbdrake.testbed import Scenario

        if isinstance(scenario, Scenario):
            scenario = scenario.with_fields(settings(scenario_fields))
        return command(scenario=scenario, **parameters)

    argument = click.argument("scenario", callback=converted(parse), shell_complete=complete, metavar=metavar)
    decorated = argument(_field_option(with_scenario))
    return decorated if parse is not parse_scenario else import_option(decorated)


def _parse_package(text: str) -> tuple[str, Path]:
    name, folder = assignment(text, "NAME=FOLDER")
    if not Path(folder).is_dir():
        raise click.BadParameter(f"there is no folder {folder}: expected NAME=FOLDER, the folder of a package")
    return name, Path(folder).resolve()


package_option = option(
    "--package NAME=FOLDER",
    "Where a model file finds package://NAME/..., if not around it or on the ROS_PACKAGE_PATH. May be repeated.",
    name="packages",
    parse=_parse_package,
    multiple=True,
)


def _import_module(name: str) -> None:
    try:
        importlib.import_module(name)
    except ImportError as error:
        raise click.BadParameter(f"cannot import {name}: {error}") from error


import_option = option(
    "--trust MODULE",
    "Import this module, which runs its code, because a file or a log names a function of it: the DPS of a station. "
    "May be repeated.",
    parse=_import_module,
    multiple=True,
    is_eager=True,  # Before the scenario is read.
    expose_value=False,
)
film_option = option("--film FILE", "Write a film: .mp4, .gif or .webp.", parse=output(".mp4", ".gif", ".webp"))
scene_option = option(
    "--scene FILE", "Write the scene for Foxglove (.mcap) or Rerun (.rrd).", parse=output(".mcap", ".rrd")
)
set_option = option(
    "--set ADDRESS=VALUE",
    "Set a variable in s0 to a number or a JSON list. May be repeated.",
    name="values",
    parse=parse_setting,
    multiple=True,
)
_field_option = option(
    "--field NAME=VALUE",
    "Set a field of the scenario: a number, true, false or a text. May be repeated.",
    name="scenario_fields",
    parse=parse_field,
    multiple=True,
)


def schema_option(load: Callable[[], dict[str, Any]]) -> Callable[[Any], Any]:
    """Return the option ``--schema``, which prints the JSON Schema of a command's file instead of running it."""

    def show_schema(ctx: click.Context, _: click.Parameter, is_requested: bool) -> None:
        from vtbdrake.cli.output import show

        if is_requested and not ctx.resilient_parsing:
            described = load()
            show(json.dumps(described, indent=2), described)
            ctx.exit()

    settings: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False, "callback": show_schema}
    return option("--schema", "Print the JSON Schema of the YAML file.", **settings)


trust_option = option(
    "--trust MODULE",
    "A module, or a package of modules, that may be imported because a file names it, which runs its code. Those of "
    "vtbdrake need not be named. May be repeated.",
    name="trusted",
    multiple=True,
    is_eager=True,  # Known when the file is read.
)
url_option = option(
    "--url URL", "The LCM bus, for example tcpq://127.0.0.1:7700 for a hub.", parse=parse_url, required=True
)
timeout_option = option("--timeout S", "Give up after S seconds without an answer.", parse=positive, default=5.0)
horizon_option = option("--horizon S", "The horizon t_m, in seconds.", type=float, required=True)
sample_period_option = option("--sample-period S", "The time between two samples, in seconds.", default=0.05)
start_option = option("--start SNAPSHOT", "Take s0 from this file instead of the defaults.", parse=parse_snapshot)
