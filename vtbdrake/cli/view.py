"""``vtbdrake view``: watch and steer a testbed in a web browser."""

from __future__ import annotations

import importlib
import re
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli.log import opened_log
from vtbdrake.cli.options import (
    Setting,
    grouped,
    option,
    package_option,
    parse_url,
    scenario_argument,
    set_option,
    settings,
    start_option,
    trust_option,
)
from vtbdrake.cli.output import json_option, say, show
from vtbdrake.cli.page import browser_option, page_options, serve
from vtbdrake.cli.problem import parse_problem

if TYPE_CHECKING:
    from vtbdrake.optimization import Problem, ProblemFile
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario
    from vtbdrake.web.live.session import Session

# The suffixes of model files: URDF, SDF, MJCF, and model directives of Drake.
_MODEL_SUFFIXES = (".urdf", ".sdf", ".xml", ".dmd.yaml", ".dmd.yml")
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


def _named_problem(text: str) -> Problem:
    """Return the problem ``module:name``, or what the function of that name returns."""
    from vtbdrake.optimization import Problem

    module_name, _, name = text.partition(":")
    if not (module_name and name):
        raise click.BadParameter(f"expected MODULE:NAME, a Problem or a function that returns one, not {text!r}")
    try:
        problem = getattr(importlib.import_module(module_name), name, None)
    except ImportError as error:
        raise click.BadParameter(f"cannot import {module_name}: {error}") from error
    problem = problem() if callable(problem) else problem
    if not isinstance(problem, Problem):
        raise click.BadParameter(f"{text} is no Problem, and no function that returns one")
    return problem


def _parse_viewed(text: str) -> Scenario | ProblemFile:
    """Load a scenario, a model, a station or the file of a problem.

    The error about a problem in Python tells how it is shown.
    """
    from vtbdrake.testbed import ScenarioError

    if text.lower().endswith(_MODEL_SUFFIXES) or _is_station(text):
        from vtbdrake.project import ModelFileScenario

        return ModelFileScenario.of(text)
    try:
        return parse_problem(text, trusted=click.get_current_context().params.get("trusted", ()))
    except ScenarioError as error:
        if text.endswith(".py"):
            example = f"SCENARIO --problem {Path(text).stem}:NAME"
        elif _is_problem(text):
            example = f"SCENARIO --problem {text}"
        else:
            raise
        raise click.BadParameter(f"{error}. A problem in Python is shown with its scenario: {example}") from error


def _is_station(text: str) -> bool:
    """Return whether ``FILE.yaml`` or ``FILE.yaml#KEY`` is a file of Drake's hardware_sim."""
    path = Path(text if Path(text).exists() else text.rpartition("#")[0])
    is_yaml = path.suffix in (".yaml", ".yml") and path.is_file()
    return is_yaml and re.search(r"^\s+directives:", path.read_text("utf-8", "replace"), re.MULTILINE) is not None


def _is_problem(text: str) -> bool:
    from vtbdrake.optimization import Problem

    module_name, _, name = text.partition(":")
    return isinstance(getattr(sys.modules.get(module_name), name, None), Problem)


