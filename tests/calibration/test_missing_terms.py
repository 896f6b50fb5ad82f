"""Terms that a model of joints lacks are named: on a machine that is not made of the package's parts."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.calibration import light_joint
from tests.calibration.pendulum import DRIVES
from tests.calibration.plain_pendulum import commanded, recorded
from tests.calibration.test_calibration import COULOMB, PARAMETERS, VALUES, VISCOUS, calibrated
from vtbdrake.calibration.calibration_result import Verdict
from vtbdrake.optimization import Parameter

pytestmark = pytest.mark.one_python

NUMBER = r"(\d+(?:\.\d+)?)"


@pytest.mark.parametrize(
    "seed", [20, pytest.param(21, marks=pytest.mark.slow), pytest.param(22, marks=pytest.mark.slow)]
)
def test_right_law_is_accepted(seed: int) -> None:
    result = calibrated(recorded("Coulomb", seed=seed, disturbance=0.05))
    assert result.accepted, result
    errors = {name: abs(each.value - VALUES[name]) for name, each in result.parameters.items()}
    assert all(error < 4.0 * result.parameters[name].deviation for name, error in errors.items())


@pytest.mark.parametrize(
    ("law", "dependence"),
    [
        ("load", "its load"),
        pytest.param("Dahl", "its way since it turned", marks=pytest.mark.slow),
        pytest.param("direction", "the direction of its motion", marks=pytest.mark.slow),
        pytest.param("Stribeck", "its speed near rest", marks=pytest.mark.slow),
    ],
)
def test_wrong_law_is_named(law: str, dependence: str) -> None:
    result = calibrated(recorded(law, seed=20), segment=1.0)
    assert {each.verdict for each in result.parameters.values()} == {Verdict.DISCREPANT}
    (reason,) = result.reasons
    assert reason.startswith(f"the torque of pivot depends on {dependence}")


@pytest.mark.parametrize("seed", [210, pytest.param(226, marks=pytest.mark.slow)])
def test_friction_with_a_memory_is_named_under_a_disturbance(seed: int) -> None:
    """Which hides it: the term is less than 4 deviations from zero, and a third of the friction."""
    reasons = calibrated(recorded("Dahl", seed=seed, disturbance=0.1), segment=1.0).reasons
    assert any("its way since it turned" in reason for reason in reasons), reasons


def test_wrong_law_that_is_not_named_widens_the_intervals() -> None:
    """With the sandwich estimator alone, both numbers of the friction lie 3 deviations from the truth."""
    result = calibrated(recorded("Stribeck", seed=24))
    assert result.accepted, result
    for address, value in VALUES.items():
        each = result.parameters[address]
        assert each.lower < value < each.upper, each
    # The samples are as wide.
    friction = [sample[COULOMB] for sample in result.scenario.samples(200)]
    assert np.std(friction) == pytest.approx(result.parameters[COULOMB].deviation, rel=0.2)


@pytest.mark.parametrize(
    ("law", "term", "truth"),
    [("load", "load_friction", 0.1), pytest.param("direction", "asymmetry", 0.06, marks=pytest.mark.slow)],
)
def test_term_that_was_named_is_calibrated(law: str, term: str, truth: float) -> None:
    address = f"{DRIVES}.{term}[0]"
    result = calibrated(
        recorded(law, seed=20), [*PARAMETERS, Parameter(address, -0.5 if law == "direction" else 0.0, 0.5)]
    )
    assert not [reason for reason in result.reasons if "depends on" in reason]
    assert result.parameters[address].value == pytest.approx(truth, rel=0.15)


@pytest.mark.slow
def test_with_stribecks_friction_the_rest_of_the_law_is_right() -> None:
    """Near rest the machine sticks, which smooth friction does not: so the term itself is not the machine's."""
    stribeck = [Parameter(f"{DRIVES}.stribeck[0]", 0.0, 0.5), Parameter(f"{DRIVES}.stribeck_velocity[0]", 0.05, 1.0)]
    result = calibrated(recorded("Stribeck", seed=20), [*PARAMETERS, *stribeck], segment=1.0)
    assert not [reason for reason in result.reasons if "depends on" in reason]
    assert result.parameters[COULOMB].value == pytest.approx(0.2, rel=0.05)
    assert result.parameters[VISCOUS].value == pytest.approx(0.03, rel=0.1)


def test_size_of_a_missing_torque_is_told() -> None:
    """0.1 |torque| resists the motion: its root mean square is a tenth of the torque's."""
    result = calibrated(recorded("load", seed=21))
    found = re.search(rf"{NUMBER} \+- {NUMBER} N m", result.reasons[0])
    assert found is not None
    torques = commanded(np.random.default_rng(21), 0.004 * np.arange(2000))
    expected = 0.1 * np.sqrt(np.mean(torques**2))
    assert float(found[1]) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(
    "seed", [21, pytest.param(22, marks=pytest.mark.slow), pytest.param(24, marks=pytest.mark.slow)]
)
def test_zero_offset_of_an_encoder_is_told(seed: int) -> None:
    result = calibrated(recorded(seed=seed, offset=0.1))
    assert not result.accepted
    found = re.search(rf"encoder of pivot seems to be off by {NUMBER} \+- {NUMBER} rad", result.reasons[0])
    assert found is not None, result.reasons
    assert abs(float(found[1]) - 0.1) < 3.0 * float(found[2])


@pytest.mark.slow
@pytest.mark.parametrize("coulomb_velocity", [0.01, 0.05])
def test_friction_of_a_light_joint_that_sticks_is_right(coulomb_velocity: float) -> None:
    """T Fc / (I v_c) is 0.004 s 1.2 N m / (0.02 kg m^2 0.01 rad/s) = 24: held for a period, friction would chatter."""
    friction = light_joint.calibrated(coulomb_velocity, time_step=0.0).parameters[COULOMB]
    assert friction.value == pytest.approx(light_joint.FRICTION, rel=0.05)
