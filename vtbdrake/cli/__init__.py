"""The command line: the program ``vtbdrake``, and the error handling of its commands."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module, metadata
from typing import IO, Any

import click
from click.shell_completion import add_completion_class

from vtbdrake.cli.completion import ColonBash
from vtbdrake.failures import one_line

__all__ = ["BAD_INPUT", "FAILED", "BadInputError", "FailedError", "json_requested", "main"]

BAD_INPUT = 2
FAILED = 1

# Each command is imported when it is used: `run` on a robot does not load the optimizers of `study`.
_COMMANDS = {
    "boundary": "problem:boundary",
    "calibrate": "calibrate:calibrate",
    "campaign": "campaign:campaign",
    "completion": "completion:completion",
    "diagram": "testbed:diagram",
    "doctor": "doctor:doctor",
    "export": "log:export",
    "get": "live:get",
    "hub": "hub:hub",
    "machine": "machine:machine",
    "new": "new:new",
    "open": "open:open_",
    "replay": "log:replay",
    "reset": "live:reset",
    "rollout": "testbed:rollout",
    "run": "run:run",
    "set": "live:set_",
    "study": "study:study",
    "sweep": "problem:sweep",
    "variables": "testbed:variables",
    "view": "view:view",
    "watch": "live:watch",
}

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

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in _COMMANDS:
            return None
        module, _, function = _COMMANDS[name].partition(":")
        command: click.Command = getattr(import_module(f"vtbdrake.cli.{module}"), function)
        return command

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
        # Of vtbdrake's own classes, it is about what was tried and failed.
        if ctx.params.get("traceback") or not type(error).__module__.startswith("vtbdrake."):
            raise
        raise FailedError(one_line(error)) from error


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

    A SCENARIO is package.module:Class, or package.module:Class@FILE with its fields in a YAML file. Modules are looked
    for in the current directory last.

    \b
    Example:
      vtbdrake variables vtbdrake_diagrams.space_climber:SpaceClimberScenario --match mass
    """
    logging.getLogger("drake").setLevel(logging.WARNING)
    # Last, so that a file in the current directory cannot take the place of an installed module.
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
