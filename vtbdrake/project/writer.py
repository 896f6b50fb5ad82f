"""Projects from templates: plain Python files in which names and the joints of a robot are filled in."""

from __future__ import annotations

import json
import keyword
import os
import shutil
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from string import Template

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.project.robot_file import PRISMATIC, Robot, RobotJoint
from vtbdrake.project.station_file import StationFile

TEMPLATES = Path(__file__).parent / "templates"
# Template -> file of the project.
_COMMON = {
    "pyproject.toml": "pyproject.toml",
    "gitignore": ".gitignore",
    "ci.yml": ".github/workflows/tests.yml",
    "notebook.ipynb": "{name}.ipynb",
    "package/__init__.py": "{name}/__init__.py",
    "package/drive.py": "{name}/drive.py",
}
_ROBOT = {
    **_COMMON,
    "README.md": "README.md",
    "test.py": "tests/test_{name}.py",
    **{f"package/{file}.py": f"{{name}}/{file}.py" for file in ("robot", "dps", "scenario", "optimize")},
}
_STATION = {
    **_COMMON,
    "station/README.md": "README.md",
    "station/test.py": "tests/test_{name}.py",
    **{f"station/{file}.py": f"{{name}}/{file}.py" for file in ("dps", "scenario", "optimize")},
}
_LONGEST_LINE = 120


class ProjectError(ValueError):
    """A project cannot be written under a name; the message says why."""


def check_name(name: str, folder: Path) -> None:
    """Check that a project may be written as ``folder/name``, with a Python package of this name.

    Raises:
        ProjectError: The name is no identifier, names another module, or is there already.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or not name.isascii() or name.startswith("_"):
        near = "".join(c if c.isascii() and c.isalnum() else "_" for c in name).strip("_").lower()
        near = near if near.isidentifier() and not keyword.iskeyword(near) else "my_robot"
        raise ProjectError(
            f"the name of a project is that of its Python package: letters, digits and _, as in {near}, not {name!r}"
        )
    if (folder / name).exists() or (folder / name).is_symlink():
        raise ProjectError(f"{folder / name} exists, and is not overwritten: give another name, or remove it")
    if name in ("tests", "test") or find_spec(name) is not None:
        raise ProjectError(
            f"Python has a module {name} already, which the project could not replace: call it my_{name}"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ProjectError(f"{folder} is a folder that you cannot write to: change to one of yours")


def write_project(folder: Path, name: str, source: Robot | StationFile) -> Path:
    """Write a project whole, or not at all, and return its folder.

    Args:
        folder: The folder in which it becomes ``folder/name``.
        name: A name that `check_name` accepts.
        source: The robot, from `read_robot`, or the station, from `read_station`.

    Raises:
        ProjectError: See `check_name`.
    """
    check_name(name, folder)
    if isinstance(source, Robot):
        templates, values, kind = _ROBOT, _robot_values(source), "Scenario"
    else:
        templates, values, kind = _STATION, _station_values(source), "Station"
    values |= {
        "name": name,
        "NAME": name.upper(),
        "Class": "".join(part[:1].upper() + part[1:] for part in name.split("_")) + kind,
        "notes": "".join(["\n## What is assumed\n\n", *(f"* {note}\n" for note in source.notes)])
        if source.notes
        else "",
    }
    with tempfile.TemporaryDirectory(dir=folder, prefix=f".{name}-") as temporary:
        project = Path(temporary) / name
        for template, path in templates.items():
            text = Template((TEMPLATES / f"{template}.template").read_text(encoding="utf-8")).substitute(values)
            file = project / path.format(name=name)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
        for relative, original in source.files.items():
            file = project / name / "models" / relative
            file.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(original, file)
        project.rename(folder / name)
    return folder / name


def _robot_values(robot: Robot) -> dict[str, str]:
    joints = {joint.name: joint for joint in robot.joints}
    drives = [joints[driven] for driven in robot.driven]
    is_exact = len(drives) == len(joints)
    names = ["DRIVEN", "JOINTS", *(["TOUCHING"] if robot.touching else []), "B", "add_robot", "limits"]
    return {
        "subject": "robot",
        "model_file": robot.model.name,
        "model_path": robot.model.as_posix(),
        "robot_imports": _robot_imports(robot),
        "assumed_comment": "\n# What the file does not say is assumed." if any(j.assumed for j in robot.joints) else "",
        "joints": "\n".join(map(_joint, robot.joints)),
        "driven": _list("DRIVEN = ", [json.dumps(name) for name in robot.driven]),
        "away": _list("AWAY = ", [_number(value) for value in robot.away]),
        "B": _motions(robot),
        "couplings": "".join(
            f"B[list(JOINTS).index({json.dumps(c.joint)}), DRIVEN.index({json.dumps(c.leader)})] = "
            f"{_number(c.multiplier)}  # it follows\n"
            for c in robot.couplings
        ),
        "touching": "\n# Bodies that touch each other at home, without contact.\n"
        f"TOUCHING = {_list('TOUCHING = ', [json.dumps(name) for name in robot.touching])}\n"
        if robot.touching
        else "",
        "add_robot": "".join(f"    {line}\n" for line in _add_robot(robot)),
        "without_constraints": "    for constraint in plant.GetConstraintIds():  # which the model does without\n"
        "        plant.RemoveConstraint(constraint)\n"
        if robot.has_constraints
        else "",
        "position_unit": _unit(robot.joints),
        "velocity_unit": _unit(robot.joints, "/s"),
        "driven_unit": _unit(drives),
        # A variable of one entry is a number.
        "entry": "[0]" if len(drives) == 1 else "",
        "driven_position": "np.atleast_1d(position)[INDICES]" if len(joints) == 1 else "position[INDICES]",
        "effort_unit": ", ".join(dict.fromkeys("N" if joint.kind == PRISMATIC else "N m" for joint in drives)),
        "scenario_imports": "from pydrake.geometry import CollisionFilterDeclaration\n" if robot.touching else "",
        "robot_names": ", ".join(names),
        "scene_graph": "scene_graph" if robot.touching else "_",
        "filter": _FILTER if robot.touching else "",
        "tolerance": "0.02" if is_exact else "0.2",
    }


_FILTER = """\
        # Else their contact would push the robot away from home.
        touching = plant.CollectRegisteredGeometries([plant.GetBodyByName(name) for name in TOUCHING])
        scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(touching))