@click.command()
@partial(scenario_argument, parse=_parse_viewed, metavar="SCENARIO|MODEL|STATION.yaml|PROBLEM.yaml")
@set_option
@start_option
@option(
    "--problem MODULE:NAME",
    "The problem of the scenario whose f judges what is driven by hand; or a function that makes it.",
    parse=_named_problem,
)
@option(
    "--study FILE",
    "The study in which the page stores drives, marked as driven. Without --problem, the page has the study's problem.",
    type=click.Path(dir_okay=False, path_type=Path),
)
@option(
    "--log FILE",
    "Replay this log of the scenario, or run its DPS on one of lcm-logger; what is changed goes on in simulation.",
    type=_FILE,
)
@option(
    "--save-in FOLDER",
    "The folder of the tests that the page saves.",
    name="folder",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    default=".",
)
@trust_option
@page_options
@option("--vr", "Let headsets that open the page lead the robot by a hand.", is_flag=True)
@option(
    "--url URL",
    "The LCM bus of a loop (vtbdrake run), which is shown instead of a simulation; with --vr, hands lead its robot.",
    parse=parse_url,
)
@option("--tls NAME", "Serve the page by https, at this name or address of this machine, to its network.")
@option("--certificate FILE", "With --tls, a certificate (PEM); one is made if it is left out.", type=_FILE)
@option("--key FILE", "With --certificate, its private key (PEM).", type=_FILE)
@package_option
@grouped(
    "viewers",
    option("--foxglove", "Serve what is shown to Foxglove, too, on this machine alone.", is_flag=True),
    option("--rerun", "Serve what is shown to viewers of Rerun, too, on this machine alone.", is_flag=True),
)
@option("--play", "Let time run at once.", is_flag=True)
@browser_option
@json_option
def view(
    scenario: Scenario | ProblemFile,
    values: tuple[Setting, ...],
    start: Snapshot | None,
    problem: Problem | None,
    study: Path | None,
    log: Path | None,
    folder: Path,
    trusted: tuple[str, ...],
    page: dict[str, Any],
    vr: bool,
    url: str | None,
    tls: str | None,
    certificate: Path | None,
    key: Path | None,
    packages: tuple[tuple[str, Path], ...],
    viewers: dict[str, bool],
    play: bool,
    browser: bool,
) -> None:
    """Watch and steer a testbed in a web browser, until Ctrl-C.

    The page is served on this machine alone, unless --tls is given. An address is good for one browser, which can steer
    the testbed. The module of a scenario that is named here is imported, which runs its code; modules that PROBLEM.yaml
    or the study names are not, unless --trust names them.

    A model file (URDF, SDF, MJCF, model directives) or a station is shown as it is, with a command for each joint.

    \b
    Example:
      vtbdrake view cart_pole
      vtbdrake view arm.urdf
      vtbdrake view station.yaml#Demo
      vtbdrake view cart_pole --url tcpq://127.0.0.1:7700
      vtbdrake view manipulator --log arm.lcm
      vtbdrake view manipulator --foxglove --play
    """
    from vtbdrake.recording import Log
    from vtbdrake.testbed import Scenario
    from vtbdrake.web import view as open_view
    from vtbdrake.web import view_loop
    from vtbdrake.web.serving.tls import Tls

    if (certificate or key) and not tls:
        raise click.UsageError("--certificate and --key go with --tls")
    if packages:
        if not isinstance(scenario, Scenario) or not hasattr(scenario, "packages"):
            raise click.UsageError("--package goes with a model file or a station")
        scenario.packages = {**scenario.packages, **{name: str(folder) for name, folder in packages}}
    if not isinstance(scenario, Scenario):
        if problem is not None:
            raise click.UsageError(f"{scenario.path} is a problem already: leave --problem out")
        problem, scenario = scenario.problem, scenario.problem.scenario
    page |= {"vr": vr, "tls": Tls(name=tls, certificate=certificate, key=key) if tls else None}
    if url:
        if values or start is not None or play or any((problem, study, log)):
            raise click.UsageError(
                "a loop is shown as it is: leave --set, --start, --play, --problem, --study and --log out, or --url"
            )
        with view_loop(scenario, url, **page) as watched:
            _mirror(watched.session, **viewers)
            serve(watched, browser=browser)
        return
    viewed: Scenario | None = scenario
    if log is not None:
        if values or start is not None or vr:
            raise click.UsageError("--log replays what was recorded: leave out --set, --start and --vr")
        opened = opened_log(log, scenario)
        page |= {"log": opened}
        if isinstance(opened, Log):
            say(str(opened))
        elif scenario.record() == type(scenario)().record():
            viewed = None  # The log describes its scenario; fields that were set have to be the recorded ones.
    page |= {"problem": problem, "study": study, "trusted": trusted, "folder": folder}
    with open_view(viewed, start=start, values=settings(values), **page) as running:
        _mirror(running.session, **viewers)
        serve(running, browser=browser, ready=running.session.play if play else None)


def _mirror(session: Session[Any], *, foxglove: bool, rerun: bool) -> None:
    """Show a session in Foxglove and Rerun, too, and say where."""
    if foxglove:
        from vtbdrake.visualization import FoxgloveServer

        server = FoxgloveServer()
        session.mirror(server)
        show(f"for Foxglove, open the connection {server.address}", {"foxglove": server.address})
    if rerun:
        from vtbdrake.visualization import RerunServer

        hub = RerunServer()
        session.mirror(hub)
        show(f"for Rerun: rerun {hub.address}", {"rerun": hub.address})
