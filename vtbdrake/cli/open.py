"""``vtbdrake open``: look at a snapshot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli.completion import complete_file
from vtbdrake.cli.options import converted, option, output, parse_scenario, parse_snapshot
from vtbdrake.cli.output import json_option, show, write_whole
from vtbdrake.cli.page import browser_option, page_options, serve

if TYPE_CHECKING:
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario


@click.command("open")
@click.argument("snapshot", metavar="FILE.vtb", callback=converted(parse_snapshot), shell_complete=complete_file)
@option(
    "--scenario SCENARIO",
    "The scenario, if it is not one of vtbdrake's: MODULE:CLASS or MODULE:CLASS@FILE.yaml.",
    parse=parse_scenario,
)
@option(
    "-o --output FILE",
    "Write a picture (.png) or a page (.html) instead, without a server.",
    name="out",
    parse=output(".png", ".html"),
)
@page_options
@browser_option
@json_option
def open_(snapshot: Snapshot, scenario: Scenario | None, out: Path | None, page: dict[str, Any], browser: bool) -> None:
    """Look at a snapshot, and go on from there, until Ctrl-C.

    A snapshot is what the page of vtbdrake view saves, and it is seen from the camera of that page; or what
    vtbdrake rollout --snapshot or snapshot.save(FILE) has written.

    \b
    Example:
      vtbdrake open pole.vtb
    """
    from vtbdrake.testbed.scenario_file import scenario_of

    scenario = scenario_of(snapshot.scenario, base=scenario)
    if out is None:
        from vtbdrake.web import view

        with view(scenario, start=snapshot, **page) as running:
            serve(running, browser=browser)
    else:
        _write(scenario, snapshot, out)
        show(f"Wrote {out}.", {"output": str(out), "time": snapshot.time, "scenario": scenario.name()})


def _write(scenario: Scenario, snapshot: Snapshot, out: Path) -> None:
    from vtbdrake.visualization import Scene, make_meshcat
    from vtbdrake.visualization.drawing import Drawing
    from vtbdrake.visualization.viewpoint import camera_of

    testbed, camera = scenario.build(), camera_of(snapshot)
    context = testbed.default_context()
    testbed.restore(context, snapshot)
    meshcat = make_meshcat()
    drawing = Drawing(meshcat, testbed, context, "now")
    if out.suffix == ".png":
        write_whole(out, drawing.still(context, camera).png())
    else:
        drawing.fit_camera(context, camera)
        Scene(meshcat, title=f"{type(scenario).__name__}, t = {snapshot.time:g} s").save(out)
