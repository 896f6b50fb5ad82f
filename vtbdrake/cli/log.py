"""``vtbdrake replay`` and ``export``: the log of a control loop, computed again or in formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli import FailedError
from vtbdrake.cli.completion import complete_file, complete_scenario
from vtbdrake.cli.options import (
    Setting,
    converted,
    film_option,
    import_option,
    option,
    output,
    parse_scenario,
    set_option,
    settings,
)
from vtbdrake.cli.output import RECORDINGS, json_option, save_recording, say, show
from vtbdrake.common.failures import one_line

if TYPE_CHECKING:
    from vtbdrake.recording import ControlLog, Log
    from vtbdrake.testbed import Scenario


def loop_log(log: Path, scenario: str | None) -> ControlLog:
    """Return the log of a loop, whose scenario the user has named, since importing it runs its code.

    Args:
        log: The file of the log.
        scenario: The scenario that the user has named: a short name, ``MODULE:CLASS`` or ``FILE.py:CLASS``; None if
            none was named.

    Raises:
        click.UsageError: The scenario is another one, or was not named.
        LogError: The file is no log, or of a script or a notebook.
    """
    from vtbdrake.common.scenario_names import ScenarioNameError, full_name, importable_name
    from vtbdrake.recording import read_log
    from vtbdrake.testbed.scenario import class_name
    from vtbdrake.testbed.scenario_file import scenario_class

    opened = read_log(log)
    recorded = opened.header.scenario_name
    if opened.header.of_main_module:
        opened.header.make_scenario()  # It raises: the class is in a script or a notebook.
    if scenario is None and recorded:
        raise click.UsageError(
            f"{log} is of the scenario {recorded}, and importing that runs its code: if you trust it, add "
            f"--scenario {recorded}"
        )
    if scenario is not None:
        try:
            named = importable_name(full_name(scenario))
        except ScenarioNameError as error:
            raise click.UsageError(str(error)) from error
        if (requested := class_name(scenario_class(named))) != recorded:
            raise click.UsageError(f"{log} is of the scenario {recorded or '(unknown)'}, not of {requested}")
    return opened


def opened_log(log: Path, scenario: Scenario) -> ControlLog | Log:
    """Return the log of a loop, which has to be of this scenario, or the signals in a log of another program.

    Args:
        log: The file of the log.
        scenario: The scenario that the user has named.

    Raises:
        click.UsageError: The log of a loop is of another scenario.
        LogError: The file is no log, has no signal of the scenario, or is of a script or a notebook.
        ProtocolError: The scenario has no protocol, by which the log of another program could be read.
    """
    from vtbdrake.recording import read_log
    from vtbdrake.recording.log_events import LogEvents

    return loop_log(log, scenario.name()) if LogEvents(log).of_loop else read_log(log, scenario)


_log = click.argument("log", type=click.Path(dir_okay=False, path_type=Path))


@click.command()
@_log
@option(
    "--scenario MODULE:CLASS",
    "The scenario of the log, whose fields are in the log. Its code runs, so the user has to name it.",
    shell_complete=complete_scenario,
)
@import_option
@option(
    "--on",
    "Replay the recorded system: the DPS alone, or the whole testbed.",
    type=click.Choice(["recorded", "dps", "testbed"]),
    default="recorded",
)
@set_option
@option("--record ADDRESS", "Read ADDRESS after every cycle. May be repeated.", multiple=True)
@option("--out FILE", "Write these values: .csv or .npz.", parse=output(*RECORDINGS))
@film_option
@json_option
def replay(
    log: Path,
    scenario: str | None,
    on: str,
    values: tuple[Setting, ...],
    record: tuple[str, ...],
    out: Path | None,
    film: Path | None,
) -> None:
    """Compute a LOG again and compare, to the last bit.

    The exit code is 1 unless all actuator commands are the same. It is 1 as well if the log is not whole: cut off,
    damaged, or of a loop whose recorder was not closed.

    With --set, a variable has another value throughout, and nothing is compared.

    With --film, the film shows the simulated world; of a DPS alone, the world as it believed it to be.

    \b
    Example:
      vtbdrake replay run.lcm --scenario manipulator
    """
    from vtbdrake.recording.replay import DIFFERENT
    from vtbdrake.recording.replay import replay as replay_log
    from vtbdrake.state.archive import PRIVATE
    from vtbdrake.testbed import DpsAlone

    if bool(record) != bool(out):
        raise click.UsageError("--record ADDRESS and --out FILE belong together: give both or neither")
    opened = loop_log(log, scenario)
    target = None if on == "recorded" else DpsAlone(opened.scenario) if on == "dps" else opened.scenario.build()
    report = replay_log(opened, target, values=settings(values), record=record)
    if out is not None:
        save_recording(out, report.times, report.record, mode=PRIVATE)
    if film is not None:
        from vtbdrake.visualization import log_motion, make_meshcat, show_motion

        show_motion(make_meshcat(), log_motion(opened)).film(film)
    described: dict[str, Any] = {name: getattr(report, name) for name in ("outcome", "cycles", "digests", "ended")}
    described |= {"first_difference": report.first_difference, "max_difference": report.max_difference}
    described |= {"errors": report.errors, "versions": report.versions}
    show(report, described)
    if report.outcome == DIFFERENT:
        raise FailedError(one_line(f"the replay differs: {report.first_difference}"))
    if report.ended and not values:
        raise FailedError(f"not everything was compared: {report.ended}")


# The suffixes of scenes, as `vtbdrake.visualization.scenes` writes them.
_SCENES = (".mcap", ".rrd")


def _parse_export(text: str) -> Path:
    from vtbdrake.recording.export import EXPORTS

    return output(*EXPORTS, *_SCENES)(text)


@click.command()
@_log
@click.argument("out", callback=converted(_parse_export), shell_complete=complete_file)
@option(
    "--scenario SCENARIO",
    "The scenario of the log: its world is in a scene; a log of another program is read through its protocol.",
    parse=parse_scenario,
)
@option(
    "--rate HZ", "States of the world per second in a scene; 30 by default.", type=click.FloatRange(0.0, min_open=True)
)
@option("--no-images", "Leave images and scans out of a scene.", is_flag=True)
@json_option
def export(log: Path, out: Path, scenario: Scenario | None, rate: float | None, no_images: bool) -> None:
    """Write a LOG as CSV, Parquet, or a scene for viewers (MCAP, .rrd).

    The suffix of OUT says which: scenes are for Foxglove (MCAP) and Rerun (.rrd). A scene has the signals and events of
    the log. With --scenario, whose code runs, it also has the world, which a replay of the log computes. A log of
    lcm-logger needs the scenario of its machine, and has signals alone.

    \b
    Example:
      vtbdrake export run.lcm run.parquet
      vtbdrake export run.lcm run.mcap --scenario manipulator
      vtbdrake export run.lcm run.rrd --scenario manipulator
      vtbdrake export lcmlog-2026-11-29.00 run.csv --scenario cart_pole
    """
    from vtbdrake.recording import Log, read_log
    from vtbdrake.recording.export import export as export_log

    if out.suffix not in _SCENES and (rate is not None or no_images):
        raise click.UsageError(
            f"--rate and --no-images go with a scene ({' or '.join(_SCENES)}), not with {out.suffix}"
        )
    opened = read_log(log) if scenario is None else opened_log(log, scenario)
    if out.suffix in _SCENES:
        from vtbdrake.visualization import write_scene

        write_scene(opened, out, rate=rate or 30.0, images=not no_images, world=scenario is not None)
    else:
        export_log(opened, out)
    if isinstance(opened, Log):
        show(opened, {"file": out, "sense": [*opened.sense], "act": [*opened.act], "remarks": opened.remarks})
        return
    described = {"cycles": len(opened), "period": opened.header.period, "incomplete": opened.incomplete}
    show(opened, {"file": out, "scenario": opened.header.scenario_name, **described})
    if out.suffix in _SCENES and scenario is None:
        name = opened.header.scenario_name
        say(f"the file has no world: to compute it, which runs the scenario's code, add --scenario {name}")
