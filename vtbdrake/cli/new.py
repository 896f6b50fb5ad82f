"""``vtbdrake new``: a project for a robot, from its model file."""

from __future__ import annotations

from pathlib import Path

import click

from vtbdrake.cli.options import option


@click.command()
@click.argument("name")
@option("--urdf FILE", "The robot: a URDF, SDF or MJCF file, or package://...  [default: a small arm]", name="file")
def new(name: str, file: str | None) -> None:
    """Write a project for a robot into the new folder NAME.

    It has a testbed with a controller that holds the robot, sensors, tests, an optimization of the gains, a run on a
    simulated machine, a notebook, a README and a CI file. What the model file leaves out is assumed, and printed.

    \b
    Example:
      vtbdrake new arm --urdf my_arm.urdf
    """
    from vtbdrake.project import SMALL_ARM, check_name, read_robot, resolve, write_project

    folder = Path.cwd()
    check_name(name, folder)
    robot = read_robot(resolve(file) if file else SMALL_ARM)
    project = write_project(folder, name, robot)
    for note in robot.notes:
        click.echo(f"note: {note}", err=True)
    drives = f"{len(robot.driven)} of {len(robot.joints)} joints driven"
    click.echo(f"{project.name}/ written, {drives}. Next:")
    click.echo(f"  cd {name}")
    click.echo("  python -m pytest")
    click.echo(f"  python -m {name}.drive")
