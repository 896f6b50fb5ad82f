"""The program's frame: the group of commands, and what becomes of errors."""

from __future__ import annotations

import logging
import os
import sys
from importlib import import_module, metadata
from typing import Any

import click

BAD_INPUT = 2
FAILED = 1

# What vtbdrake raises about what it was given: all its own errors about input are ValueErrors. An extra that is not
# installed is a ModuleNotFoundError that names it.
EXPECTED = (ValueError, OSError, ModuleNotFoundError)


class BadInputError(click.ClickException):
    """The program was given something that it cannot use."""

    exit_code = BAD_INPUT


class FailedError(click.ClickException):
    """What was asked for was tried, and failed."""

    exit_code = FAILED


class Commands(click.Group):
    """A group that reports every expected error as one line ``Error: ...``; see `BAD_INPUT` and `FAILED`.

    Attributes:
        homes: name of a command -> ``module:function``. Each is imported when it is called for: the one that runs on a
            robot does not carry the optimizers of the others.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.homes: dict[str, str] = {}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(self.homes)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in self.homes:
            return None
        module, _, function = self.homes[name].partition(":")
        command: click.Command = getattr(import_module(module), function)
        return command

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except click.UsageError as error:
            path = error.ctx.command_path if error.ctx is not None else ctx.command_path
            raise BadInputError(one_line(f"{error.format_message()} ('{path} --help' shows an example)")) from error
        except EXPECTED as error:
            _reraise_if_asked(ctx)
            raise BadInputError(one_line(error)) from error
        except RuntimeError as error:
            if not _is_worker_error(error):
                raise
            _reraise_if_asked(ctx)
            raise FailedError(one_line(error)) from error


def _is_worker_error(error: RuntimeError) -> bool:
    from vtbdrake.rollout import WorkerError

    return isinstance(error, WorkerError)


def one_line(error: object) -> str:
    """The text of an error, without its line breaks."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def _reraise_if_asked(ctx: click.Context) -> None:
    if ctx.params["traceback"]:
        raise


def _print_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        try:
            click.echo(f"vtbdrake {metadata.version('vtbdrake')}")
        except metadata.PackageNotFoundError:
            click.echo("vtbdrake, not installed but run from its folder")
        ctx.exit()


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--traceback", is_flag=True, help="Show where in the code an error comes from.")
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Show it.")
def main(traceback: bool) -> None:
    """Virtual testbeds on Drake: look at one, simulate it, ask it questions.

    A SCENARIO is package.module:Class, or package.module:Class@FILE with its fields in a YAML file. Its module is
    looked for in the current directory last.

    \b
    Example:
      vtbdrake variables diagrams.space_climber:SpaceClimberScenario --match mass
    """
    logging.getLogger("drake").setLevel(logging.WARNING)
    # Last: what lies here by chance, or came with somebody's log, must not take the place of an installed module.
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
