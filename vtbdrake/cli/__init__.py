"""The command line: the program ``vtbdrake``, and the error handling of its commands."""

from __future__ import annotations

import logging
import os
import sys
from importlib import import_module, metadata
from typing import Any

import click

from vtbdrake.failures import one_line

__all__ = ["BAD_INPUT", "FAILED", "BadInputError", "FailedError", "main"]

BAD_INPUT = 2
FAILED = 1

# Each command is imported when it is used: `run` on a robot does not load the optimizers of `study`.
_COMMANDS = {
    "boundary": "problem:boundary",
    "calibrate": "calibrate:calibrate",
    "campaign": "campaign:campaign",
    "diagram": "testbed:diagram",
    "doctor": "doctor:doctor",
    "export": "log:export",
    "get": "live:get",
    "hub": "hub:hub",
    "machine": "machine:machine",
    "new": "new:new",
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


_CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True}


class BadInputError(click.ClickException):
    """The program cannot use its input."""

    exit_code = BAD_INPUT


class FailedError(click.ClickException):
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

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except click.UsageError as error:
            path = error.ctx.command_path if error.ctx is not None else ctx.command_path
            raise BadInputError(one_line(f"{error.format_message()} ('{path} --help' shows an example)")) from error
        except _EXPECTED as error:
            if ctx.params["traceback"]:
                raise
            raise BadInputError(one_line(error)) from error
        except RuntimeError as error:
            from vtbdrake.rollout import WorkerError

            if ctx.params["traceback"] or not isinstance(error, WorkerError):
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
