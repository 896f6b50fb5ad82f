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
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.project.robot import PRISMATIC, ProjectRobot, RobotJoint
from vtbdrake.project.rotors import FlyingRobot
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
_LEGGED = {
    **_COMMON,
    "legged/README.md": "README.md",
    "legged/test.py": "tests/test_{name}.py",
    "package/robot.py": "{name}/robot.py",
    **{f"legged/{file}.py": f"{{name}}/{file}.py" for file in ("dps", "scenario", "optimize")},
}
_FLYING = {
    **_COMMON,
    "flying/README.md": "README.md",
    "flying/test.py": "tests/test_{name}.py",
    **{f"flying/{file}.py": f"{{name}}/{file}.py" for file in ("robot", "dps", "scenario", "optimize")},
}
_STATION = {
    **_COMMON,
    "station/README.md": "README.md",
    "station/test.py": "tests/test_{name}.py",
    **{f"station/{file}.py": f"{{name}}/{file}.py" for file in ("dps", "scenario", "optimize")},
}
_LONGEST_LINE = 120
# A project's LCM channels begin with at most this many bytes: LCM takes 63, the longest signal is _EFFORT_MEASURED.
_LONGEST_CHANNEL = 63 - 16


class ProjectError(ValueError):
    """A project cannot be written under a name; the message says why."""


