"""The identity of a problem: its meaning counts, not the way in which it is written."""

import functools
import importlib
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from tests.optimization.studies import DAMPING, THETA, pendulum_problem
from tests.testbeds import PendulumScenario
from vtbdrake.optimization import Choice, CVaR, Risk, StudyError
from vtbdrake.optimization.identity import describe
from vtbdrake.rollout import Constraint, Quality

ROOT = Path(__file__).resolve().parents[2]
WANTED = 0.3


def away_from(wanted):
    return lambda theta: abs(theta - wanted)


def distance(theta, wanted):
    return abs(theta - wanted)


def square(theta, wanted):
    return (theta - wanted) ** 2


def from_the_wanted(theta):
    return distance(theta, WANTED)


class Distance:
    def __init__(self, wanted):
        self.wanted = wanted

    def __call__(self, theta):
        return abs(theta - self.wanted)


class Best(Risk):
    def __call__(self, h):
        return float(h.max())


def typed(text):
    """A function that was typed into an interpreter: it has no source."""
    return eval(text, {})


def quality(function):
    return pendulum_problem(quality=Quality(function, THETA, minimize=True))


@pytest.mark.parametrize(
    ("one", "same", "other"),
    [
        (away_from(0.3), away_from(np.float64(0.3)), away_from(0.4)),
        (
            functools.partial(distance, wanted=0.3),
            functools.partial(distance, wanted=0.3),
            functools.partial(distance, wanted=0.4),
        ),
        (
            functools.partial(distance, wanted=0.3),
            functools.partial(distance, wanted=0.3),
            functools.partial(square, wanted=0.3),
        ),
        (Distance(0.3), Distance(0.3), Distance(0.4)),
        (Distance(0.3).__call__, Distance(0.3).__call__, Distance(0.4).__call__),
        (typed("lambda x: abs(x)"), typed("lambda x: abs(x)"), typed("lambda x: x * x")),
        (abs, abs, np.square),
    ],
)
def test_a_quality_function_is_what_it_computes(tmp_path, one, same, other):
    path = tmp_path / "a.db"
    quality(one).study(path).close()
    quality(same).study(path).close()
    with pytest.raises(StudyError, match="has other code, or uses other values|qualities"):
        quality(other).study(path)


def test_a_constant_of_the_module_belongs_to_a_quality_function(monkeypatch):
    before = describe(quality(from_the_wanted))
    monkeypatch.setattr(sys.modules[__name__], "WANTED", 0.5)
    assert describe(quality(from_the_wanted)) != before


def test_constants_in_a_comprehension_belong_to_a_quality_function(monkeypatch):
    def nearest(theta):
        return min(abs(theta - wanted) for wanted in [WANTED, 2.0 * WANTED])

    before = describe(quality(nearest))
    monkeypatch.setattr(sys.modules[__name__], "WANTED", 0.5)
    assert describe(quality(nearest)) != before


GAINS = "def gain():\n    return {gain}\n"
LAW = """
import gains_of_a_test
from tests.testbeds import PendulumScenario


class LawScenario(PendulumScenario):
    def make_dps(self):
        gains_of_a_test.gain()
        return super().make_dps(){more}
"""


def law_problem(folder, *, gain="1.0", more=""):
    (folder / "gains_of_a_test.py").write_text(GAINS.format(gain=gain))
    (folder / "law_of_a_test.py").write_text(LAW.format(more=more))
    for name in ("gains_of_a_test", "law_of_a_test"):
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    return pendulum_problem(scenario=importlib.import_module("law_of_a_test").LawScenario())


@pytest.mark.parametrize("change", [{"gain": "2.25"}, {"more": " or None"}])
def test_a_changed_dps_is_told_and_noted_where_it_is_allowed(tmp_path, monkeypatch, change):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    path, told = tmp_path / "a.db", "has other code, or uses other values"
    with law_problem(tmp_path).study(path, solver="sobol") as study:
        study.run(rollouts=4, executor="serial", progress=False)
    law_problem(tmp_path, more="  # a comment").study(path).close()
    changed = law_problem(tmp_path, **change)
    with pytest.raises(StudyError, match=f"law_of_a_test:LawScenario, a part of the testbed, {told}.*=True"):
        changed.study(path)
    with changed.study(path, allow_changed_code=True) as study:
        study.run(rollouts=6, executor="serial", progress=False)
        assert len(study) == len(study.trials) == 6
        (noted,) = study.record["changes"]
        assert noted["what"] == [f"law_of_a_test:LawScenario, a part of the testbed, {told}"]
        assert "the code changed on " in study.summary()
    changed.study(path).close()
    with pytest.raises(StudyError, match="of another problem"):
        pendulum_problem().study(path, allow_changed_code=True)


class Law(LeafSystem):
    """A system whose function is handed in."""

    def __init__(self, function):
        super().__init__()
        self.function = function
        self.DeclareVectorOutputPort("y", 1, lambda context, y: y.SetFromVector([self.function(0.0)]))


