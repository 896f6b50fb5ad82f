"""Every scenario of the library passes the checks that users' scenarios are put through."""

import pytest

from vtbdrake.testing import parametrize_with_checks
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.next_route import RouteScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.plain.scenario import PlainScenario
from vtbdrake_diagrams.recorded_arms.pendulum import TorqueLimitedPendulumScenario
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.studies.arm_motion import ArmMotionScenario
from vtbdrake_diagrams.satellite.studies.lighting import LightingScenario
from vtbdrake_diagrams.satellite.studies.scan_frequency import ApproachScenario
from vtbdrake_diagrams.space_climber import CraterScenario, SpaceClimberScenario
from vtbdrake_diagrams.station import HOME, ArmStation

SIMULATED_TIME = "its messages tell the time of a simulation, which stands still when the machine is held up"
NOT_SAMPLED = "Drake's drivers do not sample: beside them, the DPS sees the plant after its step of the same instant"

# With what is set before a simulation, so that something moves.
SCENARIOS = {
    ManipulatorScenario: {"u.motion": float(Motion.SWING)},
    CartPoleScenario: {"sim.sys.cart_pole.pole_pin.position": 0.5},
    SpaceClimberScenario: {},
    CraterScenario: {},
    SatelliteScenario: {},
    ArmMotionScenario: {},
    LightingScenario: {},
    ApproachScenario: {},
    ForestScenario: {},
    RouteScenario: {},
    PlainScenario: {},
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


# Variants of others, for which one Python is enough.
VARIANTS = (
    ArmMotionScenario,
    LightingScenario,
    ApproachScenario,
    RouteScenario,
    PlainScenario,
    CraterScenario,
    TorqueLimitedPendulumScenario,
)


@parametrize_with_checks(
    [kind() for kind in SCENARIOS if kind not in VARIANTS],
    values=lambda scenario: SCENARIOS[type(scenario)],
    expected_failed_checks=lambda scenario: EXPECTED.get(type(scenario), {}),
)
def test_scenario(scenario, check):
    check(scenario)


@pytest.mark.one_python
@parametrize_with_checks([kind() for kind in VARIANTS], values=lambda scenario: SCENARIOS[type(scenario)])
def test_variant(scenario, check):
    check(scenario)
