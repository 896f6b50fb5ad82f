"""The friction of a light joint that sticks, calibrated: ``python -m tests.calibration.light_joint`` prints it."""

from __future__ import annotations

from tests.calibration.pendulum import PendulumScenario
from tests.calibration.plain_pendulum import recorded
from tests.calibration.test_calibration import COULOMB, FIRST, MOMENT, VISCOUS
from vtbdrake.calibration import Calibration, calibrate
from vtbdrake.optimization import Parameter

FRICTION = 1.2  # N m
PARAMETERS = [Parameter(MOMENT, 1e-3, 0.3), Parameter(COULOMB, 0.0, 5.0), Parameter(VISCOUS, 0.0, 0.5)]


def calibrated(coulomb_velocity: float, time_step: float) -> Calibration:
    """Return the calibration of a joint of 0.02 kg m^2 by a plant with this step in s, 0 for a continuous one."""
    log = recorded(seed=20, center=0.05, moment=0.0175, coulomb=FRICTION - 0.2, amplitude=2.5)
    scenario = PendulumScenario(coulomb_velocity=coulomb_velocity, time_step=time_step).with_values({FIRST: -0.05})
    return calibrate(scenario, log, PARAMETERS, position="position", torque="torque")


def main() -> None:
    """Print the friction for two velocities of its edge and three steps of the plant."""
    for coulomb_velocity in (0.01, 0.05):
        for time_step in (0.0, 0.001, 0.004):
            result = calibrated(coulomb_velocity, time_step)
            friction = result.parameters[COULOMB]
            print(
                f"coulomb_velocity {coulomb_velocity:g} rad/s, step {1e3 * time_step:g} ms: Coulomb friction "
                f"{friction.value:.4g} +- {friction.deviation:.2g} N m ({FRICTION} is right), {friction.verdict} "
                f"{'; '.join(result.reasons)}".rstrip(),
                flush=True,
            )


if __name__ == "__main__":
    main()
