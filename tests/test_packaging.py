"""The wheel holds the package vtbdrake, typed and licensed, and nothing else of the repository."""

import subprocess
import sys
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    result = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


@pytest.fixture(scope="module")
def metadata(wheel: zipfile.ZipFile) -> Message:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return Parser().parsestr(wheel.read(name).decode())


def test_wheel_holds_only_the_package(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert tops == {"vtbdrake", "vtbdrake-0.1.0.dist-info"}


def test_wheel_is_complete(wheel: zipfile.ZipFile) -> None:
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "vtbdrake").rglob("*.py")}
    assert modules | {"vtbdrake/py.typed"} <= set(wheel.namelist())


def test_metadata(metadata: Message) -> None:
    assert metadata["Name"] == "vtbdrake"
    assert metadata["License-Expression"] == "BSD-3-Clause"
    assert metadata["License-File"] == "LICENSE"
    assert metadata["Requires-Python"] == ">=3.11"


def test_optional_packages_are_extras(metadata: Message) -> None:
    requirements = metadata.get_all("Requires-Dist", [])
    always = {requirement.split(">")[0] for requirement in requirements if "extra ==" not in requirement}
    assert {"drake", "casadi", "lcm", "cmaes", "click"} <= always
    assert not always & {"opencv-python-headless", "embreex", "optuna", "dask", "distributed", "pandas", "ipywidgets"}


def test_command_line_entry_point(wheel: zipfile.ZipFile) -> None:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/entry_points.txt"))
    assert "vtbdrake = vtbdrake.cli:main" in wheel.read(name).decode()
