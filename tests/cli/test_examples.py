"""Scenarios by short names and by their files, of vtbdrake and of other packages."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from inspect import getdoc
from pathlib import Path

import pytest

import vtbdrake as vtb
from tests.cli.program import DAMPING, ROOT, error_of, run
from tests.testbeds import PendulumScenario
from vtbdrake.common.scenario_names import GROUP
from vtbdrake.testbed.scenario_file import is_trusted

OURS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["entry-points"][GROUP]
ROVER = """
from dataclasses import dataclass

from tests.testbeds import PendulumScenario


@dataclass
class RoverScenario(PendulumScenario):
    \"\"\"A rover that `swings`.

    It has no wheels.
    \"\"\"
"""


@pytest.fixture(autouse=True)
def _import_path() -> Iterator[None]:
    """Leave neither folders nor modules of a test behind."""
    path, modules = sys.path[:], {*sys.modules}
    yield
    sys.path[:] = path
    for name in {"rover", "rovers", "rovers.lunar"} & ({*sys.modules} - modules):
        del sys.modules[name]


def install(folder: Path, package: str, scenarios: dict[str, str]) -> None:
    """Write what pip writes of a package that gives scenarios short names."""
    metadata = folder / f"{package}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = [f"[{GROUP}]", *(f"{name} = {scenario}" for name, scenario in scenarios.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def rovers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an installed package of two modules, whose class the package imports from one of them."""
    package = tmp_path / "rovers"
    package.mkdir()
    (package / "__init__.py").write_text("from .lunar import RoverScenario\n")
    (package / "lunar.py").write_text(ROVER)
    install(tmp_path, "rovers", {"moon_rover": "rovers:RoverScenario"})
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", OURS)
def test_short_names_of_ours_are_scenarios_with_a_line_that_tells_what_they_show(name: str) -> None:
    module, _, class_name = OURS[name].partition(":")
    kind = getattr(import_module(module), class_name)
    assert issubclass(kind, vtb.Scenario)
    described = [json.loads(line) for line in run("examples", "--json").stdout.splitlines()]
    (example,) = [entry for entry in described if entry["name"] == name]
    summary = (getdoc(kind) or "").partition("\n")[0]
    assert example == {"name": name, "scenario": OURS[name], "shows": summary.replace("`", ""), "package": "vtbdrake"}
    assert 20 < len(example["shows"]) <= 110


def test_short_name_is_the_scenario() -> None:
    assert vtb.load_scenario("cart_pole") == vtb.load_scenario("vtbdrake_diagrams.cart_pole:CartPoleScenario")


def test_short_name_with_the_fields_of_a_file(tmp_path: Path) -> None:
    scenario = vtb.load_scenario("double_pendulum").with_fields({"rotor_inertia": 0.0125})
    scenario.save(tmp_path / "fields.yaml")
    assert vtb.load_scenario(f"double_pendulum@{tmp_path / 'fields.yaml'}").rotor_inertia == 0.0125


def test_packages_of_users_have_short_names(rovers: Path) -> None:
    assert "moon_rover" in run("examples").stdout
    assert "A rover that swings.\n" in run("examples").stdout
    assert "rovers" not in sys.modules
    assert DAMPING in run("variables", "moon_rover", "--match", "damping").stdout


def test_name_of_two_scenarios_is_refused(rovers: Path) -> None:
    install(rovers, "others", {"moon_rover": "others:Rover"})
    assert "several scenarios: name one of others:Rover (of others), rovers:RoverScenario (of rovers)" in error_of(
        "variables", "moon_rover"
    )


def test_same_scenario_in_two_places_is_one(rovers: Path) -> None:
    install(rovers, "others", {"moon_rover": "rovers:RoverScenario"})
    assert type(vtb.load_scenario("moon_rover")).__name__ == "RoverScenario"


@pytest.mark.parametrize(
    ("name", "suggested"),
    [
        ("cart_pol", "'cart_pol'; did you mean cart_pole?"),
        ("xyzzy", "'vtbdrake examples' lists short names"),
        ("vtbdrake_diagrams.cart_pol:CartPoleScenario", "did you mean vtbdrake_diagrams.cart_pole:CartPoleScenario?"),
        ("vtbdrake_diagrams.cart_pole:CartPolScenario", "did you mean CartPoleScenario?"),
    ],
)
def test_wrong_name_gets_a_suggestion(name: str, suggested: str) -> None:
    assert suggested in error_of("variables", name)


def test_scenario_in_a_file_and_in_a_file_of_a_package(tmp_path: Path) -> None:
    (tmp_path / "rover.py").write_text(ROVER)
    package = tmp_path / "rovers"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "lunar.py").write_text(ROVER)
    assert DAMPING in run("variables", "rover.py:RoverScenario", cwd=tmp_path).stdout
    scenario = vtb.load_scenario(tmp_path / "rovers" / "lunar.py:RoverScenario")
    # Other processes import it by this name, from a folder that they are told.
    assert scenario.name() == "rovers.lunar:RoverScenario"
    assert str(tmp_path) in sys.path and str(package) not in sys.path


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("rovr.py", "rovr.py; did you mean rover.py?"),
        ("json.py", "json.py would be imported as json, which is another module"),
        ("a-b.py", "a-b.py cannot be imported: rename it"),
    ],
)
def test_file_that_cannot_be_imported_is_refused(tmp_path: Path, file: str, message: str) -> None:
    for name in ("rover.py", "json.py", "a-b.py"):
        (tmp_path / name).write_text(ROVER)
    before = sys.path[:]
    assert message in error_of("variables", f"{tmp_path / file}:RoverScenario")
    assert sys.path == before


PROBLEM = "scenario: {}\nhorizon: 1.0\nqualities: [{{of: time}}]\n"


def test_problem_in_a_file_names_a_scenario_by_its_short_name(tmp_path: Path) -> None:
    from vtbdrake.optimization import ProblemFile

    (tmp_path / "problem.yaml").write_text(PROBLEM.format("double_pendulum"))
    scenario = ProblemFile.load(tmp_path / "problem.yaml", trusted=()).problem.scenario
    assert scenario.name() == "vtbdrake_diagrams.double_pendulum.scenario:DoublePendulumScenario"


@pytest.mark.parametrize(
    ("scenario", "message"),
    [
        ("moon_rover", "it names rovers:RoverScenario, and importing its module runs its code"),
        ("rovers/lunar.py:RoverScenario", "a file names a scenario as package.module:Class"),
        ("vtbdrake.py:RoverScenario", "a file names a scenario as package.module:Class"),
    ],
)
def test_file_of_a_problem_imports_no_stranger_by_another_name(rovers: Path, scenario: str, message: str) -> None:
    from vtbdrake.optimization import ProblemFile

    (rovers / "problem.yaml").write_text(PROBLEM.format(scenario))
    before = sys.path[:]
    with pytest.raises(ValueError, match=message):
        ProblemFile.load(rovers / "problem.yaml", trusted=())
    assert "rovers" not in sys.modules and sys.path == before


@pytest.mark.parametrize("name", ["vtbdrake.py:X", "vtbdrake./x.py:X", "math./x:X", "rover.py:X"])
def test_file_is_not_trusted_because_its_name_begins_like_a_module(name: str) -> None:
    assert not is_trusted(name)


def test_class_of_the_tests_is_still_named_by_its_module() -> None:
    assert vtb.load_scenario("tests.testbeds:PendulumScenario") == PendulumScenario()
