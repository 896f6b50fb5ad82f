"""A calibrated scenario: its file, where its numbers are from, and samples as beliefs and as conditions."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.pendulum import ARM, DRIVES, PendulumScenario, recorded
from tests.calibration.test_calibration import COULOMB, FIRST, MOMENT, PARAMETERS, TRUTH, VISCOUS, calibrated
from tests.cli.program import run
from vtbdrake.calibration import Calibration, Inertia
from vtbdrake.optimization import Parameter, Problem
from vtbdrake.recording import DrivenScenario
from vtbdrake.rollout import Quality
from vtbdrake.testbed import ScenarioError, load_scenario
from vtbdrake.testbed.pedigree import Number, Pedigree, Posterior

pytestmark = pytest.mark.one_python

NAME = "tests.calibration.pendulum:PendulumScenario"


@cache
def result() -> Calibration:
    return calibrated(recorded(TRUTH, 21, seconds=6.0))


@cache
def result_of_inertia() -> Calibration:
    return calibrated(recorded(TRUTH, 22, seconds=6.0), PARAMETERS[2:], inertias=[Inertia(f"{ARM}.link")])


@pytest.mark.slow_cases
@pytest.mark.parametrize("make", [result, result_of_inertia])
def test_file_gives_the_calibrated_scenario_again(make, tmp_path: Path) -> None:
    calibration = make()
    calibration.scenario.save(tmp_path / "arm.yaml")
    loaded = load_scenario(f"{NAME}@{tmp_path / 'arm.yaml'}")
    assert loaded == calibration.scenario and loaded.pedigree == calibration.scenario.pedigree
    testbed, original = loaded.build(), calibration.scenario.build()
    context, original_context = testbed.default_context(), original.default_context()
    for address, each in calibration.parameters.items():
        value = testbed.read(context, address)
        # Bit for bit, whatever the text of the file; Drake keeps inertias divided by the mass.
        assert value == original.read(original_context, address) == pytest.approx(each.value, rel=1e-14), address
        assert loaded.pedigree.numbers[address].source == "calibrated"
    (digest,) = loaded.pedigree.logs.values()
    assert len(digest) == 64 and digest == recorded(TRUTH, 21 if make is result else 22, seconds=6.0).digest
    assert PendulumScenario() != loaded and PendulumScenario().record() != loaded.record()


def test_numbers_that_were_not_accepted_warn_where_they_are_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scenario = PendulumScenario().with_values({})
    scenario.pedigree.reasons = ["the innovations are coloured"]
    scenario.pedigree.posterior = Posterior(
        addresses=[COULOMB], mean=[0.2], covariance=[[0.0]], lower=[0.0], upper=[1.0]
    )
    scenario.save(tmp_path / "arm.yaml")
    loaded = load_scenario(f"{NAME}@{tmp_path / 'arm.yaml'}")
    assert "arm.yaml has numbers of a calibration that was not accepted: the innovations are coloured" in caplog.text
    with pytest.warns(UserWarning, match="PendulumScenario was not accepted, .*: the innovations are coloured"):
        assert loaded.samples(1) == [{COULOMB: 0.2}]


def test_file_without_a_pedigree_is_as_it_was(tmp_path: Path) -> None:
    PendulumScenario().save(tmp_path / "arm.yaml")
    assert "pedigree" not in (tmp_path / "arm.yaml").read_text()
    assert load_scenario(f"{NAME}@{tmp_path / 'arm.yaml'}") == PendulumScenario()
    assert not any("pedigree" in key for key in PendulumScenario().record())


def test_calibrated_scenario_drives_and_thinks_with_its_numbers() -> None:
    scenario, value = result().scenario, result().parameters[COULOMB].value
    driven = DrivenScenario(scenario=scenario, log=recorded(TRUTH, 21, seconds=6.0)).build()
    for testbed in (scenario.build(), scenario.mental().build(), driven):
        assert testbed.read(testbed.default_context(), COULOMB) == value


def test_samples_have_the_covariance_of_the_estimate() -> None:
    scenario = result().scenario
    samples = scenario.samples(4000, seed=1)
    assert samples[:3] == scenario.samples(3, seed=1) != scenario.samples(3, seed=2)
    table = np.array([[sample[a] for a in (FIRST, MOMENT, COULOMB, VISCOUS)] for sample in samples])
    posterior = scenario.pedigree.posterior
    spread = np.sqrt(np.diag(posterior.covariance))
    np.testing.assert_allclose(table.mean(axis=0), posterior.mean, atol=0.08 * spread.max())
    np.testing.assert_allclose(
        np.cov(table.T) / np.outer(spread, spread), posterior.covariance / np.outer(spread, spread), atol=0.1
    )


def test_samples_carry_the_disturbance_of_the_recordings() -> None:
    """The machine's disturbance of 0.2 N m and 50 ms is in no log; a simulation with a sample has it."""
    scenario = calibrated(recorded(TRUTH, 21, seconds=6.0, disturbance=0.2)).scenario
    first, second = scenario.samples(2)
    assert scenario.samples(1, disturbances=False) == [{a: first[a] for a in (FIRST, MOMENT, COULOMB, VISCOUS)}]
    assert first[f"{DRIVES}.seed"] != second[f"{DRIVES}.seed"]
    testbed = DrivenScenario(scenario=scenario, log=recorded(TRUTH, 21, seconds=6.0)).build()
    torques = []
    for sample in (first, second):
        context = testbed.default_context()
        testbed.write(context, sample)
        simulator = testbed.simulator(context)
        for k in range(1, 301):
            simulator.AdvanceTo(0.01 * k)
            torques.append(float(testbed.read(context, f"{DRIVES}.disturbing_torque[0]")))
    # 6 s have 60 independent pieces of 2 T: the deviation is known to 9 %, and the machine's to 9 %, too.
    assert np.std(torques) == pytest.approx(0.2, rel=0.4)
    assert np.corrcoef(torques[:-5], torques[5:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.25)


def test_samples_of_an_inertia_are_bodies_that_the_plant_takes() -> None:
    calibration = result_of_inertia()
    testbed = calibration.scenario.build()
    for sample in calibration.scenario.samples(20):
        context = testbed.default_context()
        testbed.write(context, sample)
        body = testbed.plant.GetBodyByName("link")
        inertia = body.CalcSpatialInertiaInBodyFrame(testbed.plant.GetMyContextFromRoot(context))
        assert inertia.IsPhysicallyValid()
        # Mass and centre are not told apart, their product is.
        assert sample[f"{ARM}.link.mass"] * sample[FIRST] == pytest.approx(-0.36, rel=0.02)


def test_samples_are_conditions_of_a_study_and_worlds_of_a_reasoner() -> None:
    scenario = result().scenario
    samples = scenario.samples(4, seed=3)
    problem = Problem(
        scenario=scenario,
        parameters=[Parameter(f"{ARM}.pivot.position", 0.5, 1.0)],
        quality=Quality(abs, of=[f"{ARM}.pivot.velocity"]),
        horizon=0.5,
        conditions=samples,
        risk="worst",
    )
    values = [problem.rollout([0.8], condition=k).h for k in range(4)]
    assert len(set(values)) == 4
    # Each world by itself, as a scenario.
    world = scenario.with_values(samples[2]).build()
    assert world.read(world.default_context(), FIRST) == samples[2][FIRST]


def test_command_line_shows_which_numbers_are_guesses(tmp_path: Path) -> None:
    scenario = result().scenario
    scenario.pedigree.numbers[f"{ARM}.link.mass"] = Number(source="datasheet", note="drawing 17")
    scenario.save(tmp_path / "arm.yaml")
    done = run("variables", f"{NAME}@{tmp_path / 'arm.yaml'}", "--pedigree")
    assert done.exit_code == 0, done.output
    rows = {line.split()[0]: line for line in done.output.splitlines() if line.startswith(("sim.", "scenario."))}
    assert "datasheet" in rows[f"{ARM}.link.mass"] and "drawing 17" in rows[f"{ARM}.link.mass"]
    assert "calibrated" in rows[COULOMB] and "accepted" in rows[COULOMB]
    assert "assumed" in rows[f"{DRIVES}.time_constant"] and "assumed" in rows["scenario.time_step"]
    assert "4 calibrated" in done.output.splitlines()[-1]


@pytest.mark.parametrize(
    ("pedigree", "message"),
    [
        (Pedigree(numbers={f"{ARM}.link.mas": Number(value=1.0)}), "no variable 'sim.sys.pendulum.link.mas'"),
        (Pedigree(numbers={f"{ARM}.link.mass": Number(value=-1.0)}), "link.mass must lie in"),
        (Pedigree(numbers={"scenario.mass": Number(value=1.0)}), "scenario.mass a value: set the field itself"),
    ],
)
def test_pedigree_that_does_not_fit_is_refused(pedigree: Pedigree, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PendulumScenario(pedigree=pedigree).build()


def test_impossible_source_is_refused() -> None:
    with pytest.raises(ValueError, match="source"):
        Number(source="rumour")
    with pytest.raises(ScenarioError, match="nothing was calibrated"):
        PendulumScenario().samples(2)
