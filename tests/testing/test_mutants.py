"""Mutants: mistakes in a diagram, and the share of them that weak and strong tests notice."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.testbeds import AcrobotScenario
from tests.testing.test_fixtures import user as user
from vtbdrake.testbed import Scenario, Signal
from vtbdrake.testing.mutants import KINDS, Mutant, mutants_of, mutate, mutation_score
from vtbdrake.testing.trace import simulate
from vtbdrake_diagrams.manipulator import ManipulatorScenario

pytestmark = pytest.mark.one_python

pytest_plugins = ["pytester"]

START = {"sim.sys.Acrobot.shoulder.position": 0.5, "sim.sys.Acrobot.elbow.position": -0.2}


def mutant(kind: str, side: str = "sense") -> Mutant:
    [match] = [m for m in mutants_of(AcrobotScenario()) if (m.kind, m.side) == (kind, side)]
    return match


def motion(scenario: Scenario) -> Any:
    return simulate(scenario.build(), 0.2, record=["sense.joint_state", "act.torque", "plant.state"], values=START)


def test_mutants_are_of_every_kind_at_every_signal() -> None:
    names = [str(mutant) for mutant in mutants_of(AcrobotScenario())]
    assert names == [
        "sense.joint_state: two entries swapped",
        "sense.joint_state: the opposite sign",
        "sense.joint_state: degrees for radians",
        "sense.joint_state: a sample later",
        "sense.joint_state: stuck",
        "act.torque: the opposite sign",
        "act.torque: a sample later",
        "act.torque: half the gain",
        "world: gravity off",
    ]
    assert {m.period for m in mutants_of(AcrobotScenario())} == {0.02, 0.0}


@pytest.mark.parametrize(
    ("kind", "matrix"),
    [
        ("two entries swapped", np.eye(4)[[1, 0, 2, 3]]),
        ("the opposite sign", -np.eye(4)),
        ("degrees for radians", np.degrees(np.eye(4))),
    ],
)
def test_sensor_shows_what_the_mistake_makes_of_it(kind: str, matrix: np.ndarray) -> None:
    testbed = mutate(AcrobotScenario(), mutant(kind)).build()
    trace = simulate(testbed, 0.2, record=["sense.joint_state", "sim.sense.joints.discrete_state_0"], values=START)
    expected = trace["sim.sense.joints.discrete_state_0"] @ matrix.T
    np.testing.assert_allclose(trace["sense.joint_state"], expected, rtol=1e-15)
    assert np.abs(expected[-1]).min() > 0.0


def test_late_sensor_is_a_sample_late() -> None:
    trace = simulate(
        mutate(AcrobotScenario(), mutant("a sample later")).build(),
        0.2,
        record=["sense.joint_state", "sim.sense.joints.discrete_state_0"],
        sample_period=0.02,
        values=START,
    )
    np.testing.assert_array_equal(trace["sense.joint_state"][2:], trace["sim.sense.joints.discrete_state_0"][1:-1])


def test_stuck_sensor_stays() -> None:
    trace = motion(mutate(AcrobotScenario(), mutant("stuck")))
    assert np.ptp(trace["sense.joint_state"][5:], axis=0).tolist() == [0.0] * 4
    assert np.ptp(trace["plant.state"], axis=0).min() > 0.0


def test_half_the_gain_is_half_the_torque() -> None:
    testbed = mutate(AcrobotScenario(), mutant("half the gain", "act")).build()
    context = testbed.default_context()
    testbed.write(context, {**START, "dps.torque": 4.0})
    actuation = testbed.plant.get_actuation_input_port()
    assert actuation.Eval(testbed.plant.GetMyContextFromRoot(context))[0] == 2.0


def test_without_gravity_nothing_falls() -> None:
    testbed = mutate(AcrobotScenario(), mutant("gravity off", "world")).build()
    trace = simulate(testbed, 0.2, record="plant.state", values=START | {"dps.gain": np.zeros(4)})
    assert np.ptp(trace["plant.state"], axis=0).tolist() == [0.0] * 4


def test_units_tell_which_entries_are_angles() -> None:
    def factors(unit: str, size: int) -> Any:
        system = KINDS["degrees for radians"](Signal("q", size=size, unit=unit), mutant("stuck"))
        if system is None:
            return None
        context = system.CreateDefaultContext()
        system.get_input_port().FixValue(context, np.ones(size))
        return system.get_output_port().Eval(context).round(2).tolist()

    assert factors("m, rad", 2) == [1.0, 57.3]
    assert factors("rad, rad/s", 4) == [57.3] * 4
    assert factors("m, rad", 4) == [1.0, 1.0, 57.3, 57.3] and factors("s, rad, ...", 3) == [1.0, 57.3, 57.3]
    assert factors("m, rad", 3) is None and factors("m", 1) is None
    assert factors("rad/s", 1) == [57.3]


def test_mutated_scenario_is_still_one() -> None:
    mutated = mutate(AcrobotScenario(period=0.01), mutant("the opposite sign"))
    assert isinstance(mutated, AcrobotScenario) and mutated.record() == AcrobotScenario(period=0.01).record()
    expected = motion(mutated)["sense.joint_state"]
    for copied in (pickle.loads(pickle.dumps(mutated)), replace(mutated), mutate(mutated, mutant("stuck"))):
        np.testing.assert_array_equal(motion(copied)["sense.joint_state"], expected)
    assert not np.array_equal(motion(AcrobotScenario(period=0.01))["sense.joint_state"], expected)


def test_abstract_signals_can_be_late_and_stuck() -> None:
    signal = Signal("pose", model_value=RigidTransform())
    assert [kind for kind, make in KINDS.items() if make(signal, mutant("stuck"))] == ["a sample later", "stuck"]


def weak(scenario: Scenario) -> None:
    assert scenario.build().variables()


def strong(scenario: Scenario) -> None:
    np.testing.assert_array_equal(motion(scenario)["act.torque"], motion(AcrobotScenario())["act.torque"])


def test_share_of_a_weak_and_of_a_strong_test() -> None:
    assert mutation_score(weak, AcrobotScenario()).share == 0.0
    score = mutation_score([weak, strong], AcrobotScenario())
    # The DPS weighs these two angles by 0.
    assert [str(mutant) for mutant in score.survived] == ["sense.joint_state: two entries swapped"]
    assert all(reason.startswith("strong (AssertionError") for reason in score.killed.values())
    assert "8 of 9 mutants killed (89 %)" in str(score)


def test_test_that_fails_without_a_mutant_is_an_error() -> None:
    with pytest.raises(AssertionError):
        mutation_score(strong, AcrobotScenario(period=0.01))


@pytest.mark.slow
def test_arm_that_holds_its_pose_notices_some_mistakes() -> None:
    """A mistake at the first joint, whose axis is vertical, makes no difference to an arm that stands still."""

    def holds(scenario: Scenario) -> None:
        trace = simulate(scenario.build(), 0.3, record="sense.joint_position", sample_period=0.05)
        assert np.ptp(trace["sense.joint_position"], axis=0).max() < 1e-3

    score = mutation_score(holds, ManipulatorScenario())
    killed = {str(mutant) for mutant in score.killed}
    assert {"act.joint_torque: the opposite sign", "act.joint_torque: half the gain", "world: gravity off"} <= killed
    assert "sense.wrench: the opposite sign" in {str(mutant) for mutant in score.survived}


WEAK = """
    def test_builds(testbed):
        assert testbed.variables()