def check_name(name: str, folder: Path) -> None:
    """Check that a project may be written as ``folder/name``, with a Python package of this name.

    Args:
        name: The name of the project.
        folder: The folder in which the folder of the project would be made.

    Raises:
        ProjectError: The name is no identifier, names another module, or is there already.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or not name.isascii() or name.startswith("_"):
        near = "".join(c if c.isascii() and c.isalnum() else "_" for c in name).strip("_").lower()
        near = near if near.isidentifier() and not keyword.iskeyword(near) else "my_robot"
        raise ProjectError(
            f"a project is named like its Python package: letters, digits and _, as in {near}, not {name!r}"
        )
    if (folder / name).exists() or (folder / name).is_symlink():
        raise ProjectError(f"{folder / name} exists, and is not overwritten: give another name, or remove it")
    if name in ("tests", "test") or find_spec(name) is not None:
        raise ProjectError(
            f"Python has a module {name} already, which the project could not replace: call it my_{name}"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ProjectError(f"{folder} is a folder that you cannot write to: change to one of yours")


def write_project(folder: Path, name: str, source: ProjectRobot | StationFile) -> Path:
    """Write a project whole, or not at all, and return its folder.

    Args:
        folder: The folder in which it becomes ``folder/name``.
        name: A name that `check_name` accepts.
        source: The robot, from `read_robot`, or the station, from `read_station`.

    Raises:
        ProjectError: See `check_name`.
    """
    check_name(name, folder)
    if isinstance(source, ProjectRobot):
        templates = _FLYING if source.flying is not None else _ROBOT if source.standing is None else _LEGGED
        values, kind = _robot_values(source), "Scenario"
    else:
        templates, values, kind = _STATION, _station_values(source), "Station"
    values |= {
        "name": name,
        "CHANNEL": _channel(name),
        "Class": "".join(part[:1].upper() + part[1:] for part in name.split("_")) + kind,
        "notes": _section("About the model file", source.notes),
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
            if isinstance(original, Path):
                shutil.copyfile(original, file)
            else:
                file.write_bytes(original)
        project.rename(folder / name)
    return folder / name


def _channel(name: str) -> str:
    """Return the beginning of the names of a project's LCM channels, which have 63 bytes at most.

    A long name is cut, and a checksum keeps it from being another long one's.
    """
    begin = name.upper()
    return begin if len(begin) <= _LONGEST_CHANNEL else f"{begin[: _LONGEST_CHANNEL - 9]}_{crc32(name.encode()):08X}"


def _section(title: str, items: Sequence[str]) -> str:
    """Return a section of a README, or nothing if there are no items."""
    return "".join([f"\n## {title}\n\n", *(f"* {item}\n" for item in items)]) if items else ""


def _flying_values(robot: ProjectRobot, flying: FlyingRobot) -> dict[str, str]:
    rotors = [
        f"    {_text(rotor.name)}: Rotor(position={_point(rotor.position)}, moment={_number(rotor.moment)}, "
        f"most={_number(rotor.most)}),\n"
        for rotor in flying.rotors
    ]
    return {
        "subject": "robot",
        "assumptions": _section("What is assumed", robot.assumptions),
        "assumed_comment": "\n# What the file does not say is assumed." if robot.assumptions else "",
        "model_file": robot.model.name,
        "model_path": robot.model.as_posix(),
        "add_robot": "".join(f"    {line}\n" for line in _add_robot(robot)),
        "base": _text(flying.base),
        "height": _number(flying.height),
        "rotors": "".join(rotors),
        "position_unit": "m",
    }


def _point(values: NDArray[np.float64]) -> str:
    return f"({', '.join(_number(value) for value in values)})"


def _robot_values(robot: ProjectRobot) -> dict[str, str]:
    if robot.flying is not None:
        return _flying_values(robot, robot.flying)
    joints = {joint.name: joint for joint in robot.joints}
    drives = [joints[driven] for driven in robot.driven]
    is_exact = len(drives) == len(joints)
    touching = ["TOUCHING"] if robot.touching else []
    has_passive = any(_is_passive(joint, robot) for joint in robot.joints)
    names = ["DRIVEN", "JOINTS", *touching, "B", "add_robot", "limits"]
    if robot.standing is not None:
        names = ["BASE", "DRIVEN", "FEET", "JOINTS", "SHIFT", "SOLES", *touching, *(["B"] if has_passive else [])]
        names += ["add_robot", "limits"]
    return {
        "subject": "robot",
        "assumptions": _section("What is assumed", robot.assumptions),
        "model_file": robot.model.name,
        "model_path": robot.model.as_posix(),
        "robot_imports": _robot_imports(robot),
        "assumed_comment": "\n# What the file does not say is assumed." if any(j.assumed for j in robot.joints) else "",
        "joints": "\n".join(map(_joint, robot.joints)),
        "driven": _list("DRIVEN = ", [_text(name) for name in robot.driven]),
        "examples": _examples(robot),
        "reached": f"{0.8 * robot.standing.reached:.2f}" if robot.standing is not None else "",
        "B": _motions(robot),
        "couplings": "".join(
            f"B[list(JOINTS).index({_text(c.joint)}), DRIVEN.index({_text(c.leader)})] = "
            f"{_number(c.multiplier)}  # it follows\n"
            for c in robot.couplings
        ),
        "touching": "\n# Bodies that touch each other at home, without contact.\n"
        f"TOUCHING = {_list('TOUCHING = ', [_text(name) for name in robot.touching])}\n"
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
        "driven_velocity_unit": _unit(drives, "/s"),
        # A variable of one entry is a number.
        "entry": "[0]" if len(drives) == 1 else "",
        "driven_position": "np.atleast_1d(position)[INDICES]" if len(joints) == 1 else "position[INDICES]",
        "position_columns": ",".join(f"q{number}" for number in range(1, len(joints) + 1)),
        "torque_columns": ",".join(f"u{number}" for number in range(1, len(drives) + 1)),
        "effort_unit": ", ".join(dict.fromkeys("N" if joint.kind == PRISMATIC else "N m" for joint in drives)),
        "scenario_imports": "from pydrake.geometry import CollisionFilterDeclaration\n" if robot.touching else "",
        "robot_names": ", ".join(names),
        "scene_graph": "scene_graph" if robot.touching else "_",
        "filter": _filter(robot),
        "tolerance": "0.02" if is_exact else "0.2",
        "passive": _PASSIVE if has_passive else "",
        "numpy": "import numpy as np\n" if has_passive else "",
    }


# The signals of joints that move freely are not guarded: such a joint falls, and may turn over.
_PASSIVE = """\
        passive = (limits("effort") == 0.0) & (B == 0.0).all(axis=1)  # may fall, turn over and hit its stops
        margin, speed = np.where(passive, 100.0, margin), np.where(passive, 100.0, speed)
