"""`Problem.check` finds what would make rollouts differ, or not travel, and says where."""

import os
import threading
from dataclasses import dataclass

import pytest

import vtbdrake as vtb
from tests.testbeds import AcrobotScenario, PendulumScenario, SampledFeedback
from vtbdrake.rollout.repeatability import Check

SHOULDER = "sim.sys.Acrobot.shoulder.position"
THETA = "sim.sys.Pendulum.theta.position"


def _problem(scenario, quality=abs, of=SHOULDER):
    return vtb.Problem(
        scenario=scenario,
        parameters=[vtb.Parameter(of, 0.1, 1.0)],
        quality=vtb.Quality(quality, of=of),
        horizon=0.5,
    )


class Forgetful(SampledFeedback):
    """Sums up in itself, as no system may; ``again`` says whether it begins at zero in each rollout."""

    def __init__(self, again):
        super().__init__(0.02)
        self._sum = 0.0
        if again:
            self.DeclareInitializationDiscreteUpdateEvent(self._forget)

    def _forget(self, context, discrete):
        self._sum = 0.0

    def _update(self, context, discrete):
        self._sum += float(self._state.Eval(context)[0])
        discrete.set_value(0, [-0.5 * self._sum])


@dataclass
class ForgetfulScenario(AcrobotScenario):
    again: bool = False

    def make_dps(self):
        return Forgetful(self.again)


@pytest.mark.slow_cases
@pytest.mark.parametrize("scenario", [AcrobotScenario(), PendulumScenario()])
def test_nothing_is_found_where_nothing_is_wrong(scenario):
    found = _problem(scenario, of=SHOULDER if isinstance(scenario, AcrobotScenario) else THETA).check_repeatability()
    assert found.ok and found.findings == ()
    assert 0.0 < found.seconds <= 0.5
    assert str(found).startswith("nothing found: rollouts repeat over ")


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("again", "what"),
    [(False, "a second rollout of the same point"), (True, "a rollout that runs beside another one")],
)
def test_memory_in_self_is_named_with_its_system(again, what):
    found = _problem(ForgetfulScenario(again=again)).check_repeatability()
    (finding,) = found.findings
    assert finding.startswith(f"{what} differs from t = 0.05 s on: self._sum of dps (Forgetful) has memory outside")
    assert "DeclareDiscreteState" in finding
    assert not found.ok and str(found) == finding


class WithModel(SampledFeedback):
    """Computes with a plant, whose Context it keeps; it sets all of it before each use."""

    def __init__(self):
        super().__init__(0.02)
        self._plant = AcrobotScenario().build().plant
        self._model = self._plant.CreateDefaultContext()

    def _update(self, context, discrete):
        self._plant.SetPositionsAndVelocities(self._model, self._state.Eval(context))
        discrete.set_value(0, [-0.1 * self._plant.CalcPotentialEnergy(self._model)])


@dataclass
class ModelScenario(AcrobotScenario):
    def make_dps(self):
        return WithModel()


def test_a_context_kept_in_self_is_named():
    (finding,) = _problem(ModelScenario()).check_repeatability().findings
    assert finding.startswith("self._model of dps (WithModel) is a Context: rollouts in threads share it")


def test_a_quality_with_memory_is_named():
    calls = []

    def counted(theta):
        calls.append(theta)
        return abs(theta) + len(calls)

    (finding,) = _problem(AcrobotScenario(), counted).check_repeatability().findings
    assert finding.startswith("a second rollout of the same point differs at t = 0 s in its quality counted")


def test_what_a_quality_holds_and_cannot_be_sent_is_named():
    lock = threading.Lock()

    def locked(theta):
        return abs(theta) + lock.locked()

    (finding,) = _problem(AcrobotScenario(), locked).check_repeatability().findings
    assert finding.startswith("'lock', which the quality locked uses, cannot be sent to workers (TypeError: ")
    assert "executor='threads'" in finding


@dataclass
class PidScenario(AcrobotScenario):
    def make_dps(self):
        return SampledFeedback(0.02 + 0.001 * (os.getpid() != MAIN))


MAIN = int(os.environ.setdefault("VTB_TEST_MAIN", str(os.getpid())))


def test_what_depends_on_the_process_is_found():
    (finding,) = _problem(PidScenario()).check_repeatability().findings
    assert finding.startswith("in another process, a rollout of the same point gives another result")


def test_a_failing_simulation_is_compared_too():
    from tests.rollout.test_runner import BrokenScenario

    problem = vtb.Problem(
        scenario=BrokenScenario(kind="raises"),
        parameters=[vtb.Parameter(SHOULDER, 0.1, 1.0)],
        quality=vtb.Quality(abs, of=SHOULDER),
        horizon=2.0,
    )
    found = problem.check_repeatability()
    assert found.ok
    assert f"the rollout fails after {found.seconds:g} s: {found.failure}" in str(found)
    assert "RuntimeError: " in found.failure


def test_a_notebook_shows_the_sentences():
    check = Check(("x < y & z",), 0.1, "it fell")
    assert check._repr_html_() == (
        "<div>x &lt; y &amp; z</div><div>no more was compared, as the rollout fails after 0.1 s: it fell</div>"
    )
    assert repr(Check((), 0.1)).startswith("Check(nothing found: rollouts repeat over 0.1 s")
