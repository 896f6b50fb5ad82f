"""Self-test of the arm's calibration: payload, friction, reflected inertia and delay of machines, hidden from it.

``python -m vtbdrake_diagrams.manipulator.studies.self_test`` prints it. The motion comes from `excitation`; the
encoders have a resolution, and torques that no log contains act on the joints.
"""

from __future__ import annotations

import logging

import click
import numpy as np

from vtbdrake.calibration import Excitation, Noise, SelfTest, excitation, self_test
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.machine import MachineConfig
from vtbdrake.optimization import Parameter
from vtbdrake.state.variables import text_table
from vtbdrake_diagrams.manipulator.arm import JOINTS
from vtbdrake_diagrams.manipulator.studies.excited import PLAN, ExcitedArmScenario

POSITION = "joint_position"
TORQUE = "joint_torque"
PAYLOAD = "sim.sys.arm.tool.mass"
DELAY = "sim.act.drives.delay"
RESOLUTION = 2.0 * np.pi / 2**20
"""The resolution of the encoders, in rad: 20 bits."""
DISTURBANCE = 0.05
"""The standard deviation of the disturbance of each joint's torque, in N m; its correlation time is 50 ms."""

_FRICTION = {"coulomb": (0.05, 0.8), "viscous": (0.1, 1.6)}
_ROTORS = ("joint_2", "joint_4")

PARAMETERS = [
    Parameter(PAYLOAD, 0.1, 2.0),
    *(
        Parameter(f"sim.act.drives.{name}[{joint}]", *ends)
        for name, ends in _FRICTION.items()
        for joint in range(JOINTS)
    ),
    *(Parameter(f"sim.sys.arm.{joint}.rotor_inertia", 1e-5, 8e-5) for joint in _ROTORS),
    Parameter(DELAY, 0.0, 6.0),
]
"""The 18 numbers that are hidden, with their ranges."""

# What is asked: (address part, in per cent of the truth or in periods, of the median and of 95 % of the errors).
_GOALS = {
    "payload, %": (PAYLOAD, 0.5, 1.5),
    "Coulomb friction, %": (".coulomb", 3.0, None),
    "viscous friction, %": (".viscous", 5.0, None),
    "reflected inertia, %": (".rotor_inertia", 5.0, None),
    "delay, periods": (DELAY, 0.1, None),
}


def arm() -> ExcitedArmScenario:
    """Return the scenario, with encoders of a finite resolution."""
    return ExcitedArmScenario(position_errors=ErrorModel(quantization=RESOLUTION))


def motion(scenario: ExcitedArmScenario) -> Excitation:
    """Return the motion that tells the parameters."""
    noise = Noise(np.full(JOINTS, RESOLUTION), np.full(JOINTS, DISTURBANCE), 0.05)
    return excitation(scenario, PARAMETERS, spline=scenario.spline, noise=noise, starts=1)


def group_table(result: SelfTest) -> str:
    """Return the errors by group beside what is asked of them."""
    rows = []
    for name, (part, median_goal, most_goal) in _GOALS.items():
        addresses = [address for address in result.addresses if part in address]
        truths = np.concatenate([[trial.truth[address] for trial in result.trials] for address in addresses])
        errors = abs(np.concatenate([result.errors(address) for address in addresses]))
        if part != DELAY:
            errors = 100.0 * errors / truths
        median, most = np.quantile(errors, [0.5, 0.95])
        goals = f"{median_goal:g}" + (f" and {most_goal:g}" if most_goal else "")
        met = "yes" if median <= median_goal and most <= (most_goal or np.inf) else "no"
        rows.append((name, f"{median:.2g}", f"{most:.2g}", goals, met))
    return text_table(("error", "median", "95 % within", "goal", "met"), rows)


@click.command()
@click.option("--seconds", default=10.0, show_default=True, help="The duration of a log, in seconds.")
@click.option("--trials", default=10, show_default=True, help="The number of hidden truths.")
@click.option("--disturbance", default=DISTURBANCE, show_default=True, help="Deviation of each joint's torque, in N m.")
@click.option("--seed", default=0, show_default=True, help="The seed of truths and disturbances.")
def main(seconds: float, trials: int, disturbance: float, seed: int) -> None:
    """Calibrate simulated arms whose numbers are hidden from the calibration, and print how near it came."""
    logging.basicConfig(format="%(asctime)s %(message)s")
    logging.getLogger("vtbdrake.calibration.trials").setLevel(logging.INFO)
    scenario = arm()
    result = self_test(
        scenario,
        PARAMETERS,
        position=POSITION,
        torque=TORQUE,
        seconds=seconds,
        trials=trials,
        seed=seed,
        machine=MachineConfig(disturbance={TORQUE: disturbance} if disturbance else {}),
        values={PLAN: motion(scenario).plan(begin=scenario.period)},
    )
    count, rate = len(result.trials), 1.0 / scenario.period
    click.echo(f"{count} logs of {seconds:g} s at {rate:g} Hz, disturbed by {disturbance:g} N m\n")
    click.echo(f"{result}\n\n{group_table(result)}")


if __name__ == "__main__":
    main()
