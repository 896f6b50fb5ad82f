"""Where a model is valid: shares of windows outside, distances against SciPy's, and who says that it is left."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.spatial
from pydrake.systems.framework import Context, System

import vtbdrake as vtb
from tests.monitoring.residuals.line import Line, Together, loop
from tests.monitoring.residuals.pendulum import MASS, PAYLOAD, PERIOD, DrivenPendulum, Rhythm, machine
from tests.reasoning.scenarios import MassScenario
from vtbdrake import ValidityDomain, ValidityDomainError
from vtbdrake.common.validity_domain import DomainWatch
from vtbdrake.monitoring import DomainMonitor
from vtbdrake.recording import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario

pytestmark = pytest.mark.one_python


@dataclass
class Motion:
    """A recorded motion."""

    times: np.ndarray
    record: Mapping[str, Any]


def swing(generator: np.random.Generator, *, speed: float = 1.0, load: float = 1.0, offset: float = 0.0) -> Motion:
    """Two joints that swing with random phases and speeds, and the torques of their masses, measured with noise."""
    t = 0.1 * np.arange(150)
    w = speed * generator.uniform(0.9, 1.1, 2) * [1.0, 1.7]
    phase = w * t[:, np.newaxis] + generator.uniform(0.0, 2.0 * np.pi, 2)
    q, v, a = offset + np.sin(phase), w * np.cos(phase), -(w**2) * np.sin(phase)
    u = load * (a + 5.0 * np.sin(q)) + 0.3 * v + 0.02 * generator.normal(size=q.shape)
    return Motion(t, {"q": q, "v": v, "u": u})


def swinging(generator: np.random.Generator, count: int = 6, **options: Any) -> ValidityDomain:
    return ValidityDomain.of([swing(generator) for _ in range(count)], ["q", "v", "u"], window=0.1, **options)


def outside(domain: ValidityDomain, motion: Motion) -> float:
    x = np.hstack([motion.record[address] for address in domain.addresses])
    return float(np.mean([domain.factor(row) > 1.0 for row in x]))


def test_windows_of_new_recordings_lie_outside_as_rarely_as_the_quantile_says() -> None:
    generator = np.random.default_rng(0)
    for quantile in (0.9, 0.98):
        shares = []
        for _ in range(12):
            domain = swinging(generator, quantile=quantile)
            shares += [outside(domain, swing(generator)) for _ in range(4)]
        # Recordings differ, so that the shares scatter; their mean is the mean of 48 recordings.
        assert np.mean(shares) == pytest.approx(1.0 - quantile, abs=0.4 * (1.0 - quantile) + 0.01)


@pytest.mark.slow_cases
@pytest.mark.parametrize("change", [{"speed": 1.6}, {"load": 1.25}, {"offset": 0.8}], ids=str)
def test_other_motions_are_noticed(change: Mapping[str, float]) -> None:
    generator = np.random.default_rng(1)
    domain = swinging(generator)
    departures = [domain.departure(swing(generator, **change)) for _ in range(20)]
    assert None not in departures
    # The same motions are not taken for others; a row of windows by chance is rare.
    assert sum(domain.departure(swing(generator)) is not None for _ in range(40)) <= 4


def test_factor_is_the_distance_of_mahalanobis_to_the_nearest_windows() -> None:
    generator = np.random.default_rng(2)
    domain = swinging(generator, neighbours=4)
    inverse = np.linalg.inv(np.cov(domain.features.T, bias=True))
    tree = scipy.spatial.cKDTree(domain.features @ np.linalg.cholesky(inverse))
    for x in generator.normal(scale=2.0, size=(20, 6)):
        distances, _ = tree.query(x @ np.linalg.cholesky(inverse), k=4)
        assert domain.factor(x) * domain.radius == pytest.approx(np.sqrt(np.mean(distances**2)), rel=1e-6)


def test_departure_names_first_time_feature_and_range() -> None:
    generator = np.random.default_rng(3)
    domain = swinging(generator, count=20, patience=3)
    motion = swing(generator)
    spoiled = {name: values.copy() for name, values in motion.record.items()}
    spoiled["u"][40, 1] += 30.0  # One window is chance; three in a row are not.
    spoiled["u"][90:, 1] += 30.0
    departure = domain.departure(Motion(motion.times, spoiled))
    assert departure is not None and departure.time == pytest.approx(9.0) and departure.feature == "u[1]"
    assert departure.value == spoiled["u"][90, 1] and departure.factor > 1.0
    column = domain.features[:, 5]
    assert (departure.lower, departure.upper) == (column.min(), column.max())
    assert "left at t = 9.000 s by a factor of" in str(departure) and "most by u[1] = " in str(departure)


def test_departure_is_told_once() -> None:
    domain = swinging(np.random.default_rng(4), patience=2)
    watch = DomainWatch(domain)
    far = np.full(6, 50.0)
    departures = [watch.add(float(t), far if t % 5 else np.zeros(6)) for t in range(20)]
    assert [departure.time for departure in departures if departure is not None] == [1.0]
    assert (watch.windows, watch.outside) == (20, 16)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_no_numbers_lie_outside(bad: float) -> None:
    domain = swinging(np.random.default_rng(5), patience=1)
    x = np.array([0.1, bad, 0.0, 0.0, 0.0, 0.0])
    assert domain.factor(x) == np.inf
    departure = DomainWatch(domain).add(1.0, x)
    assert departure is not None and departure.feature == "q[1]"


def test_feature_that_never_changed_tells_any_change() -> None:
    generator = np.random.default_rng(6)
    locked = [Motion(m.times, {**m.record, "lock": np.full(150, 0.7)}) for m in (swing(generator) for _ in range(4))]
    domain = ValidityDomain.of(locked, ["q", "v", "lock"])
    inside = domain.features[10]
    assert domain.factor(inside) < 1.0
    assert domain.factor(np.append(inside[:4], inside[4] + 0.01)) > 10.0


def test_residuals_are_those_of_the_nearest_windows() -> None:
    generator = np.random.default_rng(7)
    motions = [swing(generator) for _ in range(4)]
    # A model that is the worse the faster the joints.
    residuals = [Motion(m.times, {"residual": np.linalg.norm(m.record["v"], axis=1)}) for m in motions]
    domain = ValidityDomain.of(motions, ["q", "v"], residuals=residuals, window=0.1)
    fast = np.linalg.norm(domain.features[:, 2:], axis=1) > 1.5
    expected = np.array([domain.residual(x) for x in domain.features])
    assert np.corrcoef(expected, np.linalg.norm(domain.features[:, 2:], axis=1))[0, 1] > 0.9
    assert np.median(expected[fast]) > 1.4 > 1.2 > np.median(expected[~fast])
    assert np.isnan(swinging(generator).residual(np.zeros(6)))


def test_domain_goes_through_a_file(tmp_path: Path) -> None:
    domain = swinging(np.random.default_rng(8), neighbours=3, quantile=0.95, patience=4)
    scenario = DoublePendulumScenario()
    scenario.save(tmp_path / "pendulum.yaml", domain=domain)
    name = "vtbdrake_diagrams.double_pendulum:DoublePendulumScenario"
    again = vtb.load_scenario(f"{name}@{tmp_path / 'pendulum.yaml'}")
    assert again.pedigree == scenario.pedigree
    for copied in (ValidityDomain.load(tmp_path / again.pedigree.domain), pickle.loads(pickle.dumps(domain))):
        x = np.arange(6.0)
        assert (copied.factor(x), copied.radius, copied.patience) == (domain.factor(x), domain.radius, 4)
        assert copied.sizes == domain.sizes


def test_one_recording_is_cut_into_parts() -> None:
    motion = swing(np.random.default_rng(9))
    domain = ValidityDomain.of([motion], ["q"], window=0.2)
    assert len(domain.features) == 75 and set(domain.recordings) == set(range(5))
    assert len(ValidityDomain.of([motion] * 10, ["q"], window=0.1).features) == 500


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: ValidityDomain.of([], ["q"]), "one recording at least"),
        (lambda m: ValidityDomain.of([m, m], ["w"]), "w is not in the recording, which has q, v, u"),
        (lambda m: ValidityDomain.of([m, m], ["q"], window=10.0), "are too few"),
        (lambda m: ValidityDomain.of([m, m], ["q"], quantile=1.1), "the quantile at most 1"),
        (lambda m: ValidityDomain.of([m, m], ["q"], residuals=[m]), "2 recordings, but 1"),
        (lambda m: ValidityDomain.of([Motion(m.times, {"q": m.times * np.nan})], ["q"]), "not finite"),
        (lambda m: ValidityDomain.load("missing.json"), "cannot read the validity domain missing.json: No such file"),
        (lambda m: ValidityDomain.load(__file__), "test_domain.py is no file of a validity domain"),
        (
            lambda m: ValidityDomain.of([m, m], ["q"]).departure(Motion(m.times, {"q": m.times})),
            r"sizes \{'q': 1\} do not fit",
        ),
    ],
)
def test_what_makes_no_domain_is_refused(call: Any, message: str) -> None:
    with pytest.raises(ValidityDomainError, match=message):
        call(swing(np.random.default_rng(10)))


FEATURES = ["dps.seen", "dps.torque"]


@pytest.mark.slow
def test_rollout_and_loop_say_that_they_leave_the_domain(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    scenario = DrivenPendulum()
    runner = RolloutRunner(RolloutTask(scenario=scenario, horizon=60.0, sample_period=PERIOD, record=FEATURES))
    starts = [{"sim.sys.Pendulum.theta.position": q} for q in (0.0, 0.1, 0.2, 0.3)]
    domain = ValidityDomain.of([runner.run(start) for start in starts], FEATURES, window=PERIOD)
    assert domain.departure(runner.run({"sim.sys.Pendulum.theta.position": 0.15})) is None
    heavy = domain.departure(runner.run({PAYLOAD: 5.0 * MASS}))
    assert heavy is not None and heavy.feature.startswith("dps.")

    for mass, leaves in ((MASS, False), (5.0 * MASS, True)):
        caplog.clear()
        together = Together(scenario, machine(scenario, values={PAYLOAD: mass}))
        log = tmp_path / f"{mass}.log"
        with Recorder(together.driver, log) as recorder, DomainMonitor(together.driver, domain) as monitor:
            recorder.wait_until_ready()
            together.run(600)
        assert (monitor.departure is not None) == leaves and monitor.windows == 600
        assert caplog.text.count("the validity domain of the model is left") == leaves
        # The log of the run tells the same.
        again = domain.departure(replay(log, record=FEATURES))
        assert (again is None) == (monitor.departure is None)
        if again is not None and monitor.departure is not None:
            assert again.feature == monitor.departure.feature


class Faulty(Rhythm):
    """Fails for half a second from 2 s on: it raises, or commands NaN."""

    def __init__(self, fault: str) -> None:
        super().__init__(PERIOD)
        self._fault = fault

    def _update(self, context: Context, discrete: Any) -> None:
        super()._update(context, discrete)
        if 1.95 < context.get_time() < 2.45:
            if self._fault == "raises":
                raise RuntimeError("a lost thread")
            self._command.mutable(discrete).torque = np.nan


@dataclass
class FaultyPendulum(DrivenPendulum):
    fault: str = "raises"

    def make_dps(self) -> System:
        return Faulty(self.fault)


# The cycle that first fails is that at 2.0 s, cycle 30; a DPS that raises stays where it was.
@pytest.mark.parametrize(("fault", "windows"), [("raises", 10), ("commands NaN", 25)])
def test_monitor_reads_once_per_window_unless_the_dps_is_idle_or_raises(fault: str, windows: int) -> None:
    times, generator = PERIOD * np.arange(150), np.random.default_rng(11)
    records = ({"dps.seen": generator.normal(size=(150, 2)), "dps.torque": generator.normal(size=150)} for _ in "abc")
    domain = ValidityDomain.of([Motion(times, record) for record in records], FEATURES, window=2.0 * PERIOD)
    scenario = FaultyPendulum(fault=fault)
    runtime = loop(DpsAlone(scenario), Line(scenario, machine(scenario)), PERIOD, begin=False)
    with DomainMonitor(runtime, domain) as monitor:
        for cycle in range(60):
            if cycle == 10:
                assert monitor.windows == 0
                runtime.start_dps()
            runtime.clock.wait_until(runtime.clock.now() + PERIOD)
            runtime.cycle()
    assert monitor.windows == windows


def test_decision_says_that_its_plan_leaves_the_domain() -> None:
    # A mass that is pushed from rest, and back from the instant u.switch on.
    scenario, features = MassScenario(), ["sim.sys.mass.y0"]
    runner = RolloutRunner(RolloutTask(scenario=scenario, horizon=3.0, sample_period=0.1, record=features))
    early = [runner.run({"u.switch": switch}) for switch in (0.2, 0.25, 0.3, 0.35, 0.4)]
    domain = ValidityDomain.of(early, features, window=0.1)
    testbed = scenario.build()
    context = testbed.default_context()

    def decide(least: float, **options: Any) -> vtb.Decision:
        with vtb.Reasoner(
            scenario=scenario,
            decision=[vtb.Parameter("u.switch", least, least + 0.05)],
            quality=vtb.Quality(lambda state: abs(state[0] - 9.0), of=features[0], minimize=True, reading="end"),
            horizon=3.0,
            sample_period=0.1,
            budget=vtb.Budget(rollouts=8),
            search=vtb.SearchConfig(executor="serial"),
            **options,
        ) as reasoner:
            testbed.write(context, {"u.switch": least})
            return reasoner.decide(vtb.Belief.perfect(testbed, context))

    assert not decide(0.3, domain=domain).warnings and not decide(2.0).warnings
    far = decide(2.0, domain=domain)
    assert far and any("with this plan the validity domain of the model is left" in text for text in far.warnings)
    fence = vtb.Constraint(domain.excess, of=features, at_most=1.0)
    assert not decide(2.0, constraints=[fence]) and decide(0.3, constraints=[fence])