"""


def _is_passive(joint: RobotJoint, robot: ProjectRobot) -> bool:
    """Return whether neither a drive nor another joint moves a joint."""
    return not joint.effort and robot.motions is None and joint.name not in {c.joint for c in robot.couplings}


def _filter(robot: ProjectRobot) -> str:
    if not robot.touching:
        return ""
    return _FILTER if robot.standing is None else _FILTER_ON_FEET


_FILTER_ON_FEET = """\
        without.ExcludeWithin(plant.CollectRegisteredGeometries([plant.GetBodyByName(name) for name in TOUCHING]))
"""
_FILTER = """\
        # Else their contact would push the robot away from home.
        touching = plant.CollectRegisteredGeometries([plant.GetBodyByName(name) for name in TOUCHING])
        scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(touching))
"""


_SELECTION = """\
# The velocities of all joints are B times the driven joints' velocities.
B = np.array([[float(name == driven) for driven in DRIVEN] for name in JOINTS])
"""


def _examples(robot: ProjectRobot) -> str:
    """Return the constants of examples and tests: another posture, or stance and shift of a robot with legs."""
    standing = robot.standing
    if standing is None:
        away = _list("AWAY = ", [_number(value) for value in robot.away])
        return f"# Another posture of these joints, for examples.\nAWAY = {away}\n"
    stance = standing.stance([])
    feet = "".join(_foot(name, points) for name, points in standing.feet.items())
    soles = "".join(f"    {_text(name)}: np.array({_row(up)}),\n" for name, up in standing.soles.items())
    direction = "left" if standing.direction == (0.0, 1.0) else "front"
    return (
        "# The trunk, and its pose when the robot stands: a quaternion wxyz, and the position over the ground in m.\n"
        f"BASE = {_text(standing.base)}\n"
        f"X_WB = np.array({_row(stance.X_WB)})\n"
        "# The contact points of the feet, in the frame of each, in m.\n"
        f"FEET = {{\n{feet}}}\n"
        "# The feet with a sole, or without collision geometry: they touch the ground by small spheres at their\n"
        "# contact points. The direction up in the frame of each.\n"
        f"SOLES = {f'{{{chr(10)}{soles}}}' if soles else '{}'}\n"
        f"# The weight is shifted to the {direction}, in examples by this distance in m.\n"
        f"DIRECTION = ({_number(standing.direction[0])}, {_number(standing.direction[1])})\n"
        f"SHIFT = {_number(standing.shift)}\n"
    )


def _row(values: NDArray[np.float64]) -> str:
    return f"[{', '.join(_number(value) for value in np.where(np.abs(values) < 1e-12, 0.0, values))}]"


def _foot(name: str, points: NDArray[np.float64]) -> str:
    """Return the entry of FEET: the contact points of a foot."""
    line = f"    {_text(name)}: np.array([{', '.join(map(_row, points))}]),\n"
    if len(line) <= _LONGEST_LINE + 1:  # with its end
        return line
    rows = "".join(f"            {_row(point)},\n" for point in points)
    return f"    {_text(name)}: np.array(\n        [\n{rows}        ]\n    ),\n"


def _motions(robot: ProjectRobot) -> str:
    if robot.motions is None:
        return _SELECTION
    rows = [", ".join(map(_number, np.round(row, 3))) for row in robot.motions]
    lines = "".join(f"        [{row}],\n" for row in rows)
    comment = "# Near home, the velocities of all joints are B times the driven joints' velocities."
    return f"{comment}\nB = np.array(\n    [\n{lines}    ]\n)\n"


def _number(value: float) -> str:
    return repr(float(f"{value:.6g}") + 0.0)


def _joint(joint: RobotJoint) -> str:
    numbers = {"lower": joint.lower, "upper": joint.upper, "speed": joint.speed}
    numbers |= {"effort": joint.effort} if joint.effort else {}
    numbers |= {"home": joint.home} if joint.home else {}
    arguments = ", ".join(f"{field}={_number(value)}" for field, value in numbers.items())
    comment = f"    # assumed: {', '.join(joint.assumed)}\n" if joint.assumed else ""
    return f"{comment}    {_text(joint.name)}: Joint({arguments}),"


def _list(prefix: str, items: Sequence[str]) -> str:
    """Return a list in Python, on one line if it fits behind ``prefix``."""
    line = f"[{', '.join(items)}]"
    if len(prefix) + len(line) <= _LONGEST_LINE:
        return line
    return "[\n" + "".join(f"    {item},\n" for item in items) + "]"


def _unit(joints: Sequence[RobotJoint], per: str = "") -> str:
    return ", ".join(dict.fromkeys(("m" if joint.kind == PRISMATIC else "rad") + per for joint in joints))


def _robot_imports(robot: ProjectRobot) -> str:
    moved = any(not _is_identity(X_WB) for X_WB in robot.welded.values())
    lines = ["from pydrake.math import RigidTransform, RollPitchYaw"] if moved else []
    if robot.standing is not None and not moved:
        lines = ["from pydrake.math import RigidTransform"]
    lines += ["from pydrake.multibody.plant import MultibodyPlant"]
    names = ["add_model", *(["hold_joint"] if robot.held else []), *(["replace_servo"] if robot.servos else [])]
    lines += [f"from vtbdrake.project import {', '.join(names)}"]
    return "".join(f"{line}\n" for line in lines)


def _is_identity(X: RigidTransform) -> bool:
    return bool(X.IsNearlyIdentity(1e-12))


def _add_robot(robot: ProjectRobot) -> list[str]:
    """Return the lines that turn the plant of the file into the project's plant."""
    up = len(robot.model.parts) - 1
    folders = [f'{_text(name)}: MODEL.parents[{up}] / "{path}"' for name, path in robot.packages.items()]
    lines = [f"add_model(plant, MODEL, {{{', '.join(folders)}}})" if folders else "add_model(plant, MODEL)"]
    for name, X_WB in robot.welded.items():
        pose = "" if _is_identity(X_WB) else ", X_WB"
        lines += [f"X_WB = {_pose(X_WB)}"] if pose else []
        frame = f"plant.GetBodyByName({_text(name)}).body_frame()"
        lines.append(f"plant.WeldFrames(plant.world_frame(), {frame}{pose})")
    if robot.held:
        lines += [
            f"for name in [{', '.join(_text(name) for name in robot.held)}]:",
            "    hold_joint(plant, name)  # Nothing drives it.",
        ]
    if robot.standing is not None:
        lines += [
            "base = plant.GetBodyByName(BASE)",
            "plant.SetDefaultFloatingBaseBodyPose(base, RigidTransform(X_WB[4:]))",
        ]
    lines += [
        f"plant.RemoveJointActuator(plant.GetJointActuatorByName({_text(name)}))  # it follows another joint"
        for name in robot.without_drive
    ]
    if robot.servos:
        lines += [
            f"for name in [{', '.join(_text(name) for name in robot.servos)}]:",
            "    replace_servo(plant, name)  # The DPS commands torques or forces, not positions or velocities.",
        ]
    if robot.added_drives:
        is_all = robot.added_drives == robot.driven
        names = "DRIVEN" if is_all else _list("for name in :    ", [_text(name) for name in robot.added_drives])
        lines += [
            *f"for name in {names}:".splitlines(),
            "    plant.AddJointActuator(name, plant.GetJointByName(name), JOINTS[name].effort)",
        ]
    if robot.sets_efforts:
        lines += [
            "for index in plant.GetJointActuatorIndices():",
            "    drive = plant.get_joint_actuator(index)",
            "    drive.set_effort_limit(JOINTS[drive.joint().name()].effort)",
        ]
    return lines


def _text(value: object) -> str:
    """Return a text, or a list of texts, as Python writes it; JSON's own escapes of emoji are not Python's."""
    return json.dumps(value, ensure_ascii=False)


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
        "opening": _text(station.grippers),
        "period": _number(station.period),
    }
