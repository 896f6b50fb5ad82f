"""The sdist holds all that the wheel is built from; the wheel holds the package, compiled, and the example testbeds."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path
from sysconfig import get_config_var, get_path

import pytest

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[1]
COMPILED = sorted(
    path.relative_to(ROOT) for package in ("vtbdrake", "vtbdrake_diagrams") for path in (ROOT / package).rglob("*.pyx")
)
MESSAGE_TYPES = [path.relative_to(ROOT) for path in (ROOT / "vtbdrake").rglob("lcmt_vtb_*.py")]
EXT_SUFFIX = get_config_var("EXT_SUFFIX")
SHARED = Path("vtbdrake/_cyutility")  # Cython's own part of all modules
# What reads recordings, which are not part of vtbdrake, is in the repository only.
READS_RECORDINGS = re.compile(
    r"vtbdrake_diagrams/(\w+/reality|park/(few_landmarks|mower|survey)|recorded_arms/(pendulum|subjects))\.py"
)


def run(*arguments: str, cwd: Path, **environment: str) -> str:
    result = subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=os.environ | environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, modules compiled in place included, lcm-gen's not: a build leaves its folders where it runs."""
    folder = tmp_path_factory.mktemp("build") / "checkout"
    for name in ("vtbdrake", "diagrams"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "lcmt_vtb_*.py"))
    (folder / "vtbdrake_diagrams").symlink_to((ROOT / "vtbdrake_diagrams").readlink())
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def files(checkout: Path) -> set[str]:
    """The files of both packages but those that read recordings, and what lcm-gen makes in a build."""
    folders = (checkout / "vtbdrake", checkout / "vtbdrake_diagrams")
    paths = [path for folder in folders for path in folder.rglob("*") if path.is_file() and path.suffix != ".so"]
    kept = {path.relative_to(checkout).as_posix() for path in paths} | {path.as_posix() for path in MESSAGE_TYPES}
    return {name for name in kept if not READS_RECORDINGS.fullmatch(name)}


@pytest.fixture(scope="module")
def sdist(checkout: Path, files: set[str]) -> Path:
    run("-c", "import setuptools.build_meta as backend; backend.build_sdist('..')", cwd=checkout)
    (path,) = checkout.parent.glob("*.tar.gz")
    return path


