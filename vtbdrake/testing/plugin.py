"""The pytest plugin, and the only module of vtbdrake that imports pytest.

pytest imports it in every run where vtbdrake is installed: nothing here imports Drake before a test asks for it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vtbdrake.common.extras import extra_module
from vtbdrake.common.file_names import as_file_name

if TYPE_CHECKING:
    import pytest

    from vtbdrake.machine import MachineProcess
    from vtbdrake.testbed import Scenario, VirtualTestbed
    from vtbdrake.testing.mutants import Mutant, MutationScore
    from vtbdrake.testing.phase import Phase
else:
    pytest = extra_module("pytest", purpose="the plugin", extra="testing")


def parametrize_with_checks(
    scenarios: Iterable[Scenario],
    *,
    expected_failed_checks: Mapping[str, str] | Callable[[Scenario], Mapping[str, str]] | None = None,
    values: Mapping[str, Any] | Callable[[Scenario], Mapping[str, Any]] | None = None,
    horizon: float | None = None,
) -> pytest.MarkDecorator:
    """Return a decorator that runs a test once for every scenario and every check, each in a test of its own.

    For example::

        @parametrize_with_checks([ArmScenario()], expected_failed_checks={"check_signals_have_limits": "no datasheet"})
        def test_arm(scenario, check):
            check(scenario)

    A check that does not concern a scenario is skipped, with the reason. A check that is expected to fail, and does
    not, is an error: take it off the list.

    Args:
        scenarios: The scenarios.
        expected_failed_checks: Name of a check -> the reason why it fails; or a function that returns these for a
            scenario.
        values: Address -> value, set before every simulation; or a function that returns these for a scenario.
        horizon: Seconds that are simulated; see `check_scenario`.

    Raises:
        ValueError: There is no check of an expected name.
    """
    from vtbdrake.testing.checks import CHECKS
    from vtbdrake.testing.scenario_check import checked_expectations
    from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError, Subject

    # The subject of one scenario at a time: a testbed with its contexts can be large.
    present: dict[int, Subject] = {}
    cases = []
    for number, scenario in enumerate(scenarios):
        expected = checked_expectations(_of(scenario, expected_failed_checks))
        for check in CHECKS:

            def run(scenario: Scenario, check: Any = check, number: int = number) -> None:
                __tracebackhide__ = True
                if number not in present:
                    present.clear()
                    present[number] = Subject(scenario, values=_of(scenario, values), horizon=horizon)
                error = present[number].outcome(check)
                if isinstance(error, CheckSkippedError):
                    pytest.skip(str(error))
                if error is not None:
                    raise error

            name = check.__name__
            marks = []
            if name in expected:
                marks.append(pytest.mark.xfail(reason=expected[name], raises=CheckFailedError, strict=True))
            cases.append(pytest.param(scenario, run, id=f"{type(scenario).__name__}{number}-{name}", marks=marks))
    return pytest.mark.parametrize(("scenario", "check"), cases)


def _of(
    scenario: Scenario, items: Mapping[str, Any] | Callable[[Scenario], Mapping[str, Any]] | None
) -> Mapping[str, Any] | None:
    return items(scenario) if callable(items) else items


# -- options


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of vtbdrake."""
    group = parser.getgroup("vtbdrake", "tests of virtual testbeds")
    group.addoption(
        "--vtb-failures",
        metavar="DIR",
        default=".vtb_failures",
        help="the folder for plots and logs of failed tests, below the rootdir",
    )
    group.addoption(
        "--vtb-mutants",
        metavar="SHARE",
        nargs="?",
        type=float,
        const=0.0,
        help="run the tests that use the fixture `scenario` with its mutants, too; fail if they notice less than SHARE "
        "of them (0 to 1)",
    )


# -- fixtures

_LOG = pytest.StashKey["Path"]()


@pytest.fixture
def scenario() -> Scenario:
    """Return the scenario under test: override this fixture in the test file, or in conftest.py."""
    raise pytest.UsageError(
        "the fixtures of vtbdrake test the scenario that a fixture `scenario` of yours returns: define it in the test "
        "file or in conftest.py"
    )


@pytest.fixture
def testbed(scenario: Scenario) -> VirtualTestbed:
    """Return a new testbed of the scenario."""
    return scenario.build()


@pytest.fixture
def machine_options() -> dict[str, Any]:
    """Return the options of the simulated machine, see `MachineProcess`; override this fixture to change them."""
    return {}


@pytest.fixture
def machine(scenario: Scenario, machine_options: Mapping[str, Any]) -> Iterator[MachineProcess]:
    """Yield the simulated machine of the scenario, in a process and at a hub of its own (``machine.url``).

    Args:
        scenario: The scenario of the test, a fixture.
        machine_options: Keyword arguments of `MachineProcess`, a fixture.
    """
    from vtbdrake.lcm.hub import Hub
    from vtbdrake.machine import MachineProcess

    with Hub(port=0) as hub, MachineProcess(scenario, hub.url, **machine_options) as process:
        yield process


