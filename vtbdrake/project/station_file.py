"""The station in a file of Drake's ``hardware_sim``: its arms, its grippers, and the files that it consists of."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.manipulation import IiwaDriver, SchunkWsgDriver

from vtbdrake.project.model_copy import closure
from vtbdrake.station import Station
from vtbdrake.testbed import Interface, ScenarioError, VirtualTestbedBuilder


class StationFileError(ValueError):
    """A file describes no station that a project can be made for."""


@dataclass(frozen=True)
class StationArm:
    """An arm of a station: a model with an `IiwaDriver`.

    Attributes:
        name: The name of the model.
        home: The posture at the start, in rad.
        away: Another posture, for examples.
    """

    name: str
    home: tuple[float, ...]
    away: tuple[float, ...]


@dataclass(frozen=True)
class StationFile:
    """A station as a project needs it.

    Attributes:
        file: The path of the YAML file among ``files``, and ``#KEY`` if it has several stations.
        files: The files that the station consists of: path in the project's folder ``models`` -> source.
        arms: Its arms.
        grippers: The distance of the fingers at first, in m, by the names of its grippers.
        period: The period of the DPS in s.
        notes: What is unusual, and what is done about it.
    """

    file: str
    files: dict[Path, Path]
    arms: tuple[StationArm, ...]
    grippers: dict[str, float]
    period: float
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        names = [*(arm.name for arm in self.arms), *self.grippers]
        return f"{Path(self.file).name} with {', '.join(names)}"


def read_station(source: str) -> StationFile:
    """Return the station in ``FILE.yaml`` or ``FILE.yaml#KEY``.

    Raises:
        ScenarioError: The file describes no station.
        StationFileError: It has no arm with a driver, or names that Python has not.
    """
    station = Station(source)
    path = Path(source if Path(source).exists() else source.rpartition("#")[0]).resolve()
    key = "" if Path(source).exists() else "#" + source.rpartition("#")[2]
    drivers = {name: driver for name, driver in station.model_drivers.items() if isinstance(driver, IiwaDriver)}
    if not drivers:
        raise StationFileError(
            f"{source} has no !IiwaDriver among its model_drivers, and so no arm that the project could hold: give it "
            "one, or take the robot's own model file (vtbdrake new NAME --urdf FILE)"
        )
    signals = station.signals()
    builder = VirtualTestbedBuilder(Interface(sense=[], act=[]))
    station.add_models(builder)
    plant = builder.plant
    assert plant is not None
    arms = []
    for name in drivers:
        _check_identifier(name, source)
        limits = station.joint_limits(name)
        home = np.clip(plant.GetDefaultPositions(plant.GetModelInstanceByName(name)), limits.lower, limits.upper)
        end = np.where(limits.upper - home > home - limits.lower, limits.upper, limits.lower)
        away = home + np.sign(end - home) * np.minimum(0.15 * np.abs(end - home), 0.2)
        arms.append(StationArm(name, _rounded(home), _rounded(away)))
    grippers = {}
    for name, driver in station.model_drivers.items():
        if isinstance(driver, SchunkWsgDriver):
            _check_identifier(name, source)
            grippers[name] = float(f"{signals[f'{name}_position'].idle:.4g}")
    files, notes = _files(path)
    relative = next(target for target, origin in files.items() if origin == path)
    period = next(iter(drivers.values())).lcm_status_period
    return StationFile(relative.as_posix() + key, files, tuple(arms), grippers, period, notes)


def _check_identifier(name: str, source: str) -> None:
    if not name.isidentifier():
        raise StationFileError(
            f"{source}: the model {name!r} gives its name to ports of the DPS: rename it with letters, digits and _"
        )


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(f"{value:.4g}") + 0.0 for value in values)


def _files(path: Path) -> tuple[dict[Path, Path], list[str]]:
    """Return the YAML file with what its directives name of its own package, by paths in the project."""
    root = next((folder for folder in path.parents if (folder / "package.xml").is_file()), None)
    text = path.read_text(encoding="utf-8")
    named = set(re.findall(r"package://([^/\s]+)/", text)) - {"drake", "drake_models"}
    if root is None:
        if named:
            raise ScenarioError(f"{path} names the package {', '.join(sorted(named))}, but no package.xml is around it")
        return {Path(path.name): path}, []
    match = re.search(r"<name>\s*([^<\s]+)\s*</name>", (root / "package.xml").read_text(encoding="utf-8"))
    package = match[1] if match else root.name
    models = [root / name for name in re.findall(rf"package://{re.escape(package)}/([^\s'\"}},]+)", text)]
    sources = [path, root / "package.xml"]
    for model in dict.fromkeys(models):
        sources += closure(model.resolve(), {package: root})
    notes = [
        f"{path.name} names the package {other}: it has to be on the ROS_PACKAGE_PATH wherever the project runs"
        for other in sorted(named - {package})
    ]
    return {source.relative_to(root): source for source in dict.fromkeys(sources) if source.is_relative_to(root)}, notes
