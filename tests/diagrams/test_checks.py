"""Every scenario of the library passes the checks that users' scenarios are put through."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest

from vtbdrake.testbed import Scenario
from vtbdrake.testing import Subject, parametrize_with_checks
from vtbdrake.testing.checks import boundary_checks as boundary
from vtbdrake.testing.checks import loop_checks as loop
from vtbdrake.testing.checks import repetition_checks as repetition
from vtbdrake.testing.checks import scenario_checks as scenario
from vtbdrake.testing.checks import signal_checks as signals
from vtbdrake.testing.subject import CheckFailedError
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.next_route import RouteScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.plain.scenario import PlainScenario
from vtbdrake_diagrams.quadruped import QuadrupedScenario
from vtbdrake_diagrams.recorded_arms.pendulum import TorqueLimitedPendulumScenario
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.studies.arm_motion import ArmMotionScenario
from vtbdrake_diagrams.satellite.studies.light_cases import LightingScenario
from vtbdrake_diagrams.satellite.studies.scan_frequency import ApproachScenario
from vtbdrake_diagrams.space_climber import CraterScenario, SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.exploring import ExploringScenario
from vtbdrake_diagrams.station import HOME, ArmStation

SIMULATED_TIME = "its messages tell the time of a simulation, which stands still when the machine is held up"
NOT_SAMPLED = "Drake's drivers do not sample: beside them, the DPS sees the plant after its step of the same instant"

# With what is set before a simulation, so that something moves.
SCENARIOS = {
    ManipulatorScenario: {"u.motion": float(Motion.SWING)},
    CartPoleScenario: {"sim.sys.cart_pole.pole_pin.position": 0.5},
    SpaceClimberScenario: {},
    CraterScenario: {},
    ExploringScenario: {},
    SatelliteScenario: {},
    ArmMotionScenario: {},
    LightingScenario: {},
    ApproachScenario: {},
    ForestScenario: {},
    RouteScenario: {},
    PlainScenario: {},
    QuadrupedScenario: {},
    ArmStation: {"u.target": HOME + 0.1, "u.opening": 0.1},
    DoublePendulumScenario: {"u.torques": [0.5, 0.3]},
    TorqueLimitedPendulumScenario: {"u.torques": 0.5},
}
EXPECTED = {
    ManipulatorScenario: {"check_late_samples_end_in_the_fallback": SIMULATED_TIME},
    CartPoleScenario: {"check_late_samples_end_in_the_fallback": SIMULATED_TIME},
    ArmStation: {
        "check_dps_cannot_tell_the_switch": NOT_SAMPLED,
        "check_dps_alone_commands_the_same": NOT_SAMPLED,
    },
}


# A small forest, or plain: to build a whole hectare takes seconds.
LITTLE = {"length": 50.0, "width": 50.0, "start": 12.0}
FIELDS = {ForestScenario: LITTLE, RouteScenario: LITTLE, PlainScenario: LITTLE}
# Variants of others, for which one Python is enough.
VARIANTS = (
    ArmMotionScenario,
    LightingScenario,
    ApproachScenario,
    RouteScenario,
    PlainScenario,
    CraterScenario,
    ExploringScenario,
    TorqueLimitedPendulumScenario,
)
# What is built and simulated in no time; of the others, all checks together take some ten seconds each.
SMALL = (CartPoleScenario,)
# What one build of a scenario tells.
STATIC = (
    scenario.check_builds,
    scenario.check_no_algebraic_loop,
    scenario.check_yaml_round_trip,
    scenario.check_pickle_round_trip,
    signals.check_signals_have_units,
    signals.check_signals_have_limits,
    signals.check_parameters_have_bounds,
    signals.check_variables_do_not_overlap,
    loop.check_deployment_is_safe,
)
# What the fields of a variant may change beside that. How systems of its kind repeat in other threads and processes,
# keep no memory and meet faulty messages, the larger scenario has shown.
OF_VARIANTS = (
    *STATIC,
    scenario.check_builds_alike_twice,
    scenario.check_mental_copy_continues,
    repetition.check_simulates,
    repetition.check_state_is_in_the_context,
    repetition.check_runs_repeat,
    repetition.check_reset_equals_a_new_build,
    repetition.check_fork_is_the_future,
    signals.check_values_fit_their_signals,
    boundary.check_sim_and_real_alike,
    boundary.check_dps_alone_commands_the_same,
    loop.check_loop_commands_its_machine,
)


def values(scenario: Scenario) -> dict[str, Any]:
    return SCENARIOS[type(scenario)]


def expected_failed_checks(scenario: Scenario) -> dict[str, str]:
    return EXPECTED.get(type(scenario), {})


def with_checks(kinds: Iterable[type[Scenario]]) -> pytest.MarkDecorator:
    scenarios = [kind(**FIELDS.get(kind, {})) for kind in kinds]
    return parametrize_with_checks(scenarios, values=values, expected_failed_checks=expected_failed_checks)


@with_checks(SMALL)
def test_small_scenario(scenario, check):
    check(scenario)


def outcomes_of(kind: type[Scenario], checks: Iterable[Callable[[Subject], None]]) -> dict[str, Exception | None]:
    subject = Subject(kind(**FIELDS.get(kind, {})), values=SCENARIOS[kind])
    return {check.__name__: subject.outcome(check) for check in checks}


def failed(outcomes: dict[str, Exception | None]) -> dict[str, Exception | None]:
    return {name: error for name, error in outcomes.items() if isinstance(error, CheckFailedError)}


def test_one_build_of_a_larger_scenario_passes():
    outcomes = outcomes_of(ManipulatorScenario, STATIC)
    assert failed(outcomes) == {} and outcomes["check_builds"] is None


@pytest.mark.slow
@with_checks(kind for kind in SCENARIOS if kind not in (*SMALL, *VARIANTS))
def test_larger_scenario(scenario, check):
    check(scenario)


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize("kind", VARIANTS)
def test_variant(kind):
    outcomes = outcomes_of(kind, OF_VARIANTS)
    assert failed(outcomes) == {} and outcomes["check_simulates"] is None
