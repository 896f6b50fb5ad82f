"""Settings and fixtures of all tests."""

import ctypes
import gc
import importlib
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import settings

# Linear algebra on one thread, here and in child processes: the matrices are small, and threads that wait for each
# other take several times as long. Set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A function that is compiled without optimization computes the same: most of the tests' functions are evaluated for
# less time than a compiler needs to optimize them.
os.environ.setdefault("CFLAGS", "-O0")

# How long an example takes depends on what else the computer does.
settings.register_profile("patient", deadline=None, max_examples=50)
settings.register_profile("patient and quick", deadline=None, max_examples=25)
settings.load_profile("patient")

# What a shell starts in the background ignores Ctrl-C, and so would all that the tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# The same holds for the end of the terminal, under nohup. A handler that does nothing is not inherited.
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda number, frame: None)


def pytest_configure(config: pytest.Config) -> None:
    """Try fewer examples where the slow tests are left out, unless a test says how many it needs."""
    if "not slow" in config.option.markexpr:
        settings.load_profile("patient and quick")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without the garbage collector. Later it leaves out what is there now, half a million objects.

    It then looks at the rest a tenth as often as by default.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(7_000, 10, 10)
        gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import files without a slow test for the slow tests alone: each worker would."""
    is_module = collection_path.suffix == ".py" and config.option.markexpr == "slow"
    return True if is_module and "slow" not in collection_path.read_text("utf-8") else None


def resident_memory() -> int:
    """Return the memory of this process, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module", autouse=True)
def memory_given_back() -> Iterator[None]:
    """Give back what is free, but kept by malloc, where it is much: after rendering in software, it is 0.6 GB."""
    before = resident_memory()
    yield
    if resident_memory() > before + 100_000_000:
        ctypes.CDLL(None).malloc_trim(0)


LONGEST_FILE = 20.0
"""Seconds that the tests of one file should take at most: a worker runs a file as a whole."""


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the files whose tests took long, set-up and tear-down included."""
    seconds = Counter[str]()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if isinstance(report, pytest.TestReport):
                seconds[report.location[0]] += report.duration
    if long := [(name, total) for name, total in seconds.most_common() if total > LONGEST_FILE]:
        terminalreporter.section(f"files that took more than {LONGEST_FILE:g} s")
        for name, total in long:
            terminalreporter.write_line(f"{total:7.1f} s {name}")


# Folders (and the modules in them, all of a kind) that need one Python only; of the forest, its scenario passes the
# checks on both. A single module says so by `pytestmark = pytest.mark.one_python`, a single test by the marker itself.
ONE_PYTHON = ("cli", "diagrams/forest", "notebooks", "visualization")


# A worker runs a file as a whole: with those that take longest at the start, all workers end at about the same time.
FIRST = (
    "test_docs.py",
    "notebooks/test_notebooks.py",
    "project/test_projects.py",
    "web/live/test_page.py",
    "diagrams/test_checks.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    first = {Path(__file__).parent / name: k for k, name in enumerate(FIRST)}
    items.sort(key=lambda item: first.get(item.path, len(first)))  # It keeps the order otherwise.
    folders = [Path(__file__).parent / name for name in ONE_PYTHON]
    files = {item.path for item in items}
    one_python = {path for path in files if any(folder in path.parents for folder in folders)}
    quick: set[str] = set()  # Tests that have shown a quick case.
    for item in items:
        if item.path in one_python:
            item.add_marker(pytest.mark.one_python)
        if item.get_closest_marker("slow_cases") and not item.get_closest_marker("slow"):
            name = item.nodeid.partition("[")[0]
            if name in quick:
                item.add_marker(pytest.mark.slow)
            quick.add(name)


# Message types of a user, made by lcm-gen.
TYPES = """
package vtb_test_types;
struct point_t { double x; double y; double z; }
struct wind_t { int64_t utime; double speed; double direction; float gust[2]; int16_t level; point_t where; }
struct mixed_t { int64_t utime; string name; int32_t n; int32_t m; double grid[n][m]; byte blob[m]; point_t points[n]; }
struct tree_t { int32_t n; double x; tree_t branches[n]; }
"""


@pytest.fixture(scope="session")
def user_types(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    folder = tmp_path_factory.mktemp("lcm")
    source = folder / "types.lcm"
    source.write_text(TYPES)
    lcm_gen = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([lcm_gen, "-p", "--ppath", folder, source], check=True, timeout=60)
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("vtb_test_types")
    finally:
        sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A Chromium without a window."""
    from tests.chromium import running_browser

    with running_browser() as running:
        yield running