"""
STRONG = """
    from math import exp
    from vtbdrake.testing import assert_settles, simulate

    def test_reaches_its_target(testbed):
        start = {"u.target": [0.1, -0.05], "sim.sys.axes.discrete_state_0": [0.02, 0.03]}
        motion = simulate(testbed, 1.5, record=["sim.sys.axes.discrete_state_0", "act.velocity"], values=start)
        assert_settles(motion, "sim.sys.axes.discrete_state_0", to=[0.1, -0.05], within=1.2, tolerance=1e-3)
        assert abs(motion["act.velocity"][50][0] - 0.4 * exp(-2.5)) < 1e-3
"""


@pytest.mark.slow
def test_weak_test_file_notices_nothing_and_is_refused(user: pytest.Pytester) -> None:
    user.makepyfile(test_weak=WEAK)
    result = user.runpytest_subprocess("-q", "--vtb-mutants=0.5", timeout=100)
    result.assert_outcomes(passed=1)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(
        [
            "*mutants of ServoMachineScenario*",
            "0 of * mutants killed (0 %)",
            "survived: sense.position: two entries swapped",
            "too few: 50 % are required",
        ]
    )


def test_strong_test_file_notices_most(user: pytest.Pytester) -> None:
    user.makepyfile(test_weak=WEAK, test_strong=STRONG)
    result = user.runpytest_subprocess("-q", "--vtb-mutants=0.5", timeout=100)
    result.assert_outcomes(passed=2)
    text = result.stdout.str()
    assert result.ret == pytest.ExitCode.OK, text
    assert "killed: sense.position: the opposite sign, by test_strong.py::test_reaches_its_target" in text
    # Nothing uses the measured speed.
    assert "survived: sense.speed: the opposite sign" in text
    assert not (user.path / ".vtb_failures").exists()


@pytest.mark.slow
def test_failing_tests_have_no_score(user: pytest.Pytester) -> None:
    user.makepyfile("def test_it(testbed):\n    assert False")
    result = user.runpytest_subprocess("-q", "--vtb-mutants", timeout=60)
    result.stdout.fnmatch_lines(["none: tests failed, or none uses the fixture `scenario`"])