"""


_SELECTION = """\
# The velocities of all joints are B times those of the driven ones.
B = np.array([[float(name == driven) for driven in DRIVEN] for name in JOINTS])
"""


def _motions(robot: Robot) -> str:
    if robot.motions is None:
        return _SELECTION
    rows = [", ".join(map(_number, np.round(row, 3))) for row in robot.motions]
    lines = "".join(f"        [{row}],\n" for row in rows)
    comment = "# Near home, the velocities of all joints are B times those of the driven ones."
    return f"{comment}\nB = np.array(\n    [\n{lines}    ]\n)\n"


def _number(value: float) -> str:
    return repr(float(f"{value:.6g}") + 0.0)


def _joint(joint: RobotJoint) -> str:
    numbers = {"lower": joint.lower, "upper": joint.upper, "speed": joint.speed}
    numbers |= {"effort": joint.effort} if joint.effort else {}
    numbers |= {"home": joint.home} if joint.home else {}
    arguments = ", ".join(f"{field}={_number(value)}" for field, value in numbers.items())
    comment = f"    # assumed: {', '.join(joint.assumed)}\n" if joint.assumed else ""
    return f"{comment}    {json.dumps(joint.name)}: Joint({arguments}),"


def _list(prefix: str, items: Sequence[str]) -> str:
    """Return a list in Python, on one line if it fits behind ``prefix``."""
    line = f"[{', '.join(items)}]"
    if len(prefix) + len(line) <= _LONGEST_LINE:
        return line
    return "[\n" + "".join(f"    {item},\n" for item in items) + "]"


def _unit(joints: Sequence[RobotJoint], per: str = "") -> str:
    return ", ".join(dict.fromkeys(("m" if joint.kind == PRISMATIC else "rad") + per for joint in joints))


def _robot_imports(robot: Robot) -> str:
    moved = any(not _is_identity(X_WB) for X_WB in robot.welded.values())
    lines = ["from pydrake.math import RigidTransform, RollPitchYaw"] if moved else []
    lines += ["from pydrake.multibody.parsing import Parser", "from pydrake.multibody.plant import MultibodyPlant"]
    lines += ["from vtbdrake.project import replace_servo"] if robot.servos else []
    return "".join(f"{line}\n" for line in lines)


def _is_identity(X: RigidTransform) -> bool:
    return bool(X.IsNearlyIdentity(1e-12))


def _add_robot(robot: Robot) -> list[str]:
    """Return the lines that make the plant of the file that of the project."""
    lines = ["Parser(plant).AddModels(str(MODEL))"]
    if robot.packages:
        up = len(robot.model.parts) - 1
        lines = [
            "parser = Parser(plant)",
            f"parser.package_map().PopulateFromFolder(str(MODEL.parents[{up}]))",
            "parser.AddModels(str(MODEL))",
        ]
    for name, X_WB in robot.welded.items():
        pose = "" if _is_identity(X_WB) else ", X_WB"
        lines += [f"X_WB = {_pose(X_WB)}"] if pose else []
        frame = f"plant.GetBodyByName({json.dumps(name)}).body_frame()"
        lines.append(f"plant.WeldFrames(plant.world_frame(), {frame}{pose})")
    lines += [
        f"plant.RemoveJointActuator(plant.GetJointActuatorByName({json.dumps(name)}))  # it follows another joint"
        for name in robot.without_drive
    ]
    if robot.servos:
        lines += [
            f"for name in [{', '.join(json.dumps(name) for name in robot.servos)}]:",
            "    replace_servo(plant, name)  # The DPS commands torques or forces, not positions or velocities.",
        ]
    if robot.adds_drives:
        lines += [
            "for name in DRIVEN:",
            "    plant.AddJointActuator(name, plant.GetJointByName(name), JOINTS[name].effort)",
        ]
    elif robot.sets_efforts:
        lines += [
            "for index in plant.GetJointActuatorIndices():",
            "    drive = plant.get_joint_actuator(index)",
            "    drive.set_effort_limit(JOINTS[drive.joint().name()].effort)",
        ]
    return lines


def _pose(X: RigidTransform) -> str:
    angles, p = RollPitchYaw(X.rotation()).vector(), X.translation()
    numbers = [", ".join(_number(value) for value in np.where(np.abs(v) < 1e-12, 0.0, v)) for v in (angles, p)]
    return f"RigidTransform(RollPitchYaw({numbers[0]}), [{numbers[1]}])"


def _station_values(station: StationFile) -> dict[str, str]:
    path, _, key = station.file.partition("#")
    return {
        "model_file": Path(path).name,
        "subject": "station",
        "position_unit": "rad",
        "station_path": path,
        "station_key": f"#{key}" if key else "",
        "home": "\n".join(f'    "{arm.name}": {_list("", [_number(q) for q in arm.home])},' for arm in station.arms),
        "away": "\n".join(f'    "{arm.name}": {_list("", [_number(q) for q in arm.away])},' for arm in station.arms),
        "opening": json.dumps(station.grippers),
        "period": _number(station.period),
    }