@pytest.mark.parametrize(("one", "other"), [(away_from(0.3), away_from(0.4)), (away_from(0.3), from_the_wanted)])
def test_a_function_that_a_system_holds_is_code_of_the_testbed(one, other):
    class HoldingScenario(PendulumScenario):
        def add_world(self, builder):
            super().add_world(builder)
            builder.add("env", "law", Law(held[0]))

    def code(function):
        held[0] = function
        return describe(pendulum_problem(scenario=HoldingScenario()))["code"]

    held = [one]
    assert any("test_identity:Law" in name for name in code(one))
    assert code(one) == code(away_from(0.3)) != code(other)


class Steady(Risk):
    def __init__(self, weights):
        self.weights = weights

    def __call__(self, h):
        return float(h @ self.weights)


def test_what_a_risk_holds_is_code(tmp_path):
    pendulum_problem(risk=Steady([1.0])).study(tmp_path / "a.db").close()
    pendulum_problem(risk=Steady([1.0])).study(tmp_path / "a.db").close()
    with pytest.raises(StudyError, match="test_identity:Steady, a part of the testbed, has other code"):
        pendulum_problem(risk=Steady([2.0])).study(tmp_path / "a.db")


def test_a_file_that_the_scenario_reads_is_part_of_s0(tmp_path):
    class ReadingScenario(PendulumScenario):
        def add_world(self, builder):
            super().add_world(builder)
            offset = float((tmp_path / "offset").read_text())
            builder.add("env", "offset", ConstantVectorSource([offset]))

    def study():
        return pendulum_problem(scenario=ReadingScenario()).study(tmp_path / "a.db")

    (tmp_path / "offset").write_text("0.3")
    study().close()
    (tmp_path / "offset").write_text("0.30000000000000004")  # The last digit differs between processors.
    study().close()
    (tmp_path / "offset").write_text("0.4")
    with pytest.raises(StudyError, match="the scenario builds another s0, perhaps from a changed file"):
        study()


def test_another_python_cannot_compare_the_code(tmp_path, monkeypatch):
    path = tmp_path / "a.db"
    pendulum_problem().study(path).close()
    monkeypatch.setattr(sys, "version_info", (3, 99))
    with pytest.raises(StudyError, match=r"Python 3\.\d+, whose code cannot be compared with the code of 3\.99.*=True"):
        pendulum_problem().study(path)
    pendulum_problem().study(path, allow_changed_code=True).close()
    pendulum_problem().study(path).close()


def test_what_cannot_be_read_is_said(tmp_path, caplog):
    lock = threading.Lock()

    def locked(theta):
        with lock:
            return abs(theta)

    with quality(locked).study(tmp_path / "a.db") as study:
        told = "changes would go unnoticed inside objects that cannot be read: _thread.lock (in the function locked)"
        assert told in caplog.text
        assert told in study.summary()


def test_edited_values_of_a_function_are_told(tmp_path):
    wanted = {"angles": [0.3]}

    def nearest(theta):
        return min(abs(theta - angle) for angle in wanted["angles"])

    quality(nearest).study(tmp_path / "a.db").close()
    wanted["angles"].append(0.5)
    with pytest.raises(StudyError, match="the function nearest has other code, or uses other values"):
        quality(nearest).study(tmp_path / "a.db")


@pytest.mark.slow
def test_another_process_knows_the_same_functions():
    code = (
        "from tests.optimization.test_identity import *\n"
        "made = [away_from(0.3), Distance(0.3), from_the_wanted, functools.partial(square, wanted=0.3)]\n"
        "print([describe(quality(f))['qualities'] for f in made], describe(pendulum_problem(risk=Best()))['risk'])"
    )
    first, second = (
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert first == second != ""


def test_numbers_of_numpy_and_whole_numbers_are_numbers():
    def problem(number, conditions):
        return pendulum_problem(
            horizon=number(1),
            sample_period=number(1),
            quality=Quality(abs, THETA, upper=number(4)),
            constraints=[Constraint(abs, THETA, at_most=number(2))],
            risk=CVaR(number(1)),
            conditions=conditions,
        )

    expected = describe(problem(float, [{DAMPING: 0.0}]))
    for number in (int, np.int64, np.float64, np.float32):
        assert describe(problem(number, [{DAMPING: np.float64(0.0)}])) == expected


def test_options_of_numpy_are_options():
    assert Choice(DAMPING, np.arange(3)).options == (0, 1, 2)
    assert Choice(DAMPING, np.arange(3)) == Choice(DAMPING, [0, 1, 2])


@pytest.mark.parametrize(("solver", "options"), [("grid", {"points": (2, 3)}), ("cmaes", {"population": np.int64(5)})])
def test_a_study_with_options_is_resumed_with_the_same_options(tmp_path, solver, options):
    for _ in range(2):
        with pendulum_problem().study(tmp_path / "a.db", solver=solver, options=options) as study:
            assert len(study.run(rollouts=6, executor="serial", progress=False)) == 6


def test_unstorable_option_leaves_no_file(tmp_path):
    with pytest.raises(ValueError, match="a study keeps the options of its solver, which are numbers, words"):
        pendulum_problem().study(tmp_path / "a.db", solver="TPE", options={"sampler_options": {"gamma": len}})
    assert not (tmp_path / "a.db").exists()
