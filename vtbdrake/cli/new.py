"""``vtbdrake new``: a project for a robot, from its model file."""

from __future__ import annotations

from pathlib import Path

import click

from vtbdrake.cli.options import option, package_option
from vtbdrake.cli.output import emit, json_option, say


def _next_commands(name: str, *, has_fixed_base: bool) -> list[tuple[str, str]]:
    calibration = ("vtbdrake calibrate --help", "fit drives and masses to a log, see README.md")
    return [
        (f"cd {name}", "the project's folder"),
        ('pip install -e ".[test]"', f"its short name, {name}, for the commands below"),
        ("python -m pytest", "its tests"),
        (f"vtbdrake view {name}", "watch and steer it in a browser"),
        (f"vtbdrake rollout {name} --horizon 3", "simulate it"),
        (f"python -m {name}.optimize", "the best gains"),
        (f"python -m {name}.drive", "drive a simulated machine"),
        *([calibration] if has_fixed_base else []),
    ]


@click.command()
@click.argument("name")
@option("--urdf FILE", "The robot: a URDF, SDF or MJCF file, or package://...  [default: a small arm]", name="file")
@package_option
@option("--station FILE", "Instead of a robot, a station: a YAML file of Drake's hardware_sim, or FILE#KEY.")
@json_option
def new(name: str, file: str | None, packages: tuple[tuple[str, Path], ...], station: str | None) -> None:
    """Write a project for a robot into the new folder NAME.

    It has a testbed with a controller that holds the robot, sensors, tests, an optimization of the gains, a run on a
    simulated machine, a notebook, a README and a CI file. Limits that the model file does not give are assumed, and
    printed first.

    \b
    Example:
      vtbdrake new arm --urdf my_arm.urdf
      vtbdrake new arm --urdf my_arm.urdf --package my_arm_description=../my_arm_description
      vtbdrake new lab --station my_station.yaml#Demo
    """
    from vtbdrake.project import SMALL_ARM, ProjectRobot, check_name, read_robot, read_station, resolve, write_project

    if packages and station:
        raise click.UsageError("--package goes with --urdf: a station's packages are on the ROS_PACKAGE_PATH")
    if file and station:
        raise click.UsageError("a project is for a robot (--urdf) or for a station (--station), not for both")
    folder = Path.cwd()
    check_name(name, folder)
    source = read_station(station) if station else read_robot(resolve(file) if file else SMALL_ARM, dict(packages))
    project = write_project(folder, name, source)
    assumptions = source.assumptions if isinstance(source, ProjectRobot) else []
    for assumption in assumptions:
        click.echo(f"assumed: {assumption}", err=True)
    for note in source.notes:
        click.echo(f"note: {note}", err=True)
    say(f"{project.name}/ written, for {source}. Next:")
    is_arm = isinstance(source, ProjectRobot) and source.flying is None and source.standing is None
    for command, purpose in _next_commands(name, has_fixed_base=is_arm):
        say(f"  {command:<38} # {purpose}")
    emit({"folder": project, "source": source, "assumptions": assumptions, "notes": source.notes})