@pytest.fixture
def log_file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return a new file for ``record=``: if the test fails, it is kept, and the report says how to replay it.

    Args:
        request: Pytest's fixture; it tells the test.
        tmp_path: Pytest's fixture: the test's folder.
    """
    log = tmp_path / "loop.lcm"
    request.node.stash[_LOG] = log
    return log


@pytest.fixture(params=["sim", "shadow", "machine"])
def phase(
    request: pytest.FixtureRequest, scenario: Scenario, log_file: Path, machine_options: Mapping[str, Any]
) -> Iterator[Phase]:
    """Yield the DPS of the scenario in each phase, see `vtbdrake.testing.phase.Phase`; its loop is recorded.

    Args:
        request: Pytest's fixture, whose ``param`` is the phase.
        scenario: The scenario of the test, a fixture.
        log_file: The file in which the loop is recorded, a fixture.
        machine_options: Keyword arguments of `MachineProcess`, a fixture.
    """
    from vtbdrake.testing.phase import Phase

    if request.param != "sim" and scenario.deployment().protocol is None:
        pytest.skip(f"{type(scenario).__name__} has no protocol, so no machine")
    with Phase(scenario, request.param, record=log_file, machine_options=machine_options) as loop:
        yield loop


# -- what a failed test carries


def _folder(item: pytest.Item) -> Path | None:
    """Return the folder of a test for what a failure leaves; None while it runs with a mutant."""
    mutants = item.config.pluginmanager.get_plugin(_MUTANTS)
    if isinstance(mutants, _Mutants) and mutants.mutant is not None:
        return None
    return item.config.rootpath / item.config.getoption("vtb_failures") / as_file_name(item.nodeid)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Let assertions write their plots into the folder of the test."""
    from vtbdrake.testing.failure import failures_in

    with failures_in(_folder(item)):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Keep the log of a failed test, and report how to replay it.

    Args:
        item: The test.
        call: The part of the test that has ended: its set-up, its call or its tear-down.
    """
    report = yield
    log, folder = item.stash.get(_LOG, None), _folder(item)
    if call.when == "call" and report.failed and log is not None and folder is not None:
        loop = getattr(item, "funcargs", {}).get("phase")
        report.sections.append(("log of the loop", _kept_log(log, folder, loop)))
    return report


def _kept_log(log: Path, folder: Path, loop: Phase | None) -> str:
    """Keep a log, and return how to replay it."""
    from vtbdrake.recording.log_reader import read_log

    try:
        if loop is not None:
            loop.close()  # The log is complete only then.
        if not log.exists():
            return "nothing was recorded"
        folder.mkdir(parents=True, exist_ok=True)
        kept_log = Path(shutil.copy(log, folder / log.name))
        return f"vtbdrake replay {kept_log} --scenario {read_log(kept_log).header.scenario_name}"
    except Exception as error:  # The failure of the test is what matters.
        return f"{log} is not complete: {error}"


# -- mutants

_MUTANTS = "vtbdrake mutants"


class _Mutants:
    """Runs tests again, once per mutant of their scenario, until one fails."""

    def __init__(self) -> None:
        self.mutant: Mutant | None = None  # the mutant of the present run
        self.scenarios: list[tuple[pytest.Item, Scenario]] = []
        self.scores: list[tuple[str, MutationScore]] = []

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Generator[None, Any, Any]:
        """Replace the scenario by its mutant."""
        value = yield
        if fixturedef.argname == "scenario" and self.mutant is not None:
            from vtbdrake.testing.mutants import mutate

            value = mutate(value, self.mutant)
            fixturedef.cached_result = (value, fixturedef.cached_result[1], None)
        return value

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, object, object]:
        """Take note of the scenario of every test; one that is parametrized by its scenario has no fixture."""
        result = yield
        from vtbdrake.testbed import Scenario

        scenario = getattr(item, "funcargs", {}).get("scenario")
        parameters = item.callspec.params if hasattr(item, "callspec") else {}
        if self.mutant is None and isinstance(scenario, Scenario) and "scenario" not in parameters:
            self.scenarios.append((item, scenario))
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """Run the tests, and if they pass, run them with every mutant."""
        result = yield
        if session.testsfailed or session.config.option.collectonly:
            return result
        from vtbdrake.testing.mutants import MutationScore, mutants_of

        groups: list[tuple[Scenario, list[pytest.Item]]] = []
        for item, scenario in self.scenarios:
            group = next((items for other, items in groups if other == scenario), None)
            if group is None:
                groups.append((scenario, [item]))
            else:
                group.append(item)
        for scenario, items in groups:
            score = MutationScore()
            self.scores.append((type(scenario).__name__, score))
            for self.mutant in mutants_of(scenario):
                reason = next((item.nodeid for item in items if _fails(item)), None)
                if reason is None:
                    score.survived.append(self.mutant)
                else:
                    score.killed[self.mutant] = reason
        self.mutant = None
        return result

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail if the tests notice too few mutants."""
        if any(score.share < session.config.getoption("vtb_mutants") for _, score in self.scores):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: Any, config: pytest.Config) -> None:
        """Print which mutants survived."""
        for name, score in self.scores:
            terminalreporter.section(f"mutants of {name}")
            terminalreporter.write_line(str(score))
            if score.share < (least := config.getoption("vtb_mutants")):
                terminalreporter.write_line(f"too few: {100.0 * least:.0f} % are required", red=True)
        if not self.scores:
            terminalreporter.section("mutants")
            terminalreporter.write_line("none: tests failed, or none uses the fixture `scenario`")


def _fails(item: pytest.Item) -> bool:
    # No public function of pytest runs a test again; pytest-rerunfailures uses this one, too.
    from _pytest.runner import runtestprotocol

    return any(report.failed for report in runtestprotocol(item, log=False, nextitem=None))


def pytest_configure(config: pytest.Config) -> None:
    """Register the runs with mutants, if they are asked for."""
    if config.getoption("vtb_mutants") is None:
        return
    if getattr(config.option, "numprocesses", None):
        raise pytest.UsageError("--vtb-mutants runs tests one after the other: leave out -n")
    config.pluginmanager.register(_Mutants(), _MUTANTS)
