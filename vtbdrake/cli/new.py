"""``vtbdrake new``: a project for a robot, from its model file."""

from __future__ import annotations

from pathlib import Path

import click

from vtbdrake.cli.options import option
from vtbdrake.cli.output import emit, json_option, say


@click.command()
@click.argument("name")
@option("--urdf FILE", "The robot: a URDF, SDF or MJCF file, or package://...  [default: a small arm]", name="file")
@option("--station FILE", "Instead of a robot, a station: a YAML file of Drake's hardware_sim, or FILE#KEY.")
@json_option
def new(name: str, file: str | None, station: str | None) -> None:
    """Write a project for a robot into the new folder NAME.

    It has a testbed with a controller that holds the robot, sensors, tests, an optimization of the gains, a run on a
    simulated machine, a notebook, a README and a CI file. What the model file leaves out is assumed, and printed.

    \b
    Example:
      vtbdrake new arm --urdf my_arm.urdf
      vtbdrake new lab --station my_station.yaml#Demo
    """
    from vtbdrake.project import SMALL_ARM, check_name, read_robot, read_station, resolve, write_project

    if file and station:
        raise click.UsageError("a project is for a robot (--urdf) or for a station (--station), not for both")
    folder = Path.cwd()
    check_name(name, folder)
    source = read_station(station) if station else read_robot(resolve(file) if file else SMALL_ARM)
    project = write_project(folder, name, source)
    for note in source.notes:
        click.echo(f"note: {note}", err=True)
    say(f"{project.name}/ written, for {source}. Next:")
    say(f"  cd {name}")
    say("  python -m pytest")
    say(f"  python -m {name}.drive")
    emit({"folder": project, "source": source, "notes": source.notes})
