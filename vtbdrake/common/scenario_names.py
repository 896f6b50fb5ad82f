"""Short names of scenarios: the entry points of the group ``vtbdrake.scenarios``, of all packages that are installed.

A package gives its scenarios names in its pyproject.toml::

    [project.entry-points."vtbdrake.scenarios"]
    rover = "rover.scenario:RoverScenario"

Names are looked up, and summaries read, without importing the packages.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import invalidate_caches
from importlib.machinery import PathFinder
from importlib.metadata import entry_points
from pathlib import Path

from vtbdrake.common.suggestions import did_you_mean

GROUP = "vtbdrake.scenarios"


class ScenarioNameError(ValueError):
    """A short name or a file that names no scenario, or several."""


@dataclass(frozen=True)
class NamedScenario:
    """A scenario with a short name.

    Attributes:
        name: The short name.
        scenario: The scenario, as ``package.module:Class``.
        package: The package that gives the name, as pip lists it.
    """

    name: str
    scenario: str
    package: str

    @property
    def summary(self) -> str:
        """The first line of the docstring of the class; empty if there is none. Nothing is imported."""
        module, _, class_name = self.scenario.partition(":")
        return _class_summary(module, class_name)


def named_scenarios() -> list[NamedScenario]:
    """Return the scenarios with short names, sorted by name."""
    scenarios = {
        NamedScenario(entry.name, entry.value.replace(" ", ""), entry.dist.name if entry.dist is not None else "")
        for entry in entry_points(group=GROUP)
    }
    return sorted(scenarios, key=lambda named: (named.name, named.scenario))


def full_name(source: str) -> str:
    """Return ``package.module:Class`` for a short name, with what follows an ``@``; any other text as it is.

    Raises:
        ScenarioNameError: Several packages give the name to different scenarios.
    """
    head, at, rest = source.partition("@")
    if not head.isidentifier():
        return source
    packages = {named.scenario: named.package for named in named_scenarios() if named.name == head}
    if len(packages) > 1:
        alternatives = ", ".join(f"{scenario} (of {package})" for scenario, package in sorted(packages.items()))
        raise ScenarioNameError(f"{head} is the name of several scenarios: name one of {alternatives}")
    return f"{next(iter(packages))}{at}{rest}" if packages else source


def file_name(source: str) -> Path | None:
    """Return the file of ``file.py:Class`` or ``file.py:Class@FILE``; None if a scenario is named otherwise."""
    file, colon, _ = source.partition("@")[0].rpartition(":")
    return Path(file) if colon and file.endswith(".py") else None


def importable_name(source: str) -> str:
    """Return ``package.module:Class`` for ``file.py:Class``, with what follows an ``@``; any other text as it is.

    The folder from which the module is imported is appended to ``sys.path``, so that other processes find it, too.

    Raises:
        ScenarioNameError: There is no such file, or another module has its name.
    """
    file = file_name(source)
    if file is None:
        return source
    head, at, rest = source.partition("@")
    return f"{_module_of_file(file)}:{head.rpartition(':')[2]}{at}{rest}"


def suggested_scenarios(name: str) -> str:
    """Return the end of an error message that suggests scenarios with names similar to ``name``, short or full."""
    names = [named.scenario if ":" in name else named.name for named in named_scenarios()]
    return did_you_mean(name, names, count=1)


def _module_of_file(path: Path) -> str:
    """Return the name by which the module in a file can be imported, and see to it that it can."""
    path = path.resolve()
    if not path.is_file():
        near = did_you_mean(path.name, (each.name for each in path.parent.glob("*.py")), count=1)
        raise ScenarioNameError(f"there is no file {path}{near}")
    folder, parts = path.parent, [] if path.stem == "__init__" else [path.stem]
    while (folder / "__init__.py").exists():
        folder, parts = folder.parent, [folder.name, *parts]
    if not all(part.isidentifier() for part in parts):
        raise ScenarioNameError(f"{path} cannot be imported: rename it to letters, digits and underscores")
    invalidate_caches()  # The file may be a second old.
    top = sys.modules.get(parts[0])
    spec = top.__spec__ if top is not None else PathFinder.find_spec(parts[0], [*sys.path, str(folder)])
    origin = Path(spec.origin).resolve() if spec is not None and spec.origin else None
    expected = path if parts == [path.stem] else folder / parts[0] / "__init__.py"
    if origin != expected or parts[0] in sys.builtin_module_names:
        raise ScenarioNameError(f"{path} would be imported as {parts[0]}, which is another module: rename it")
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    return ".".join(parts)


def _class_summary(module: str, class_name: str) -> str:
    """Return the first line of the docstring of a class, read from the text of its module."""
    for _ in range(5):  # A package may import the class from a module, which may import it from another one.
        path = next(filter(Path.is_file, _places(module.split("."))), None)
        try:
            tree = ast.parse(path.read_text("utf-8")) if path is not None else ast.Module([], [])
        except (OSError, SyntaxError, ValueError):
            return ""
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and node.name == class_name:
                return (ast.get_docstring(node) or "").partition("\n")[0].replace("`", "")
        origins = [
            (_absolute(node, module, path), alias.name)
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
            if (alias.asname or alias.name) == class_name
        ]
        if not origins:
            return ""
        module, class_name = origins[0]
    return ""


def _absolute(node: ast.ImportFrom, module: str, path: Path | None) -> str:
    """Return the module that an import statement in ``module`` names."""
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    is_package = path is not None and path.name == "__init__.py"
    base = parts[: len(parts) - node.level + is_package]
    return ".".join([*base, *([node.module] if node.module else [])])


def _places(parts: list[str]) -> Iterator[Path]:
    """Yield the files in which a module may be; none of its packages is imported."""
    spec = PathFinder.find_spec(parts[0])
    if spec is None:
        return
    for place in spec.submodule_search_locations or ():
        folder = Path(place).joinpath(*parts[1:])
        yield from (folder / "__init__.py", folder.with_suffix(".py"))
    if len(parts) == 1 and spec.origin:
        yield Path(spec.origin)
