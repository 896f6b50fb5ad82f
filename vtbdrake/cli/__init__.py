"""The command line: the program ``vtbdrake``, and the error handling of its commands."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module, metadata
from typing import IO, Any

import click
from click.shell_completion import add_completion_class

from vtbdrake.cli.completion import ColonBash
from vtbdrake.common.failures import one_line
from vtbdrake.common.interrupt import end_at_interrupt, end_soon_if_interrupted, is_interrupted
from vtbdrake.common.quick_exit import quick_exit
from vtbdrake.common.suggestions import did_you_mean

__all__ = ["BAD_INPUT", "FAILED", "BadInputError", "FailedError", "json_requested", "main"]

BAD_INPUT = 2
FAILED = 1

# Each command is imported when it is used: `run` on a robot does not load the optimizers of `study`.
_GROUPS = {
    "Look": {
        "examples": "examples:examples",
        "view": "view:view",
        "open": "open:open_",
        "variables": "testbed:variables",
        "rollout": "testbed:rollout",
        "diagram": "testbed:diagram",
    },
    "Optimize": {
        "sweep": "problem:sweep",
        "boundary": "problem:boundary",
        "study": "study:study",
        "campaign": "campaign:campaign",
        "calibrate": "calibrate:calibrate",
    },
    "Machine": {
        "run": "run:run",
        "machine": "machine:machine",
        "hub": "hub:hub",
        "get": "live:get",
        "set": "live:set_",
        "watch": "live:watch",
        "reset": "live:reset",
        "replay": "log:replay",
        "export": "log:export",
        "export-fmu": "fmu:export_fmu",
    },
    "Project": {
        "new": "new:new",
        "doctor": "doctor:doctor",
        "completion": "completion:completion",
    },
}
_COMMANDS = {name: place for group in _GROUPS.values() for name, place in group.items()}

# All errors of vtbdrake about bad input are ValueErrors. A missing extra is a ModuleNotFoundError that names it.
_EXPECTED = (ValueError, OSError, ModuleNotFoundError)


add_completion_class(ColonBash)
_CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True}


_JSON = "vtbdrake.json"


def json_requested() -> bool:
    """Return whether the running command has the option ``--json``."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(_JSON))


class _Error(click.ClickException):
    """An error that is printed on stderr: as one line ``Error: ...``, or with ``--json`` as an object."""

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self._as_json = json_requested()  # There is no context when it is printed.

    def show(self, file: IO[Any] | None = None) -> None:
        if self._as_json:
            described = {"error": self.format_message(), "exit_code": self.exit_code}
            click.echo(json.dumps(described), file=file, err=file is None)
        else:
            super().show(file)


class BadInputError(_Error):
    """The program cannot use its input."""

    exit_code = BAD_INPUT


class FailedError(_Error):
    """The program tried to do what the user asked for, and failed."""

    exit_code = FAILED


class _Commands(click.Group):
    """A group that reports every expected error as one line ``Error: ...``, with exit code 2 or 1."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Be the program, which one Ctrl-C ends in any state."""
        with suppress(ImportError):  # `doctor` says that the compiled modules are missing.
            end_at_interrupt(FAILED)
        try:
            return super().__call__(*args, **kwargs)
        except SystemExit as end:
            end_soon_if_interrupted()
            if not args and isinstance(end.code, int):
                quick_exit(end.code)
            raise
        finally:
            end_soon_if_interrupted()

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in _COMMANDS:
            return None
        module, _, function = _COMMANDS[name].partition(":")
        command: click.Command = getattr(import_module(f"vtbdrake.cli.{module}"), function)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in _COMMANDS and not ctx.resilient_parsing:
            near = did_you_mean(args[0], _COMMANDS) or f"; the commands are {', '.join(sorted(_COMMANDS))}"
            raise click.UsageError(f"No such command {args[0]!r}{near}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands of each group below its heading, with whole summaries."""
        widest = max(map(len, _COMMANDS))
        for heading, names in _GROUPS.items():
            with formatter.section(heading):
                summaries = [(name, self.get_command(ctx, name)) for name in names]
                formatter.write_dl(
                    [(f"{name:{widest}}", command.get_short_help_str(200)) for name, command in summaries if command]
                )

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # Looked for here, because an error in the options comes before their values are known.
        words = args[: args.index("--")] if "--" in args else args
        ctx.meta[_JSON] = "--json" in words
        with _reported(ctx):
            return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        with _reported(ctx):
            return super().invoke(ctx)


@contextmanager
def _reported(ctx: click.Context) -> Iterator[None]:
    """Turn every expected error into a `BadInputError` or `FailedError`."""
    try:
        with _interruption_first():
            yield
    except click.exceptions.NoArgsIsHelpError:
        raise
    except (KeyboardInterrupt, click.Abort) as error:
        if not json_requested():
            raise
        raise FailedError("interrupted") from error
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx is not None else ctx.command_path
        raise BadInputError(one_line(f"{error.format_message()} ('{path} --help' shows an example)")) from error
    except _EXPECTED as error:
        if ctx.params.get("traceback"):
            raise
        raise BadInputError(one_line(error)) from error
    except RuntimeError as error:
        # An error of vtbdrake's own classes says what was tried and failed.
        if ctx.params.get("traceback") or not type(error).__module__.startswith("vtbdrake."):
            raise
        raise FailedError(one_line(error)) from error


@contextmanager
def _interruption_first() -> Iterator[None]:
    """Raise Abort where code has turned a KeyboardInterrupt into another error, such as an extension's ImportError.

    What a command itself says at its end is not replaced: that the fallbacks took over, before Ctrl-C.
    """
    try:
        yield
    except (click.exceptions.Exit, FailedError):
        raise
    except Exception as error:
        if is_interrupted():
            raise click.Abort from error
        raise


def _print_version(ctx: click.Context, _: click.Parameter, is_requested: bool) -> None:
    if is_requested and not ctx.resilient_parsing:
        try:
            click.echo(f"vtbdrake {metadata.version('vtbdrake')}")
        except metadata.PackageNotFoundError:
            click.echo("vtbdrake, not installed but run from its folder")
        ctx.exit()


@click.group(cls=_Commands, context_settings=_CONTEXT)
@click.option("--traceback", is_flag=True, help="Show the Python traceback of an error.")
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Show the version."
)
def main(traceback: bool) -> None:
    """Virtual testbeds on Drake: look at one, simulate it, optimize it, run its controller on a machine.

    A SCENARIO is a name that `vtbdrake examples` lists, package.module:Class or file.py:Class; with @FILE behind it,
    its fields come from a YAML file. Modules are looked for in the current directory last.

    \b
    Example:
      vtbdrake view cart_pole
      vtbdrake variables space_climber --match mass
    """
    logging.getLogger("drake").setLevel(logging.WARNING)
    # Last, so that a file in the current directory cannot take the place of an installed module.
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