@pytest.fixture(scope="module")
def wheel(sdist: Path) -> Path:
    # Without optimization, the modules compile in a fifth of the time.
    compiler = sdist.parent / "cc"
    compiler.write_text('#!/bin/sh\nexec cc "$@" -O0\n')
    compiler.chmod(0o755)
    options = ("--no-index", "--no-build-isolation", "--no-deps", "--disable-pip-version-check")
    run("-m", "pip", "wheel", *options, str(sdist), cwd=sdist.parent, CC=str(compiler))
    (path,) = sdist.parent.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def content(wheel: Path) -> dict[str, str]:
    """Name and text of every file in the wheel; what is not text is left to its name."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name).decode(errors="replace") for name in archive.namelist()}


@pytest.fixture(scope="module")
def metadata(sdist: Path) -> Message:
    """The metadata in the sdist, which a wheel has, too."""
    return Parser().parsestr(text_in(sdist, "PKG-INFO"))


def text_in(sdist: Path, name: str) -> str:
    """Return the text of a file in the sdist."""
    with tarfile.open(sdist) as archive:
        file = archive.extractfile(f"vtbdrake-0.1.0/{name}")
        assert file is not None
        return file.read().decode()


def test_compiled_modules_are_not_older_than_their_sources() -> None:
    for source in COMPILED:
        module = ROOT / source.with_suffix(EXT_SUFFIX)
        assert module.exists() and module.stat().st_mtime >= (ROOT / source).stat().st_mtime, (
            f"{module.name} is not what {source} says: compile it, {sys.executable} setup.py build_ext --inplace"
        )


@pytest.mark.slow
def test_sdist_holds_the_package_and_what_builds_it(sdist: Path, files: set[str]) -> None:
    with tarfile.open(sdist) as archive:
        names = {entry.name.partition("/")[2] for entry in archive if entry.isfile()}
    made = {name for name in names if name.startswith("vtbdrake.egg-info/")} | {"PKG-INFO", "setup.cfg"}
    assert names - made == files | {"pyproject.toml", "setup.py", "README.md", "LICENSE"}


@pytest.mark.slow
def test_wheel_holds_the_package_compiled_and_nothing_else(content: dict[str, str], files: set[str]) -> None:
    names = {name for name in content if not name.startswith("vtbdrake-0.1.0.dist-info/")}
    rest = {file for file in files if not file.endswith((".pyx", ".pxd"))}
    assert names == rest | {source.with_suffix(EXT_SUFFIX).as_posix() for source in [*COMPILED, SHARED]}
    assert {"vtbdrake/py.typed", "vtbdrake_diagrams/py.typed"} <= names


@pytest.mark.slow
def test_wheel_is_for_this_python_and_platform(wheel: Path, content: dict[str, str]) -> None:
    python = "cp{}{}".format(*sys.version_info)
    assert f"-{python}-{python}-linux_" in wheel.name
    assert "Root-Is-Purelib: false" in content["vtbdrake-0.1.0.dist-info/WHEEL"]


@pytest.mark.slow
def test_compiled_modules_of_the_wheel_import(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    names = [".".join(source.with_suffix("").parts) for source in COMPILED]
    program = f"from importlib import import_module\nfor name in {names}: print(import_module(name).__file__)"
    found = run("-c", program, cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert found.split() == [str(tmp_path / source.with_suffix(EXT_SUFFIX)) for source in COMPILED]


@pytest.mark.slow
def test_first_program_of_the_readme_runs_from_the_wheel(wheel: Path, tmp_path: Path) -> None:
    environment = tmp_path / "venv"
    run("-m", "venv", "--without-pip", str(environment), cwd=tmp_path)
    (packages,) = environment.glob("lib/python*/site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    # What vtbdrake depends on, without what else is installed in an editable way.
    (packages / "dependencies.pth").write_text(get_path("purelib"))
    program = (ROOT / "README.md").read_text("utf-8").split("```python\n")[1].partition("```")[0]
    # The same program with a shorter horizon: what it answers is the business of other tests.
    program = program.replace("horizon=15.0", "horizon=0.5").replace("coarse=5.0", "coarse=30.0")
    program += "import vtbdrake_diagrams\nprint(vtb.__file__, vtbdrake_diagrams.__file__, sep='\\n')\n"
    program += "problem.sweep(2, executor='processes', workers=1, progress=False)\n"
    (tmp_path / "program.py").write_text(program)
    done = subprocess.run(
        [environment / "bin" / "python", "-I", "program.py"],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert [Path(line).parents[1] for line in done.stdout.splitlines()[-2:]] == [packages, packages]
    assert (tmp_path / "payload.png").stat().st_size > 1000


def test_metadata(metadata: Message) -> None:
    assert metadata["Name"] == "vtbdrake"
    assert metadata["License-Expression"] == "BSD-3-Clause"
    assert metadata["License-File"] == "LICENSE"
    assert metadata["Requires-Python"] == ">=3.11"


def test_a_missing_compiler_is_said_before_cython_runs(checkout: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        "setup.py",
        "--quiet",
        "build_ext",
        f"--build-temp={tmp_path}",
        f"--build-lib={tmp_path}",
    ]
    done = subprocess.run(command, cwd=checkout, env=os.environ | {"CC": "no-such-cc"}, capture_output=True, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()[-1:]
    assert re.match(
        r"vtbdrake compiles modules: .* C compiler.*no-such-cc.*: apt-get install gcc .*, or install a wheel", line
    )
    assert not list(tmp_path.rglob("*.c"))


def test_the_extra_all_is_every_extra_for_users(metadata: Message) -> None:
    requirements: dict[str, set[str]] = {}
    for requirement in metadata.get_all("Requires-Dist", []):
        package, _, extra = requirement.partition("; extra == ")
        requirements.setdefault(extra.strip('"'), set()).add(package)
    extras = set(metadata.get_all("Provides-Extra", [])) - {"all", "compiler", "dev", "docs"}
    named = [name for requirement in requirements["all"] for name in re.findall(r"[\w-]+", requirement)]
    assert sorted(named) == sorted([*extras, *["vtbdrake"] * len(requirements["all"])])
    assert {"perception", "web"} <= extras


def test_optional_packages_are_extras(metadata: Message) -> None:
    requirements = metadata.get_all("Requires-Dist", [])
    always = {requirement.split(">")[0] for requirement in requirements if "extra ==" not in requirement}
    assert {"drake", "casadi", "lcm", "cmaes", "click"} <= always
    assert not always & {"opencv-python-headless", "embreex", "optuna", "dask", "distributed", "pandas", "ipywidgets"}


def test_no_version_of_a_dependency_is_excluded_from_above(metadata: Message) -> None:
    requirements = [requirement.partition(";")[0] for requirement in metadata.get_all("Requires-Dist", [])]
    assert "drake>=1.51.1" in requirements
    assert not [requirement for requirement in requirements if re.search(r"[<~!]|==", requirement)]


ENTRY_POINTS = "vtbdrake.egg-info/entry_points.txt"


def test_entry_point_of_pytest_names_a_module(sdist: Path, files: set[str]) -> None:
    module = text_in(sdist, ENTRY_POINTS).partition("[pytest11]")[2].split()[2]
    assert f"{module.replace('.', '/')}.py" in files


def test_command_line_entry_point(sdist: Path) -> None:
    assert "vtbdrake = vtbdrake.cli:main" in text_in(sdist, ENTRY_POINTS)


@pytest.mark.slow
def test_wheel_has_the_metadata_and_entry_points_of_the_sdist(content: dict[str, str], sdist: Path) -> None:
    assert content["vtbdrake-0.1.0.dist-info/entry_points.txt"] == text_in(sdist, ENTRY_POINTS)
    wheel, source = (
        Parser().parsestr(text) for text in (content["vtbdrake-0.1.0.dist-info/METADATA"], text_in(sdist, "PKG-INFO"))
    )
    for name in ("Name", "Version", "License-Expression", "License-File", "Requires-Python", "Requires-Dist"):
        assert wheel.get_all(name) == source.get_all(name)
